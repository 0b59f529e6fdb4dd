"""The result of an evaluation: a table with one row per episode, stored as columns."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from vusfa.files import write_csv

__all__ = ["Episodes"]

_COLUMNS = ("scene", "goal", "start", "success", "length", "shortest", "collisions", "trained")


@dataclass(frozen=True, eq=False)
class Episodes:
    """Episodes of one policy; every column is a tensor (n,) on the CPU.

    Args:
        scene: int64, index into ``scene_names``.
        goal: int64, state id within its scene.
        start: int64, state id within its scene.
        success: bool, the goal was reached within ``max_steps`` actions.
        length: int64, actions taken; ``max_steps`` for a failure.
        shortest: int64, length of the shortest path, -1 where there is none.
        collisions: int64, blocked actions.
        trained: bool, the goal is a trained goal.
        scene_names: names of the scenes.
        max_steps: limit of actions per episode.
        remaining: int64, shortest path from the last state to the goal: 0 at the goal, -1 where there is
            none; None in tables of version 0.1.

    >>> one = torch.tensor([1])
    >>> table = Episodes(one * 0, one, one * 2, one > 0, one * 5, one * 4, one * 0, one > 0, ("hall",), 500)
    >>> len(table), next(table.rows())["scene"], table.select(torch.tensor([False])).success.tolist()
    (1, 'hall', [])
    """

    scene: Tensor
    goal: Tensor
    start: Tensor
    success: Tensor
    length: Tensor
    shortest: Tensor
    collisions: Tensor
    trained: Tensor
    scene_names: tuple[str, ...]
    max_steps: int
    remaining: Tensor | None = None

    def __post_init__(self) -> None:
        shapes = {name: tuple(getattr(self, name).shape) for name in self.columns}
        if len(set(shapes.values())) != 1 or self.scene.ndim != 1:
            raise ValueError(f"the columns of a table of episodes must all be (n,); they are {shapes}")
        if len(self) and not 0 <= int(self.scene.min()) <= int(self.scene.max()) < len(self.scene_names):
            raise ValueError(f"an episode's scene is none of the {len(self.scene_names)} scenes named")

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns present."""
        return _COLUMNS if self.remaining is None else (*_COLUMNS, "remaining")

    def __len__(self) -> int:
        return self.scene.shape[0]

    @classmethod
    def joined(cls, tables: Sequence[Episodes]) -> Episodes:
        """One table of several of the same world and limit, one after the other."""
        first, *_ = tables
        columns: dict[str, Any] = {
            name: torch.cat([getattr(each, name) for each in tables]) for name in first.columns
        }
        return replace(first, **columns)

    def select(self, rows: Tensor) -> Episodes:
        """The episodes where ``rows`` (n,) bool is set."""
        return replace(self, **{name: getattr(self, name)[rows] for name in self.columns})

    def rows(self) -> Iterator[dict[str, Any]]:
        """One dictionary per episode, with the scene's name and plain Python values."""
        columns = [getattr(self, name).tolist() for name in self.columns]
        for values in zip(*columns, strict=True):
            row = dict(zip(self.columns, values, strict=True))
            row["scene"] = self.scene_names[row["scene"]]
            yield row

    def write_csv(self, path: str | Path) -> Path:
        """Write one line per episode, atomically; booleans as 0 and 1."""
        rows = ({k: int(v) if isinstance(v, bool) else v for k, v in row.items()} for row in self.rows())
        return write_csv(path, rows, self.columns)

    def equal(self, other: Episodes) -> bool:
        """Whether both tables hold the same numbers."""
        pairs = ((getattr(self, f.name), getattr(other, f.name)) for f in fields(self))
        return all(
            torch.equal(a, b) if isinstance(a, Tensor) and isinstance(b, Tensor) else a is b or a == b
            for a, b in pairs
        )
