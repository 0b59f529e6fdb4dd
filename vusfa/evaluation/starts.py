"""Starts of the episodes of an evaluation."""

from __future__ import annotations

from typing import Any, Literal

import torch
from torch import Tensor

from vusfa.envs.scene_env import check_counts, check_seed
from vusfa.errors import ConfigError, GoalError
from vusfa.limits import MAX_EPISODES, brief
from vusfa.scenes import SceneSet, check_home, check_scenes

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
    if len(goals) * episodes_per_goal > MAX_EPISODES:
        raise ConfigError(
            f"episodes_per_goal is {brief(episodes_per_goal)} for {len(goals)} goals; give at most"
            f" {MAX_EPISODES:,} episodes in all"
        )
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


def check_pairs(scenes: SceneSet, start: Tensor, goal: Tensor) -> None:
    """Check starts and goals (n,) of episodes.

    Raises:
        GoalError: they are no global ids of states, or not of one scene each.

    >>> check_pairs(SceneSet.bundled(["bathroom"]), torch.tensor([3]), torch.tensor([200]))
    Traceback (most recent call last):
    ...
    vusfa.errors.GoalError: episodes: goal 200 is out of range; the ids are 0..175
    """
    if start.shape != goal.shape or start.ndim != 1 or {start.dtype, goal.dtype} != {torch.int64}:
        shapes = [f"{ids.dtype} {list(ids.shape)}" for ids in (start, goal)]
        raise GoalError(f"episodes are {' and '.join(shapes)}; give starts and goals (n,), int64")
    for name, ids in (("start", start), ("goal", goal)):
        wrong = ids[(ids < 0) | (ids >= scenes.num_states)]
        if len(wrong):
            raise GoalError(
                f"episodes: {name} {int(wrong[0])} is out of range; the ids are 0..{scenes.num_states - 1}"
            )
    scene_id = scenes.scene_id.cpu()
    apart = scene_id[start] != scene_id[goal]
    if apart.any():
        raise GoalError(
            f"episodes: start {int(start[apart][0])} and goal {int(goal[apart][0])} are in different scenes;"
            " give pairs within a scene"
        )


def check_evaluation(policy: Any, scenes: SceneSet, history: int, batch_size: int, seed: int) -> None:
    """Check arguments of :func:`vusfa.evaluation.evaluate`.

    Raises:
        ConfigError: one is of another type or out of range, or the policy's agent was made for other scenes.
    """
    check_scenes(scenes)
    check_seed(seed)
    check_counts(history=(history, 1), batch_size=(batch_size, 1))
    if not hasattr(policy, "out_keys"):
        raise ConfigError(
            f"policy is {brief(type(policy).__name__)}; give a policy, such as InferencePolicy(agent)"
        )
    check_home(policy, scenes)
