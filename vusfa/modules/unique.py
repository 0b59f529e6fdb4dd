"""Compute each distinct row once: unique rows -> run -> gather.

A batch of thousands of steps visits a few hundred states on the way to a few goals. The encoder runs on the
distinct states and goals of a batch, and :class:`vusfa.objectives.USFLoss` on its distinct pairs. Gradients
of equal rows add up before they go through the network.

>>> unique = unique_rows(torch.tensor([4, 7, 4, 4]), torch.tensor([1, 1, 1, 0]))
>>> [column.tolist() for column in unique.columns], unique.inverse.tolist()
([[4, 4, 7], [0, 1, 1]], [1, 2, 1, 0])
>>> state, goal = unique.columns
>>> gather((10 * state + goal).unsqueeze(-1), unique.inverse).flatten().tolist()
[41, 71, 41, 40]
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from vusfa.modules.precision import bucket_size

__all__ = ["Rows", "Unique", "gather", "shapes_may_vary", "unique_rows"]


def shapes_may_vary(ids: Tensor) -> bool:
    """Whether the values of ``ids`` may decide how many rows are computed.

    They may not while compiling or exporting, whose graphs know shapes only, nor under :func:`torch.vmap`,
    where each member of the batch would have a number of its own.

    >>> shapes_may_vary(torch.arange(3)), torch.vmap(lambda x: x + shapes_may_vary(x))(torch.zeros(2))
    (True, tensor([0., 0.]))
    """
    if torch.compiler.is_compiling() or torch.compiler.is_exporting():
        return False
    try:
        ids.data_ptr()  # a tensor inside vmap has no memory of its own
    except RuntimeError:
        return False
    return True


class Unique(NamedTuple):
    """Distinct rows of integer columns.

    Attributes:
        columns: (D,) int64 per column, the distinct rows in ascending order, the last column first.
        inverse: (\\*B,) int64, the distinct row of each row.
    """

    columns: tuple[Tensor, ...]
    inverse: Tensor

    def padded(self) -> Unique:
        """The same, D padded to a bucket size by rows of zeros that nothing refers to.

        >>> len(unique_rows(torch.tensor([5, 5, 3])).padded().columns[0])
        16
        """
        missing = bucket_size(len(self.columns[0])) - len(self.columns[0])
        return Unique(tuple(functional.pad(column, (0, missing)) for column in self.columns), self.inverse)


class Rows(NamedTuple):
    """Values (D, F) of distinct rows and each row's index (R,) into them; or (R, F) of the rows, and None."""

    values: Tensor
    inverse: Tensor | None = None


def unique_rows(*columns: Tensor) -> Unique:
    """Distinct rows of one or more columns (\\*B,) of non-negative integers."""
    first, *others = (column.reshape(-1).long() for column in columns)
    if not others:
        distinct, index = torch.unique(first, return_inverse=True)
        return Unique((distinct,), index.view(columns[0].shape))
    key = torch.zeros_like(first)
    for column in reversed([first, *others]):
        key = key * (column.max() + 1) + column
    distinct, index = torch.unique(key, return_inverse=True)
    one = torch.empty_like(distinct).scatter_(0, index, torch.arange(len(index), device=index.device))
    found = tuple(column[one] for column in (first, *others))
    return Unique(found, index.view(columns[0].shape))


def gather(values: Tensor, index: Tensor | None) -> Tensor:
    """Values (\\*B, ...) of all rows, from those (D, ...) of distinct rows and an index (\\*B,) or None.

    >>> gather(torch.tensor([[1.0], [5.0]]), torch.tensor([1, 1, 0])).flatten().tolist()
    [5.0, 5.0, 1.0]
    """
    if index is None:
        return values
    return functional.embedding(index, values) if values.dim() == 2 else values[index]
