"""Batched rollouts of evaluation episodes.

The rules are the environment's own (:mod:`vusfa.envs.dynamics`), on a batch that shrinks: an episode that
ends leaves it at once and a waiting one takes its row. So a few long episodes do not cost full batches.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from vusfa.envs.dynamics import MAX_STEPS, Rewards, start_history, step
from vusfa.envs.goals import resolve_goals
from vusfa.errors import ConfigError
from vusfa.evaluation.episodes import Episodes
from vusfa.evaluation.starts import Unreachable, check_evaluation, check_pairs, episode_starts
from vusfa.modules import InferencePolicy
from vusfa.scenes import SceneSet, check_home

__all__ = ["acting", "evaluate", "trails", "walk"]

Observe = Callable[[TensorDictBase], TensorDictBase]
Progress = Callable[[int, int], None]


def evaluate(
    policy: TensorDictModuleBase,
    scenes: SceneSet,
    goals: Any = "all",
    *,
    trained: Tensor | None = None,
    episodes: tuple[Tensor, Tensor] | None = None,
    episodes_per_goal: int = 10,
    max_steps: int = MAX_STEPS,
    history: int = 4,
    sample: bool = True,
    unreachable: Unreachable = "skip",
    seed: int = 0,
    batch_size: int = 4096,
    observe: Observe | None = None,
    progress: Progress | None = None,
    by_scene: bool = False,
) -> Episodes:
    """Roll out ``episodes_per_goal`` episodes to every goal.

    All draws come from ``seed``; the caller's random state stays. The policy is in evaluation mode meanwhile.

    Args:
        policy: reads ``state_id`` (n, H), ``goal_id`` (n,), ``scene_id`` (n,) and writes ``action`` (n,).
        scenes: the world; on the policy's device.
        goals: global state ids, or whatever :func:`vusfa.envs.goals.resolve_goals` takes.
        trained: global ids of the trained goals, which the table marks.
        episodes: starts and goals (n,), global ids, of a manifest (:mod:`vusfa.experiments.manifest`); they
            replace ``goals``, ``episodes_per_goal`` and ``unreachable``.
        episodes_per_goal: episodes per goal, from starts drawn uniformly.
        max_steps: limit of actions per episode.
        history: frames H in ``state_id``.
        sample: draw actions, or take the most probable one.
        unreachable: see :func:`episode_starts`.
        seed: of starts and actions.
        batch_size: episodes in parallel.
        observe: adds ``observation`` and ``goal_observation`` for a policy that reads these.
        progress: called with (finished episodes, all episodes) after every step.
        by_scene: walk in a few scenes at a time, as always where features stay in files.

    Raises:
        ConfigError: the agent was made for other scenes.
        GoalError: a goal does not exist, or no goal can be reached.
    """
    check_evaluation(policy, scenes, history, batch_size, seed)
    if episodes is not None:
        start, goal = (ids.cpu() for ids in episodes)
        check_pairs(scenes, start, goal)
    else:
        generator = torch.Generator().manual_seed(seed)
        start, goal = episode_starts(
            scenes,
            resolve_goals(scenes, goals).cpu(),
            episodes_per_goal,
            unreachable=unreachable,
            generator=generator,
        )
    limits: dict[str, Any] = {"max_steps": max_steps, "history": history, "batch_size": batch_size}
    walks = _walk_by_scene if (by_scene or scenes.is_lazy) and len(goal) else walk
    with acting(policy, scenes, sample, seed, by_scene):
        walked = walks(policy, scenes, start, goal, observe=observe, progress=progress, **limits)
    success, length, collisions, end = walked
    marked = torch.zeros(scenes.num_states, dtype=torch.bool)
    if trained is not None:
        marked[trained.cpu()] = True
    return Episodes(
        scene=scenes.scene_id.cpu()[goal],
        goal=scenes.local_id(goal).cpu(),
        start=scenes.local_id(start).cpu(),
        success=success,
        length=length,
        shortest=scenes.distance(start, goal).cpu(),
        collisions=collisions,
        trained=marked[goal],
        scene_names=tuple(scenes.names),
        max_steps=max_steps,
        remaining=scenes.distance(end, goal).cpu(),
    )


def _walk_by_scene(
    policy: TensorDictModuleBase,
    scenes: SceneSet,
    start: Tensor,
    goal: Tensor,
    *,
    batch_size: int,
    progress: Progress | None,
    **options: Any,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """As :func:`walk`, in a few scenes at a time: at most ``batch_size`` episodes, or one scene. Of these
    the policy's answers are computed once, and no others have their features in memory."""
    scene = scenes.scene_id.cpu()[goal]
    order, total = scene.argsort(stable=True), len(goal)
    ends = scene.unique(return_counts=True)[1].cumsum(0).tolist()
    parts, first = [], 0
    for end, following in pairwise([*ends, math.inf]):
        if following - first <= batch_size:
            continue
        rows = order[first:end]
        done = None if progress is None else (lambda n, _, first=first: progress(first + n, total))
        with caching(policy, scenes, goal[rows].unique()):
            parts.append(
                walk(policy, scenes, start[rows], goal[rows], progress=done, batch_size=batch_size, **options)
            )
        first = end
    back = order.argsort()
    success, length, collisions, last = (torch.cat(column)[back] for column in zip(*parts, strict=True))
    return success, length, collisions, last


