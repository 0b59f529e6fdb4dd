"""From tables of episodes to the tables people read: per scene, trained and unseen goals apart, both
averages.

Two averages over scenes are in use, and the paper's own table mixes them: the plain mean, in which every
scene weighs the same, and the mean weighted by states, in which every goal does. Both are given.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from vusfa.evaluation.episodes import Episodes
from vusfa.evaluation.floors import random_walk
from vusfa.evaluation.metrics import length_ratio, soft_spl, spl, success_rate, weighted_mean
from vusfa.evaluation.navigation import Unreachable
from vusfa.scenes import Scene, SceneSet

if TYPE_CHECKING:
    from rich.console import Console

__all__ = [
    "MEAN_OF_SCENES",
    "MEAN_OF_STATES",
    "count_pairs",
    "print_summary",
    "random_walk_summary",
    "summary",
]

Row = dict[str, Any]

SUBSETS = ("trained", "unseen", "all")
MEAN_OF_SCENES = "mean of scenes"
MEAN_OF_STATES = "mean of states"
_HEADS = {"spl": "SPL", "length": "length", "length_ratio": "ratio", "collisions": "blocked"}
_LEGEND = (
    "success within so many steps and SPL in %; length: steps of the successful episodes;"
    " ratio: that over their shortest paths; blocked: collisions, in an episode"
)


def summary(episodes: Episodes, policy: str, within: Sequence[int] = (500, 100)) -> list[Row]:
    """What one policy achieved: a row for every subset of goals and scene, and for both averages over the
    scenes.

    Args:
        episodes: what it walked.
        policy: what to call it.
        within: give the success within each of these numbers of actions, as ``success_500``, ...; those above
            the episodes' own limit are left out, and the limit itself is always there.

    Returns:
        rows with policy, goals (trained, unseen or all), scene, num_goals, num_episodes, success_k, spl,
        soft_spl, length (of the successful episodes), length_ratio (see
        :func:`vusfa.evaluation.metrics.length_ratio`) and collisions (in an episode).

    >>> one = torch.tensor([1, 1])
    >>> scene = torch.tensor([0, 1])
    >>> episodes = Episodes(scene, one, one, scene < 1, one * 9, one * 9, one, one > 0, ("hall", "attic"), 9)
    >>> [(row["goals"], row["scene"], row["success_9"]) for row in summary(episodes, "walker")][:3]
    [('trained', 'hall', 1.0), ('trained', 'attic', 0.0), ('trained', 'mean of scenes', 0.5)]
    """
    limits = _limits(within, episodes.max_steps)
    rows = []
    for subset in SUBSETS:
        chosen = episodes.select(_subset_mask(subset, episodes.trained))
        per_scene = []
        for index, scene in enumerate(episodes.scene_names):
            part = chosen.select(chosen.scene == index)
            if len(part):
                head = {"policy": policy, "goals": subset, "scene": scene}
                per_scene.append(head | _counts(part) | _measures(part, limits))
        rows += _with_averages(per_scene)
    return rows


def random_walk_summary(
    scenes: SceneSet,
    goals: Tensor,
    trained: Tensor,
    max_steps: int = 500,
    within: Sequence[int] = (500, 100),
    unreachable: Unreachable = "skip",
) -> list[Row]:
    """The random walk's exact success (computed, not sampled) as rows like :func:`summary`'s, with the
    columns that it has no number for NaN.

    Args:
        scenes: the world.
        goals: (G,) global state ids.
        trained: global ids of the trained goals.
        max_steps, within, unreachable: as for the policies it stands beside.
    """
    limits = _limits(within, max_steps)
    goals = goals.cpu()
    is_trained = torch.isin(goals, trained.cpu())
    scene_id = scenes.scene_id.cpu()[goals]
    local = scenes.local_id(goals.to(scenes.scene_id.device)).cpu()
    exact = [
        _random_walk_by_limit(scene, local[scene_id == i], limits, unreachable)
        for i, scene in enumerate(scenes.scenes)
    ]
    rows = []
    for subset in SUBSETS:
        per_scene = []
        for index, scene in enumerate(scenes.scenes):
            success = exact[index][:, _subset_mask(subset, is_trained[scene_id == index])]
            success = success[:, ~success.isnan().any(0)]  # goals that no start reaches get no episode
            if success.shape[1]:
                row: Row = {"policy": "random walk", "goals": subset, "scene": scene.name}
                row |= {"num_goals": success.shape[1], "num_episodes": math.nan}
                row |= {f"success_{k}": rate.mean().item() for k, rate in zip(limits, success, strict=True)}
                per_scene.append(row | dict.fromkeys(("soft_spl", *_HEADS), math.nan))
        rows += _with_averages(per_scene)
    return rows


def count_pairs(scenes: Iterable[Scene], unreachable: Unreachable) -> str:
    """One sentence on the pairs of start and goal that no path joins, and how the tables count them.

    >>> from vusfa.scenes import SceneSet
    >>> count_pairs(SceneSet.bundled(["bathroom"]).scenes, "skip")
    'Every goal can be reached from every start.'
    """
    lost = {scene.name: int((scene.distance < 0).sum()) for scene in scenes}
    lost = {name: count for name, count in lost.items() if count}
    if not lost:
        return "Every goal can be reached from every start."
    counted = {
        "skip": "no episode starts where its goal cannot be reached; a goal without starts is left out",
        "fail": "such pairs are drawn as any other, and count as failures",
    }[unreachable]
    listed = ", ".join(f"{count} in {name}" for name, count in lost.items())
    return f"Pairs of start and goal without a path: {listed}; {counted}."


def print_summary(rows: Sequence[Row], console: Console | None = None, note: str = "") -> None:
    """Print the rows of several policies, one table for each subset of goals, policies side by side scene by
    scene.

    Args:
        rows: of :func:`summary` and :func:`random_walk_summary`, in the order in which the policies shall
            stand.
        console: where to; the terminal by default.
        note: a line beneath.
    """
    from rich import box  # of the extra "recipes"; the rest of this module does without
    from rich.console import Console
    from rich.table import Table

    console = console or Console()
    limits = [key for key in rows[0] if key.startswith("success_")] if rows else []
    for subset in SUBSETS:
        chosen = [row for row in rows if row["goals"] == subset]
        if not chosen or (subset == "all" and len({row["goals"] for row in rows}) == 2):
            continue  # nothing, or what one of the other two tables shows already
        table = Table(
            title=f"{subset} goals", title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0)
        )
        table.add_column("scene", no_wrap=True)
        table.add_column("policy", no_wrap=True)
        for head in [*(f"in {key.removeprefix('success_')}" for key in limits), *_HEADS.values()]:
            table.add_column(head, justify="right")
        for scene in dict.fromkeys(row["scene"] for row in chosen):
            group = [row for row in chosen if row["scene"] == scene]
            for place, row in enumerate(group):
                table.add_row(
                    scene if place == 0 else "",
                    row["policy"],
                    *(_number(row[key], 100, 1) for key in [*limits, "spl"]),
                    *(_number(row[key], 1, 2) for key in ("length", "length_ratio", "collisions")),
                    end_section=place == len(group) - 1,
                )
        console.print(table)
    console.print(_LEGEND)
    if note:
        console.print(note)


def _limits(within: Sequence[int], max_steps: int) -> list[int]:
    return sorted({max_steps, *(k for k in within if k < max_steps)}, reverse=True)


def _subset_mask(subset: str, trained: Tensor) -> Tensor:
    return {"trained": trained, "unseen": ~trained, "all": torch.ones_like(trained)}[subset]


def _counts(episodes: Episodes) -> Row:
    return {"num_goals": episodes.goal.unique().numel(), "num_episodes": len(episodes)}


def _measures(episodes: Episodes, limits: Sequence[int]) -> Row:
    success, length, shortest = episodes.success, episodes.length, episodes.shortest
    left = episodes.remaining
    return {
        **{f"success_{k}": success_rate(success, length, k) for k in limits},
        "spl": spl(success, length, shortest),
        "soft_spl": math.nan if left is None else soft_spl(length, shortest, left),
        "length": length[success].to(torch.float64).mean().item(),
        "length_ratio": length_ratio(success, length, shortest),
        "collisions": episodes.collisions.to(torch.float64).mean().item(),
    }


def _with_averages(per_scene: list[Row]) -> list[Row]:
    """The scenes' rows and, when there are several, the two averages over them."""
    if len(per_scene) < 2:
        return per_scene
    averages = []
    for name, weights in (
        (MEAN_OF_SCENES, [1.0] * len(per_scene)),
        (MEAN_OF_STATES, [row["num_goals"] for row in per_scene]),
    ):
        average = dict(per_scene[0], scene=name)
        for key in average.keys() - {"policy", "goals", "scene"}:
            values = [row[key] for row in per_scene]
            average[key] = sum(values) if key.startswith("num_") else weighted_mean(values, weights)
        averages.append(average)
    return per_scene + averages


def _random_walk_by_limit(
    scene: Scene, goals: Tensor, limits: Sequence[int], unreachable: Unreachable
) -> Tensor:
    if not goals.numel():
        return torch.empty(len(limits), 0, dtype=torch.float64)
    return torch.stack([random_walk(scene, goals, k, unreachable) for k in limits])


def _number(value: float, scale: float, digits: int) -> str:
    return "–" if math.isnan(value) else f"{scale * value:.{digits}f}"
