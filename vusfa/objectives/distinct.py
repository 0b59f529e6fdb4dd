"""Rows that ask the same are asked once.

A batch of thousands of steps visits the same pairs of state and goal again and again. Where inputs are ids
and nothing else, the networks run on the distinct rows, and what they write is looked up row by row;
gradients of equal rows then add up before they go through the networks, not after.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn import functional

__all__ = ["distinct_rows", "spread"]

#: Distinct rows for each row, up to which asking once is worth the sorting.
WORTH = 0.75


def distinct_rows(inputs: TensorDictBase) -> tuple[TensorDictBase, Tensor] | None:
    """The different rows of a tensordict of ids, and where each row is among them.

    Args:
        inputs: of any batch shape; only one number a row in each entry, whole and not negative, makes sense.

    Returns:
        the different rows (D,) and an index (\\*B,) into them; None where an entry holds something else, or
        more than three quarters of the rows differ.

    >>> from tensordict import TensorDict
    >>> ids = {"state": torch.tensor([[4], [7], [4], [4]]), "goal": torch.tensor([1, 1, 1, 0])}
    >>> rows, index = distinct_rows(TensorDict(ids, [4]))
    >>> rows["state"].flatten().tolist(), rows["goal"].tolist(), index.tolist()
    ([4, 4, 7], [0, 1, 1], [1, 2, 1, 0])
    >>> distinct_rows(TensorDict({"state": torch.rand(4, 1)}, [4])) is None
    True
    """
    number = inputs.numel()
    columns = [value for _, value in sorted(inputs.items(True, True), key=lambda item: str(item[0]))]
    if not columns or any(value.is_floating_point() or value.numel() != number for value in columns):
        return None
    key = torch.zeros(number, dtype=torch.int64, device=columns[0].device)
    for column in reversed(columns):
        flat = column.reshape(-1).long()
        key = key * (flat.max() + 1) + flat
    different, index = torch.unique(key, return_inverse=True)
    if len(different) > WORTH * number:
        return None
    one = torch.empty_like(different).scatter_(0, index, torch.arange(number, device=key.device))
    return inputs.reshape(-1)[one], index.view(inputs.shape)


def spread(values: Tensor, index: Tensor) -> Tensor:
    """Values (D, ...) of distinct rows, row by row: (\\*B, ...) for an index (\\*B,).

    >>> spread(torch.tensor([[1.0], [5.0]]), torch.tensor([1, 1, 0])).flatten().tolist()
    [5.0, 5.0, 1.0]
    """
    return functional.embedding(index, values) if values.dim() == 2 else values[index]
