"""Starts of the episodes of an evaluation."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from vusfa.errors import ConfigError, GoalError
from vusfa.scenes import SceneSet

__all__ = ["Unreachable", "episode_starts"]

Unreachable = Literal["skip", "fail"]


def episode_starts(
    scenes: SceneSet,
    goals: Tensor,
    episodes_per_goal: int,
    *,
    unreachable: Unreachable = "skip",
    generator: torch.Generator | None = None,
) -> tuple[Tensor, Tensor]:
    """Draws where each episode starts, uniformly, with replacement.

    Args:
        scenes: the world.
        goals: (G,) global state ids.
        episodes_per_goal: episodes for each of them.
        unreachable: what to do with pairs of start and goal that no path joins. ``"skip"``: only states that
            can reach the goal in more than 0 steps are starts, and a goal that none can reach gets no
            episode. ``"fail"``: all other states of the scene are starts; from those without a path the agent
            walks and fails.
        generator: source of the draws, on the CPU.

    Returns:
        start and goal, both (n,) global ids, the episodes of one goal in a row, goals in the order given.

    >>> scenes = SceneSet.bundled(["bathroom"])
    >>> start, goal = episode_starts(scenes, torch.tensor([7, 3]), 2)
    >>> goal.tolist(), bool((scenes.distance(start, goal) > 0).all())
    ([7, 7, 3, 3], True)
    """
    if episodes_per_goal < 1:
        raise ConfigError(f"episodes_per_goal is {episodes_per_goal}; it must be 1 or more")
    if unreachable not in ("skip", "fail"):
        raise ConfigError(f"unreachable is {unreachable!r}; it must be 'skip' or 'fail'")
    starts, kept = [], []
    for goal in goals.tolist():
        first, last = _scene_range(scenes, goal)
        states = torch.arange(first, last)
        if unreachable == "skip":
            allowed = states[scenes.distance(states, torch.full_like(states, goal)).cpu() > 0]
        else:
            allowed = states[states != goal]
        if allowed.numel():
            draw = torch.randint(allowed.numel(), (episodes_per_goal,), generator=generator)
            starts.append(allowed[draw])
            kept.append(goal)
    if not starts:
        first = int(torch.as_tensor(goals).flatten()[0])
        name = scenes.names[int(scenes.scene_id[first])]
        raise GoalError(
            f"none of the {len(goals)} goals can be reached from any state (scene {name!r}: no other state"
            f" can reach goal {int(scenes.local_id(first))}); give other goals or scenes"
        )
    return torch.cat(starts), torch.tensor(kept).repeat_interleave(episodes_per_goal)


def _scene_range(scenes: SceneSet, state: int) -> tuple[int, int]:
    scene = int(scenes.scene_id[state])
    return int(scenes.offsets[scene]), int(scenes.offsets[scene + 1])
