"""The table of recipes/generalise.py, from its results alone."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from vusfa.errors import ResultError
from vusfa.evaluation.statistics import Sums, bootstrap_mean, paired_difference
from vusfa.experiments.experiment import episode_sums
from vusfa.experiments.results import Cell
from vusfa.experiments.tables import markdown

__all__ = ["RANDOM_WALK", "unseen_table"]

RANDOM_WALK = "random walk"
_MEASURES = ("success_500", "success_100", "spl")


def unseen_table(cells: Sequence[Cell]) -> str:
    """Markdown: each policy's success and SPL in the rooms that it was tested in, and its success within 100
    less the random walk's in percentage points; with 95 % bootstrap intervals over seeds and goals, goals
    drawn within their rooms.

    Args:
        cells: one a seed, of the same rooms; their exact tables are the random walk's.

    Raises:
        ResultError: none, or they are of other rooms, or without the random walk.
    """
    if not cells or any(cell.exact is None for cell in cells):
        raise ResultError("there are no results of recipes/generalise.py; run it first")
    if len({tuple(cell.info["tested_in"]) for cell in cells}) > 1:
        raise ResultError("the cells were tested in different rooms; show those of one set of rooms")
    walk = cells[0].exact
    assert walk is not None
    key = walk.scene * 1_000_000 + walk.goal
    floor = {
        name: Sums(getattr(walk, name).unsqueeze(0).expand(len(cells), -1), torch.ones(len(cells), len(key)))
        for name in _MEASURES
    }
    rows = []
    for way in cells[0].episodes:
        sums = [_sums(cell, way, key) for cell in cells]
        both = {
            name: Sums(
                torch.cat([one[name].numerator for one in sums]),
                torch.cat([one[name].denominator for one in sums]),
            )
            for name in _MEASURES
        }
        means = {name: bootstrap_mean(both[name], walk.scene) for name in _MEASURES}
        gap = paired_difference(both["success_100"], floor["success_100"], walk.scene)
        rows.append({"policy": way, "seeds": len(cells), **means, "in 100, less the random walk": gap})
    means = {name: bootstrap_mean(floor[name], walk.scene) for name in _MEASURES}
    rows.append({"policy": RANDOM_WALK, "seeds": None, **means})
    return markdown(rows, ["policy", "seeds", *_MEASURES, "in 100, less the random walk"])


def _sums(cell: Cell, way: str, key: Tensor) -> dict[str, Sums]:
    table = cell.episodes[way]
    place = torch.searchsorted(key, table.scene * 1_000_000 + table.goal)
    return episode_sums(table, place, len(key))