@torch.no_grad()
def walk(
    policy: TensorDictModuleBase,
    scenes: SceneSet,
    start: Tensor,
    goal: Tensor,
    *,
    max_steps: int,
    history: int,
    batch_size: int = 4096,
    observe: Observe | None = None,
    progress: Progress | None = None,
    visited: list[tuple[Tensor, Tensor]] | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Roll out one episode per pair of start and goal, with the present exploration type and random state.

    A policy with memory writes its next state under ``("next", key)`` and finds it again under ``key``;
    ``is_init`` (n, 1) marks the rows that begin, ``previous_action`` (n,) is A in these.

    Args:
        policy, scenes, max_steps, history, batch_size, observe, progress: see :func:`evaluate`.
        start, goal: (n,) global state ids.
        visited: gets, per step, the episodes that moved and their new states.

    Returns:
        success (n,) bool; length, collisions and last state, a global id, (n,) int64 each; on the CPU.
    """
    if max_steps < 1 or batch_size < 1:
        raise ConfigError(f"max_steps is {max_steps} and batch_size {batch_size}; both must be 1 or more")
    device, total = scenes.successor.device, len(start)
    start, goal = start.to(device), goal.to(device)
    success = torch.zeros(total, dtype=torch.bool, device=device)
    length = torch.full((total,), max_steps, dtype=torch.int64, device=device)
    collisions = torch.zeros(total, dtype=torch.int64, device=device)
    last = start.clone()
    memory_keys = [key[1:] for key in policy.out_keys if isinstance(key, tuple) and key[0] == "next"]

    rewards = Rewards.of()
    begun = min(total, batch_size)
    row = torch.arange(begun, device=device)  # the episode of each row of the batch
    steps = torch.zeros(begun, 1, dtype=torch.int64, device=device)
    frames = start_history(start[row], history)
    memory: dict[tuple[str, ...], Tensor] = {}
    before = torch.full_like(row, scenes.num_actions)
    while row.numel():
        batch = TensorDict(
            {"state_id": frames, "goal_id": goal[row], "scene_id": scenes.scene_id[goal[row]]},
            batch_size=row.shape,
            device=device,
        )
        for key, value in memory.items():
            batch.set(key, value)
        batch.set("is_init", steps == 0).set("previous_action", before)
        batch = policy(batch if observe is None else observe(batch))
        before = action = batch.get("action")
        end = step(scenes.successor, scenes.blocked, rewards, max_steps, frames, goal[row], steps, action)
        frames, steps = end.state_id, end.elapsed_steps
        success[row] = end.terminated.squeeze(-1)
        length[row] = steps.squeeze(-1)
        last[row] = frames[:, -1]
        if visited is not None:
            visited.append((row, last[row]))
        collisions.index_add_(0, row, end.collided.squeeze(-1).to(torch.int64))
        memory = {key: batch.get(("next", *key)) for key in memory_keys}

        walking = ~end.done.squeeze(-1)
        if not bool(walking.all()):
            new = torch.arange(begun, min(total, begun + batch_size - int(walking.sum())), device=device)
            begun += new.shape[0]
            row = torch.cat([row[walking], new])
            steps = torch.cat([steps[walking], steps.new_zeros(new.shape[0], 1)])
            frames = torch.cat([frames[walking], start_history(start[new], history)])
            before = torch.cat([action[walking], torch.full_like(new, scenes.num_actions)])
            memory = {
                key: torch.cat([value[walking], value.new_zeros(new.shape[0], *value.shape[1:])])
                for key, value in memory.items()
            }
        if progress is not None:
            progress(begun - row.shape[0], total)
    return success.cpu(), length.cpu(), collisions.cpu(), last.cpu()


def trails(
    policy: TensorDictModuleBase,
    scenes: SceneSet,
    start: Tensor,
    goal: Tensor,
    *,
    max_steps: int = MAX_STEPS,
    history: int = 4,
    seed: int = 0,
    observe: Observe | None = None,
) -> list[list[int]]:
    """Trajectories of episodes with sampled actions, one per start.

    Args:
        policy, scenes, max_steps, history, seed, observe: see :func:`evaluate`.
        start, goal: (n,) global state ids.

    Returns:
        n lists of global state ids, the start first; a successful one ends with its goal.

    >>> from vusfa.modules import make_agent
    >>> rooms = SceneSet.bundled(["bathroom"])
    >>> actor = make_agent("gvf", scenes=rooms, hidden_size=16).get_policy_operator()
    >>> (way,) = trails(actor, rooms, torch.tensor([5]), torch.tensor([9]), max_steps=7)
    >>> way[0], len(way) <= 8
    (5, True)
    """
    visited: list[tuple[Tensor, Tensor]] = []
    with acting(policy, scenes, True, seed):
        limits: dict[str, Any] = {"max_steps": max_steps, "history": history}
        walk(policy, scenes, start, goal, **limits, observe=observe, visited=visited)
    ways = [[state] for state in start.tolist()]
    for rows, states in visited:
        for row, state in zip(rows.tolist(), states.tolist(), strict=True):
            ways[row].append(state)
    return ways


@contextmanager
def caching(policy: nn.Module, scenes: SceneSet | None = None, goals: Tensor | None = None) -> Iterator[None]:
    """Context of :meth:`~vusfa.modules.InferencePolicy.cached` for every inference policy in a policy."""
    with ExitStack() as stack:
        for module in policy.modules():
            if isinstance(module, InferencePolicy):
                stack.enter_context(module.cached(goals, scenes))
        yield


@contextmanager
def acting(
    policy: nn.Module, scenes: SceneSet, sample: bool = True, seed: int = 0, by_scene: bool = False
) -> Iterator[None]:
    """Evaluation mode, cached inference policies and an own random state; all restored afterwards.

    Args:
        policy: a policy, or an agent.
        scenes: on its device.
        sample, seed, by_scene: see :func:`evaluate`.
    """
    check_home(policy, scenes)
    modes = [(module, module.training) for module in policy.modules()]
    policy.eval()
    devices = [scenes.device] if scenes.device.type == "cuda" else []
    exploration = ExplorationType.RANDOM if sample else ExplorationType.DETERMINISTIC
    try:
        with torch.random.fork_rng(devices), set_exploration_type(exploration), ExitStack() as stack:
            if not (by_scene or scenes.is_lazy):  # else of a few at a time
                stack.enter_context(caching(policy))
            torch.manual_seed(seed)
            yield
    finally:
        for module, mode in modes:
            module.training = mode
