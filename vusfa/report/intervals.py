"""How sure a report's summary is: 95 % bootstrap intervals over seeds and goals, for every measure.

See :mod:`vusfa.evaluation.statistics` for how it is drawn. Success, SPL and collisions are sums over a goal's
episodes over their number; length is over the number of those that arrived, and the ratio over the sum of
their shortest paths.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from vusfa.evaluation import Episodes
from vusfa.evaluation.report import MEAN_OF_SCENES
from vusfa.evaluation.statistics import Sums, bootstrap_mean

__all__ = ["goal_sums", "intervals"]


def goal_sums(episodes: Sequence[Episodes], name: str) -> tuple[Sums, Tensor] | None:
    """What the mean of a measure is made of, by seed and goal.

    Args:
        episodes: K tables, one of each seed.
        name: ``success_k``, ``spl``, ``length``, ``length_ratio`` or ``collisions``.

    Returns:
        sums (K, G) and the scene (G,) of each goal; None where the seeds have different goals or scenes, or
        there are none.

    >>> one = torch.tensor([1, 1])
    >>> table = Episodes(one * 0, one, one, one > 0, one * 8, one * 4, one, one > 0, ("hall",), 9)
    >>> sums, scene = goal_sums([table, table], "length_ratio")
    >>> sums.numerator.tolist(), sums.denominator.tolist(), scene.tolist()
    ([[16.0], [16.0]], [[8.0], [8.0]], [0])
    """
    if not episodes or len({table.scene_names for table in episodes}) > 1:
        return None
    rows, found = [], []
    for table in episodes:
        goals, index = torch.stack([table.scene, table.goal]).unique(dim=1, return_inverse=True)
        found.append(goals)
        over, under = _parts(table, name)
        rows.append(
            [torch.zeros(goals.shape[1]).double().index_add_(0, index, part) for part in (over, under)]
        )
    if any(not torch.equal(goals, found[0]) for goals in found[1:]) or not found[0].shape[1]:
        return None
    return Sums(*(torch.stack(parts) for parts in zip(*rows, strict=True))), found[0][0]


def intervals(episodes: Sequence[Episodes], scene: str, names: Sequence[str]) -> dict[str, float]:
    """Ends of the 95 % interval of every measure: ``name_from`` and ``name_to``, NaN where there is none.

    Args:
        episodes: K tables, one of each seed, of the goals that count.
        scene: a scene's name, or that of a mean over scenes.
        names: measures.
    """
    chosen = episodes
    if episodes and scene in episodes[0].scene_names:
        chosen = [table.select(table.scene == table.scene_names.index(scene)) for table in episodes]
    result: dict[str, float] = {}
    for name in names:
        sums = goal_sums(chosen, name)
        low, high = math.nan, math.nan
        if sums is not None:
            _, low, high = bootstrap_mean(*sums, by_scene=scene == MEAN_OF_SCENES)
        result |= {f"{name}_from": low, f"{name}_to": high}
    return result


def _parts(table: Episodes, name: str) -> tuple[Tensor, Tensor]:
    """Of each episode, what is summed above and below the line; (n,) float64 each."""
    arrived, length, shortest = table.success.double(), table.length.double(), table.shortest.double()
    one = torch.ones_like(arrived)
    if name == "spl":
        return arrived * shortest / torch.maximum(length, shortest), one
    if name == "length":
        return arrived * length, arrived
    if name == "length_ratio":
        return arrived * length, arrived * shortest
    if name == "collisions":
        return table.collisions.double(), one
    return (table.success & (table.length <= int(name.removeprefix("success_")))).double(), one
