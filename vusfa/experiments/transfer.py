"""The paper's Figure 2 as pure functions: new goals near and far from the trained ones, and summaries of a
curve of episode lengths."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from vusfa.envs.dynamics import MAX_STEPS
from vusfa.errors import GoalError
from vusfa.evaluation.exact import expected_walks
from vusfa.scenes import SceneSet

__all__ = [
    "FINE_TUNED",
    "FROM_SCRATCH",
    "KINDS",
    "area_under",
    "curves_of",
    "frames_to",
    "new_goals",
    "walked_lengths",
]

#: Names of the two trainings' curves in results.
FINE_TUNED, FROM_SCRATCH = "fine-tuned", "from scratch"
#: Fewest actions from a new goal to the nearest trained one; None: any state that is not trained.
KINDS: dict[str, int | None] = {"1-step": 1, "2-steps": 2, "4-steps": 4, "random": None}


def curves_of(info: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The curves of a run's info, per set of goals; version 0.1 called fine-tuning "trained on".

    >>> curves_of({"curves": [{"goals": [3], "trained on": {"frames": [0]}}]})
    [{'goals': [3], 'fine-tuned': {'frames': [0]}}]
    """
    names = {"trained on": FINE_TUNED}
    return [{names.get(name, name): part for name, part in entry.items()} for entry in info["curves"]]


def new_goals(
    scenes: SceneSet, trained: Tensor, kind: str, index: int, *, per_scene: int = 5, seed: int = 0
) -> Tensor:
    """Draw a set of new goals; equal arguments give equal goals.

    Args:
        scenes: the world.
        trained: (G,) global ids of the trained goals.
        kind: of :data:`KINDS`.
        index: number of the set.
        per_scene: goals per scene with trained goals.
        seed: of all draws.

    Returns:
        (S * per_scene,) int64 global ids, scene by scene.

    Raises:
        GoalError: an unknown kind, or a scene with too few such states.

    >>> rooms = SceneSet.bundled(["bathroom"])
    >>> goals = new_goals(rooms, torch.tensor([0, 73]), "1-step", 0, per_scene=3)
    >>> [min(int(rooms.distance(goal, torch.tensor(t))) for t in (0, 73)) for goal in goals]
    [1, 1, 1]
    """
    if kind not in KINDS:
        raise GoalError(f"new goals are of the kind {kind!r}; give one of {', '.join(KINDS)}")
    generator = torch.Generator().manual_seed((seed * 1000 + index) * len(KINDS) + list(KINDS).index(kind))
    steps, found = KINDS[kind], []
    for number, scene in enumerate(scenes.scenes):
        first = int(scenes.offsets[number])
        here = trained.cpu()[(trained.cpu() >= first) & (trained.cpu() < first + scene.num_states)] - first
        if not len(here):
            continue
        way = scene.distances_to(here).T.to(torch.int64)
        nearest = torch.where(way < 0, torch.iinfo(torch.int64).max, way).amin(1)
        # from everywhere, so that every episode can succeed
        reached = torch.cat([(part >= 0).all(1) for part in scene.all_distances()])
        allowed = reached & (nearest == steps if steps is not None else nearest > 0)
        candidates = allowed.nonzero().squeeze(-1)
        if len(candidates) < per_scene:
            raise GoalError(
                f"scene {scene.name!r} has {len(candidates)} states of the kind {kind!r}; {per_scene} are"
                " wanted: give fewer, or other trained goals"
            )
        chosen = candidates[torch.randperm(len(candidates), generator=generator)[:per_scene]]
        found.append(chosen.sort().values + first)
    return torch.cat(found)


def walked_lengths(scenes: SceneSet, goals: Tensor, max_steps: int = MAX_STEPS) -> tuple[float, float]:
    """Expected actions per episode of a random walk and of the shortest path, means over goals and starts.

    See :func:`~vusfa.evaluation.exact.expected_walks`.

    Args:
        scenes: the world.
        goals: (G,) global ids, scene by scene.
        max_steps: limit of actions, and the length of a failed episode.

    >>> walk, shortest = walked_lengths(SceneSet.bundled(["bathroom"]), torch.tensor([3, 90]))
    >>> 500 > walk > 10 * shortest > 10
    True
    """
    walks = expected_walks(None, scenes, goals, max_steps)
    return walks.length.mean().item(), walks.shortest.mean().item()


def area_under(frames: Sequence[float], values: Sequence[float]) -> float:
    """Mean of a curve over its frames, by the trapezoidal rule; for episode lengths, less is faster learning.

    >>> area_under([0, 10, 30], [4.0, 2.0, 2.0])
    2.3333333333333335
    """
    if len(frames) != len(values) or len(frames) < 2:
        raise ValueError(f"a curve needs two points or more; there are {len(frames)} and {len(values)}")
    area = sum(
        (after - before) * (low + high) / 2
        for before, after, low, high in zip(frames[:-1], frames[1:], values[:-1], values[1:], strict=True)
    )
    return area / (frames[-1] - frames[0])


def frames_to(frames: Sequence[float], values: Sequence[float], threshold: float) -> float:
    """Frames at which a curve first falls to a threshold, linear between its points; NaN if it never does.

    >>> frames_to([0, 10, 20], [8.0, 4.0, 1.0], 6.0), frames_to([0, 10], [8.0, 7.0], 6.0)
    (5.0, nan)
    """
    if values[0] <= threshold:
        return float(frames[0])
    for before, after, high, low in zip(frames[:-1], frames[1:], values[:-1], values[1:], strict=True):
        if low <= threshold:
            return before + (after - before) * (high - threshold) / (high - low)
    return math.nan
