"""Evaluations in parts, which one process walks one after the other, or several share out.

What a part is depends on the scenes and goals alone, and so do its draws: the numbers are the same, to the
last bit, however many processes have walked them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from vusfa.errors import GoalError
from vusfa.evaluation.episodes import Episodes
from vusfa.evaluation.navigation import evaluate
from vusfa.evaluation.starts import Unreachable, episode_starts
from vusfa.scenes import SceneSet

__all__ = ["evaluate_parts", "parts_of"]

#: Most episodes of a part. On a processor as many rows cost no more per episode than thousands do; on an
#: accelerator a step costs the same for any number.
MOST = {"cpu": 256}
MOST_ELSEWHERE = 4096


def parts_of(scenes: SceneSet, goals: Tensor, episodes_per_goal: int) -> list[Tensor]:
    """Split goals (G,), global ids, into parts of one scene each, in the order of the scenes.

    Args:
        scenes: the world.
        goals: within a scene they keep their order.
        episodes_per_goal: a part has at most 256 episodes (4,096 on a GPU), or one goal.

    >>> rooms = SceneSet.bundled(["bathroom", "bedroom"])
    >>> [part.tolist() for part in parts_of(rooms, torch.tensor([200, 3, 9, 12]), 100)]
    [[3, 9], [12], [200]]
    """
    goals = goals.cpu()
    scene = scenes.scene_id.cpu()[goals]
    most = MOST.get(scenes.device.type, MOST_ELSEWHERE)
    each = max(1, most // max(1, episodes_per_goal))
    return [part for index in scene.unique().tolist() for part in goals[scene == index].split(each)]


def evaluate_parts(
    policy: TensorDictModuleBase,
    scenes: SceneSet,
    parts: Sequence[Tensor],
    share: slice = slice(None),
    *,
    episodes_per_goal: int = 10,
    unreachable: Unreachable = "skip",
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
    **settings: Any,
) -> list[Episodes]:
    """Evaluate a policy on some of the parts of an evaluation.

    Starts and actions of part i are drawn from ``seed + i``: a single part is as
    :func:`~vusfa.evaluation.evaluate` walks it.

    Args:
        policy, scenes, episodes_per_goal, unreachable, seed: of :func:`~vusfa.evaluation.evaluate`.
        parts: of the whole evaluation, see :func:`parts_of`.
        share: which of them to walk, such as every second one.
        progress: called with (finished episodes, all episodes) of the share.
        settings: its other arguments.

    Returns:
        a table per part of the share; empty where no goal of the part can be reached.

    >>> from vusfa.modules import InferencePolicy, make_agent
    >>> rooms = SceneSet.bundled(["bathroom"])
    >>> policy = InferencePolicy(make_agent("gvf", scenes=rooms, hidden_size=8))
    >>> parts = parts_of(rooms, torch.tensor([3, 9, 12]), 100)
    >>> tables = [evaluate_parts(policy, rooms, parts, slice(rank, None, 2), max_steps=5) for rank in (0, 1)]
    >>> [[len(table) for table in own] for own in tables]
    [[20], [10]]
    """
    own = [
        (number, _starts(scenes, parts[number], episodes_per_goal, unreachable, seed + number))
        for number in range(len(parts))[share]
    ]
    total, done, tables = sum(len(goal) for _, (_, goal) in own), 0, []
    for number, pairs in own:
        shown = None if progress is None else (lambda n, _, done=done: progress(done + n, total))
        settings |= {"seed": seed + number, "progress": shown, "by_scene": True}
        tables.append(evaluate(policy, scenes, episodes=pairs, **settings))
        done += len(pairs[0])
    return tables


def _starts(
    scenes: SceneSet, goals: Tensor, episodes_per_goal: int, unreachable: Unreachable, seed: int
) -> tuple[Tensor, Tensor]:
    draws = torch.Generator().manual_seed(seed)
    try:
        return episode_starts(scenes, goals, episodes_per_goal, unreachable=unreachable, generator=draws)
    except GoalError:  # of this part alone none can be reached
        return goals[:0], goals[:0]
