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
    """Draw the start of each episode, uniformly, with replacement.

    Args:
        scenes: the world.
        goals: (G,) global state ids.
        episodes_per_goal: episodes per goal.
        unreachable: what to do with pairs of start and goal without a path. ``"skip"``: only states that can
            reach the goal are starts, and a goal without starts gets no episode. ``"fail"``: all other states
            of the scene are starts, and those without a path end in failures.
        generator: of the draws, on the CPU.

    Returns:
        start and goal, both (n,) global ids, goals in the given order.

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
        scene = int(scenes.scene_id[goal])
        states = torch.arange(int(scenes.offsets[scene]), int(scenes.offsets[scene + 1]))
        if unreachable == "skip":
            allowed = states[scenes.scenes[scene].distances_to(goal - int(states[0]))[0] > 0]
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
