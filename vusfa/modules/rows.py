"""How many rows a layer gets, and how they lie: by scene, in blocks, in numbers that its kernels know.

Layers with weights of their own for each scene want each scene's rows together; kernels of bfloat16 want
numbers of rows that they have met before.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor
from torch.nn import functional

from vusfa.modules.freezing import for_autocast

__all__ = ["RowScenes", "SceneBlocks", "SceneRows", "is_steady", "steady_linear", "steady_number"]

#: Rows are laid out in blocks of one size where that makes them at most this many times as many.
_PADDING = 1.5


def steady_number(number: int) -> int:
    """The next larger one of a few numbers: 16, 32, ... 256, 288, ..., 512, 576, ..., eight to an octave.

    In bfloat16 on a processor every number of rows gets kernels of its own, which take longer to make than to
    run and stay in memory. Where the number is another one at each call, rows that nobody reads make it one
    of these few.

    >>> [steady_number(number) for number in (1, 17, 256, 257, 1025)]
    [16, 32, 256, 288, 1152]
    """
    step = max(16, 1 << max(0, number.bit_length() - 4))
    return number + -number % step


def is_steady(rows: Tensor) -> bool:
    """Whether rows (R, ...) may well be as many as they are: in float32, or on an accelerator."""
    return rows.is_cuda or for_autocast(rows).dtype != torch.bfloat16


def steady_linear(rows: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """``torch.nn.functional.linear``, for numbers of rows that are another one at each call.

    Where that matters rows of zeros are added, see :func:`steady_number`; to what comes out, forwards and
    backwards, they add nothing.

    Args:
        rows: (R, in), or with more dimensions, of which no care is taken.
        weight: (out, in).
        bias: (out,).

    Returns:
        (R, out).

    >>> steady_linear(torch.ones(3, 2), torch.ones(1, 2), torch.ones(1)).flatten()
    tensor([3., 3., 3.])
    """
    number = len(rows) if rows.dim() == 2 and not is_steady(rows) else 0
    missing = steady_number(number) - number
    if not missing:
        return functional.linear(rows, weight, bias)
    return functional.linear(functional.pad(rows, (0, 0, 0, missing)), weight, bias)[:number]


class SceneRows(NamedTuple):
    """Rows sorted by scene, counted once for all the layers that read them.

    Attributes:
        scene: (R,) int64, ascending.
        counts: rows of each scene.
    """

    scene: Tensor
    counts: list[int]

    @classmethod
    def of(cls, scene: Tensor, num_scenes: int) -> SceneRows:
        """Counts rows whose scenes (R,) ascend."""
        return cls(scene, torch.bincount(scene, minlength=num_scenes).tolist())

    @classmethod
    def sort(cls, scene: Tensor, num_scenes: int) -> tuple[SceneRows, Tensor]:
        """Rows of the scenes (R,) in ascending order, and (R,) int64, which row each of them is.

        >>> rows, order = SceneRows.sort(torch.tensor([1, 0, 1]), 3)
        >>> rows.scene.tolist(), rows.counts, order.tolist()
        ([0, 1, 1], [1, 2, 0], [1, 0, 2])
        """
        ordered, order = scene.sort(stable=True)
        return cls.of(ordered, num_scenes), order


class SceneBlocks(NamedTuple):
    """A few rows laid out scene by scene in blocks of one size, so that a layer is one batched product.

    A product a scene costs more in calls than in arithmetic where rows are few. What fills a block up is the
    batch's first row.

    Attributes:
        size: rows of a block, m.
        source: (n * m,) int64, the row that stands at each place.
        place: (R,) int64, where each row stands.
    """

    size: int
    source: Tensor
    place: Tensor

    @classmethod
    def of(cls, rows: SceneRows, order: Tensor) -> SceneBlocks | None:
        """Of what :meth:`SceneRows.sort` returns; None where there are no rows, or some scene has so many
        that filling up costs more.

        >>> blocks = SceneBlocks.of(*SceneRows.sort(torch.tensor([1, 0, 1, 0, 1]), 2))
        >>> blocks.source.tolist(), blocks.place.tolist()
        ([1, 3, 0, 0, 2, 4], [3, 0, 4, 1, 5])
        """
        number, size = len(order), max(rows.counts)
        whole = len(rows.counts) * size
        if not size or whole > _PADDING * number:
            return None
        # each scene's rows stand so much further on than among the sorted ones
        before = itertools.accumulate(rows.counts[:-1], initial=0)
        further = torch.tensor([index * size - first for index, first in enumerate(before)])
        places = further[rows.scene] + torch.arange(number)
        source = torch.zeros(whole, dtype=torch.int64).index_copy_(0, places, order)
        return cls(size, source, torch.empty_like(places).index_copy_(0, order, places))

    def lay_out(self, rows: Tensor) -> Tensor:
        """(R, F) to (n, m, F)."""
        return functional.embedding(self.source, rows).view(-1, self.size, rows.shape[-1])

    def pick_up(self, blocks: Tensor) -> Tensor:
        """(n, m, F) to (R, F)."""
        return functional.embedding(self.place, blocks.flatten(0, 1))


#: Which scene each row is of, and how rows lie: scene indices of rows in any order, or one of the layouts.
RowScenes: TypeAlias = Tensor | SceneRows | SceneBlocks
