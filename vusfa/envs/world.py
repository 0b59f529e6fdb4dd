"""Lookup tables and specs of :class:`vusfa.envs.TargetNavEnv`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, TensorSpec, Unbounded

from vusfa.envs.dynamics import Rewards
from vusfa.envs.rotation import Rotation
from vusfa.envs.starts import GoalTable, StartCache, StartTable, path_table, start_table
from vusfa.scenes import SceneSet

__all__ = ["STATE", "Observed", "RotatingWorld", "Specs", "World", "env_specs", "make_world", "map_tensors"]

#: Keys that the environment reads back; the last where it was asked for.
STATE = ("state_id", "goal_id", "scene_id", "elapsed_steps", "shortest_path")


class World(NamedTuple):
    """Lookup tables of an environment, no buffers, whose access takes ten times as long.

    Attributes:
        successor: (S, A) int64, where each action leads.
        blocked: (S, A) bool.
        rewards: reward of a step.
        starts: distribution of start states.
        rows: the goal of each row, columns (*B,); None when goals are drawn.
        paths: shortest paths to the goals, see :func:`~vusfa.envs.starts.path_table`.
    """

    successor: Tensor
    blocked: Tensor
    rewards: Rewards
    starts: StartTable
    rows: GoalTable | None
    paths: Tensor | None


class RotatingWorld:
    """Tables of the active scenes of a rotation, made anew at each of its turns.

    Args:
        scenes: the world.
        rotation: of its scenes.
        rewards: what a step earns.
        rows: (*B,) int64, numbers of the rows; None when goals are drawn.
        first_frame: frames of all environments before the first step.
        frames_per_step: environments of all processes together.
    """

    def __init__(
        self,
        scenes: SceneSet,
        rotation: Rotation,
        rewards: Rewards,
        rows: Tensor | None,
        first_frame: int,
        frames_per_step: int,
    ) -> None:
        self.scenes, self.rotation, self.rewards, self.rows = scenes, rotation, rewards, rows
        self.frames, self.frames_per_step = first_frame, frames_per_step
        self.turn, self._starts = -1, StartCache()

    def world(self) -> World | None:
        """The tables on the CPU where they have changed, else None."""
        turn = self.rotation.turn(self.frames)
        if turn == self.turn:
            return None
        self.turn = turn
        if self.scenes.is_lazy:
            active, coming = (set(self.rotation.scenes_at(time)) for time in (turn, turn + 1))
            self.scenes.features.prefetch(coming - active)
        rows = None if self.rows is None else self.rotation.rows_at(turn, self.rows)
        return make_world(self.scenes, self.rotation.goals_at(turn)[0], self.rewards, rows, self._starts)


def make_world(
    scenes: SceneSet, goals: Tensor, rewards: Rewards, rows: Tensor | None, known: StartCache | None = None
) -> World:
    """Gather the tables.

    Args:
        scenes: the world.
        goals: (G,) int64 global ids; a GoalError where no other state can reach one.
        rewards: what a step earns.
        rows: (*B,) int64, position of each row's goal in ``goals``, modulo G; None when goals are drawn.
        known: starts that were found before, see :func:`~vusfa.envs.starts.start_table`.

    >>> world = make_world(SceneSet.bundled("bathroom"), torch.tensor([3, 9]), Rewards.of(), torch.arange(3))
    >>> world.rows.goal
    tensor([3, 9, 3])
    """
    starts = start_table([scene.graph for scene in scenes.scenes], scenes.offsets, goals, scenes.names, known)
    return World(
        successor=scenes.successor,
        blocked=scenes.blocked,
        rewards=rewards,
        starts=starts,
        rows=None if rows is None else starts.goals.take(rows % len(goals)),
        paths=path_table(scenes, starts.goals),
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


class Observed(Composite):
    """Observation spec in which the environment's state is always carried on to the next step.

    :class:`torchrl.envs.SelectTransform` keeps the state in the data but takes it out of the observation
    spec, and ``step_mdp``, which goes by that spec, would then step from the same state for ever.

    >>> spec = Observed(state_id=Unbounded())
    >>> del spec["state_id"]
    >>> list(spec.keys()), "state_id" in spec.keys(step_mdp_static_only=True)
    ([], True)
    """

    def keys(self, *args: Any, step_mdp_static_only: bool = False, **options: Any) -> Any:
        """Keys as :class:`Composite` gives them; of those for ``step_mdp`` the state's are never missing."""
        found = super().keys(*args, step_mdp_static_only=step_mdp_static_only, **options)
        return [*found, *(key for key in STATE if key not in found)] if step_mdp_static_only else found

    def expand(self, *shape: Any) -> Observed:
        """As :class:`Composite` expands, to this class."""
        wide = super().expand(*shape)
        return Observed(dict(wide.items()), shape=wide.shape, device=wide.device)


def env_specs(scenes: SceneSet, batch_size: torch.Size, history: int, shortest_path: bool) -> Specs:
    """Describe the data of a :class:`TargetNavEnv`; its docstring lists the keys."""
    once = (*batch_size, 1)

    def ids(number: int, *more: int) -> Categorical:
        return Categorical(number, shape=(*batch_size, *more), dtype=torch.int64)

    def flags(*keys: str) -> dict[str, TensorSpec]:
        return {key: Categorical(2, shape=once, dtype=torch.bool) for key in keys}

    count = Bounded(0, torch.iinfo(torch.int64).max, shape=once, dtype=torch.int64)
    state: dict[str, TensorSpec] = {
        "state_id": ids(scenes.num_states, history),
        "goal_id": ids(scenes.num_states),
        "scene_id": ids(scenes.num_scenes),
        "elapsed_steps": count,
    }
    if shortest_path:
        state["shortest_path"] = count
    return Specs(
        state=Composite(state, shape=batch_size).clone(),
        observation=Observed({**state, **flags("collided")}, shape=batch_size).clone(),
        action=ids(scenes.num_actions),
        reward=Unbounded(shape=once, dtype=torch.float32),
        done=Composite(flags("done", "terminated", "truncated"), shape=batch_size),
    )
