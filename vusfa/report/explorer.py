"""Value, policy and successor features of an agent at every state of a scene, and sampled episodes.

An agent with several frames, or with a memory, is evaluated as at the beginning of an episode.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from vusfa.envs.dynamics import MAX_STEPS, start_history
from vusfa.evaluation import trails
from vusfa.evaluation.navigation import Observe
from vusfa.modules import Agent, TabularPolicy
from vusfa.scenes import Scene, SceneSet
from vusfa.scenes.poses import spread_poses
from vusfa.training import make_observation

__all__ = [
    "StateMaps",
    "choose_goals",
    "choose_starts",
    "principal_axes",
    "sampled_walks",
    "state_maps",
]

_ROWS = 32768  # pairs of state and goal per batch
_PAIRS_FOR_AXES = 16384


@dataclass(frozen=True, eq=False)
class StateMaps:
    """One agent in one scene of N states, for G goals.

    Args:
        value: (G, N) V(s, g), in discounted reward.
        probabilities: (G, N, A) of the policy.
        components: (G, N, K) psi's first principal components, in the unit of psi; None without psi.
        explained: (K,) share of psi's variance that each explains; None without psi.
    """

    value: Tensor
    probabilities: Tensor
    components: Tensor | None
    explained: Tensor | None


@torch.no_grad()
def state_maps(
    agent: Agent, scenes: SceneSet, scene: int, goals: Sequence[int], num_components: int = 3
) -> StateMaps:
    """Evaluate an agent at every state of a scene, for some goals.

    The directions of the principal components are those of at most 16,384 pairs of state and goal, spread
    evenly.

    Args:
        agent: in evaluation mode, on the scenes' device.
        scenes: the world.
        scene: index of the scene.
        goals: G state ids within the scene.
        num_components: K.

    >>> from vusfa.modules import make_agent
    >>> scenes = SceneSet.bundled(["bathroom"])
    >>> maps = state_maps(make_agent("vusfa", scenes=scenes, hidden_size=16).eval(), scenes, 0, [73, 0])
    >>> maps.value.shape, maps.probabilities.shape, maps.components.shape
    (torch.Size([2, 176]), torch.Size([2, 176, 4]), torch.Size([2, 176, 3]))
    """
    observe = make_observation(agent, scenes)
    actor, critic = agent.get_policy_operator(), agent.get_value_operator()
    num_states, device = scenes.scenes[scene].num_states, scenes.device
    local = torch.arange(num_states, device=device).repeat(len(goals))
    state = scenes.global_id(scene, local)
    goal = scenes.global_id(scene, torch.tensor(goals, device=device)).repeat_interleave(num_states)
    table = TabularPolicy(agent, scenes, goal) if agent.is_tabular and len(goals) else None
    parts: dict[str, list[Tensor]] = {"value": [], "probabilities": [], "components": []}
    axes: tuple[Tensor, Tensor, Tensor] | None = None
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        spread = torch.linspace(0, len(state) - 1, min(len(state), _PAIRS_FOR_AXES), device=device).long()
        for rows in [spread, *torch.arange(len(state), device=device).split(_ROWS)]:
            batch = _standing(scenes, state[rows], goal[rows], agent.config["history"], observe)
            if rows is spread:
                if "successor_features" in (judged := critic(batch)).keys():
                    axes = principal_axes(judged["successor_features"].cpu(), num_components)
                continue
            if table is None:
                probabilities = actor.get_dist(batch.clone(recurse=False)).probs
            else:  # one large product per scene
                probabilities = table.probabilities(state[rows], goal[rows], batch["scene_id"])
            judged = critic(batch)
            parts["probabilities"].append(probabilities.float().cpu())
            parts["value"].append(judged["state_value"].squeeze(-1).float().cpu())
            if axes is not None:
                centred = judged["successor_features"].cpu().double() - axes[0]
                parts["components"].append((centred @ axes[1]).float())
    shape = (len(goals), num_states)
    return StateMaps(
        torch.cat(parts["value"]).reshape(shape),
        torch.cat(parts["probabilities"]).reshape(*shape, -1),
        None if axes is None else torch.cat(parts["components"]).reshape(*shape, -1),
        None if axes is None else axes[2],
    )


def principal_axes(values: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """The first principal components of rows, each with the sign that makes its largest coordinate positive.

    Args:
        values: (n, E).
        count: K, at most E.

    Returns:
        (E,) mean and (E, K) directions, both float64; (K,) shares of the variance (0 where there is none).

    >>> line = torch.tensor([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]])
    >>> mean, directions, share = principal_axes(line, 1)
    >>> mean.tolist(), [f"{x:.2f}" for x in directions.abs().flatten().tolist()], share.tolist()
    ([1.0, 1.0], ['0.71', '0.71'], [1.0])
    """
    mean = values.double().mean(0)
    centred = values.double() - mean
    variances, directions = torch.linalg.eigh(centred.T @ centred)
    order = variances.argsort(descending=True)[:count]
    found = centred @ directions[:, order]
    largest = found.gather(0, found.abs().argmax(0, keepdim=True))
    total = variances.clamp(min=0).sum()
    share = variances[order].clamp(min=0) / total if total > 0 else torch.zeros(len(order)).double()
    return mean, directions[:, order] * torch.where(largest < 0, -1.0, 1.0), share.float().clamp(max=1.0)


def sampled_walks(
    agent: Agent, scenes: SceneSet, start: Tensor, goal: Tensor, max_steps: int = MAX_STEPS, seed: int = 0
) -> list[list[int]]:
    """Trajectories of an agent with sampled actions, see :func:`vusfa.evaluation.trails`."""
    observe, history = make_observation(agent, scenes), agent.config["history"]
    options: dict[str, Any] = {"max_steps": max_steps, "history": history, "seed": seed, "observe": observe}
    return trails(agent.get_policy_operator(), scenes, start, goal, **options)


def choose_goals(scene: Scene, trained: Sequence[int], success: Tensor | None, count: int) -> list[int]:
    """Choose goals of a scene for the explorer: trained ones, then failures, then poses far apart.

    Args:
        scene: the scene.
        trained: state ids of the trained goals; they come first, sorted.
        success: (N,) of each state as a goal, NaN where unknown; the lowest below 1 fill half of the rest.
        count: number of goals.

    Returns:
        distinct state ids, at most ``count``.

    >>> room = Scene.bundled("bathroom")
    >>> success = torch.ones(176)
    >>> success[40] = 0.5
    >>> choose_goals(room, [73, 0], success, 4)[:3]
    [0, 73, 40]
    """
    chosen = dict.fromkeys(sorted(set(trained))[:count])
    if success is not None:
        hardest = torch.nan_to_num(success, nan=2.0).argsort(stable=True).tolist()
        room = len(chosen) + (count - len(chosen)) // 2
        for goal in hardest:
            if len(chosen) >= room or not float(success[goal]) < 1.0:
                break
            chosen.setdefault(goal)
    for goal in spread_poses(scene.location, scene.rotation, scene.num_states):
        if len(chosen) >= count:
            break
        if bool((scene.distances_to(goal) > 0).any()):
            chosen.setdefault(goal)
    return list(chosen)


def choose_starts(scene: Scene, goal: int, count: int) -> list[int]:
    """Choose starts that can reach a goal: the farthest one, then nearer ones in even steps.

    >>> room = Scene.bundled("bathroom")
    >>> starts = choose_starts(room, 73, 3)
    >>> room.distance[starts, 73].tolist() == sorted(room.distance[starts, 73].tolist(), reverse=True)
    True
    """
    away = scene.distances_to(goal)[0].to(torch.int64)
    order = away.argsort(descending=True, stable=True)[: int((away > 0).sum())]
    if not order.numel():
        return []
    places = torch.linspace(0, len(order) - 1, count + 1).long()[:count].unique()
    return order[places].tolist()


def _batch(scenes: SceneSet, frames: Tensor, goal: Tensor) -> TensorDict:
    content = {"state_id": frames, "goal_id": goal, "scene_id": scenes.scene_id[goal]}
    return TensorDict(content, batch_size=goal.shape, device=scenes.device)


def _standing(
    scenes: SceneSet,
    state: Tensor,
    goal: Tensor,
    history: int,
    observe: Observe | None,
) -> Any:
    batch = _batch(scenes, start_history(state, history), goal)
    batch.set("is_init", torch.ones_like(state, dtype=torch.bool).unsqueeze(-1))
    batch.set("previous_action", torch.full_like(state, scenes.num_actions))
    return batch if observe is None else observe(batch)
