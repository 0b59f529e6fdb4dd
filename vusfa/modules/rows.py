"""Layouts of rows for layers with weights per scene: sorted by scene, or in one block per scene."""

from __future__ import annotations

import itertools
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor
from torch.nn import functional

from vusfa.errors import ConfigError

__all__ = ["RowScenes", "SceneBlocks", "SortedByScene", "count_scenes", "unknown_scene"]

#: Rows are laid out in blocks of one size where padding multiplies their number by at most this.
_PADDING = 1.5


def count_scenes(scene: Tensor, num_scenes: int) -> list[int]:
    """Rows of each scene among (R,) scene indices.

    Raises:
        ConfigError: an index of ``num_scenes`` or more.
    """
    counts: list[int] = torch.bincount(scene, minlength=num_scenes).tolist()
    if len(counts) > num_scenes:
        raise unknown_scene(scene, num_scenes)
    return counts


def unknown_scene(scene: Tensor, num_scenes: int) -> ConfigError:
    """The error of a scene that has no weights."""
    return ConfigError(
        f"scene_id holds {int(scene.max())}, and the agent has weights for {num_scenes} scenes; make it with"
        " the environment's scenes, or with shared_heads=True"
    )


class SortedByScene(NamedTuple):
    """Rows sorted by scene, counted once for all the layers that read them.

    Attributes:
        scene: (R,) int64, ascending.
        counts: rows of each scene.
    """

    scene: Tensor
    counts: list[int]

    @classmethod
    def of(cls, scene: Tensor, num_scenes: int) -> SortedByScene:
        """Of rows whose scenes (R,) ascend."""
        return cls(scene, count_scenes(scene, num_scenes))

    @classmethod
    def sort(cls, scene: Tensor, num_scenes: int) -> tuple[SortedByScene, Tensor]:
        """Rows of the scenes (R,) in ascending order, and (R,) int64, which row each of them is.

        >>> rows, order = SortedByScene.sort(torch.tensor([1, 0, 1]), 3)
        >>> rows.scene.tolist(), rows.counts, order.tolist()
        ([0, 1, 1], [1, 2, 0], [1, 0, 2])
        """
        ordered, order = scene.sort(stable=True)
        return cls.of(ordered, num_scenes), order


class SceneBlocks(NamedTuple):
    """Rows laid out scene by scene in blocks of one size, so that a layer is one batched product.

    With few rows a product per scene costs more in calls than in arithmetic. The first row fills blocks up.

    Attributes:
        size: rows of a block, m.
        source: (n * m,) int64, the row that stands at each place.
        place: (R,) int64, where each row stands.
    """

    size: int
    source: Tensor
    place: Tensor

    @classmethod
    def of(cls, rows: SortedByScene, order: Tensor) -> SceneBlocks | None:
        """Of what :meth:`SortedByScene.sort` returns; None where filling up costs more, and for no rows.

        >>> blocks = SceneBlocks.of(*SortedByScene.sort(torch.tensor([1, 0, 1, 0, 1]), 2))
        >>> blocks.source.tolist(), blocks.place.tolist()
        ([1, 3, 0, 0, 2, 4], [3, 0, 4, 1, 5])
        """
        number, size = len(order), max(rows.counts)
        whole = len(rows.counts) * size
        if not size or whole > _PADDING * number:
            return None
        # offset of each scene's rows from their place among the sorted ones
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
RowScenes: TypeAlias = Tensor | SortedByScene | SceneBlocks
