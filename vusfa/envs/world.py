"""Lookup tables and specs of :class:`vusfa.envs.TargetNavEnv`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, TensorSpec, Unbounded

from vusfa.envs.dynamics import Rewards
from vusfa.envs.starts import GoalTable, StartTable, start_table
from vusfa.scenes import SceneSet

__all__ = ["Specs", "World", "env_specs", "make_world", "map_tensors"]


class World(NamedTuple):
    """Lookup tables of an environment. No buffers: access to those takes ten times as long.

    Attributes:
        successor: (S, A) int64, where each action leads.
        blocked: (S, A) bool.
        rewards: reward of a step.
        starts: distribution of start states.
        rows: the goal of each row, columns (*B,); None when goals are drawn.
        distance: shortest paths, flat, scene after scene (``SceneSet.distance_tables``).
    """

    successor: Tensor
    blocked: Tensor
    rewards: Rewards
    starts: StartTable
    rows: GoalTable | None
    distance: Tensor


def make_world(scenes: SceneSet, goals: Tensor, rewards: Rewards, rows: Tensor | None) -> World:
    """Gather the tables.

    Args:
        scenes: the world.
        goals: (G,) int64 global ids.
        rewards: what a step earns.
        rows: (*B,) int64, the position of each row's goal in ``goals``, taken modulo G; None when goals are
            drawn.

    Raises:
        GoalError: no other state can reach a goal.

    >>> world = make_world(SceneSet.bundled("bathroom"), torch.tensor([3, 9]), Rewards.of(), torch.arange(3))
    >>> world.rows.goal
    tensor([3, 9, 3])
    """
    graphs = [scene.graph for scene in scenes.scenes]
    starts = start_table(graphs, scenes.offsets, goals, scenes.names)
    return World(
        successor=scenes.successor,
        blocked=scenes.blocked,
        rewards=rewards,
        starts=starts,
        rows=None if rows is None else starts.goals.take(rows % len(goals)),
        distance=scenes.distance_tables[0],
    )


def map_tensors(function: Callable[[Tensor], Tensor], tables: Any) -> Any:
    """Apply a function to every tensor of nested named tuples; None stays None.

    >>> map_tensors(torch.neg, Rewards.of(goal=1.0, step=0.5)).goal
    tensor(-1.)
    """
    if isinstance(tables, Tensor):
        return function(tables)
    return None if tables is None else type(tables)(*(map_tensors(function, entry) for entry in tables))


class Specs(NamedTuple):
    """TorchRL specs of an environment's data."""

    state: Composite
    observation: Composite
    action: TensorSpec
    reward: TensorSpec
    done: Composite


def env_specs(scenes: SceneSet, batch_size: torch.Size, history: int) -> Specs:
    """Describe the data of a :class:`TargetNavEnv`; its docstring lists the keys.

    The state, which the environment needs back at every step because it keeps none, is all that it observes
    but ``collided``.
    """
    once = (*batch_size, 1)

    def count() -> Bounded:
        return Bounded(0, torch.iinfo(torch.int64).max, shape=once, dtype=torch.int64)

    def ids(number: int, *more: int) -> Categorical:
        return Categorical(number, shape=(*batch_size, *more), dtype=torch.int64)

    def truth() -> Categorical:
        return Categorical(2, shape=once, dtype=torch.bool)

    def state() -> dict[str, TensorSpec]:
        return {
            "state_id": ids(scenes.num_states, history),
            "goal_id": ids(scenes.num_states),
            "scene_id": ids(scenes.num_scenes),
            "shortest_path": count(),
            "step_count": count(),
        }

    return Specs(
        state=Composite(state(), shape=batch_size),
        observation=Composite({**state(), "collided": truth()}, shape=batch_size),
        action=ids(scenes.num_actions),
        reward=Unbounded(shape=once, dtype=torch.float32),
        done=Composite({key: truth() for key in ("done", "terminated", "truncated")}, shape=batch_size),
    )
