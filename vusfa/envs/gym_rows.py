"""Base of the Gymnasium environments: a batched environment with NumPy inputs and outputs, and its spaces."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from os import PathLike
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from tensordict import TensorDict
from torch import Tensor

from vusfa.envs.navigation import TargetNavEnv
from vusfa.envs.starts import DRAW_LIMIT
from vusfa.errors import ConfigError
from vusfa.limits import brief
from vusfa.scenes import SceneSet

__all__ = ["Observation", "Rows", "Scenes", "TellsLimit", "observation_space"]

Scenes = SceneSet | str | PathLike[str] | Sequence[str | PathLike[str]]
Observation = dict[str, Any]


class Rows(TargetNavEnv):
    """A batched environment that keeps its data, and whose rows draw from NumPy generators of their own."""

    def __init__(self, scenes: Scenes | None, num_rows: int, **options: Any) -> None:
        if not isinstance(scenes, SceneSet):
            scenes = SceneSet.bundled() if scenes is None else SceneSet.open(scenes)
        super().__init__(scenes, batch_size=[num_rows], shortest_path=True, **options)
        self.rngs: list[Any] = [None] * num_rows
        self.drawing = np.zeros(num_rows, dtype=np.bool_)
        self.data = TensorDict(batch_size=[num_rows])

    def _draw(self, *count: int) -> Tensor:
        draws = np.zeros((self.numel(), *count), dtype=np.int64)
        for row in self.drawing.nonzero()[0]:
            draws[row] = self.rngs[row].integers(DRAW_LIMIT, size=count)
        return torch.from_numpy(np.moveaxis(draws, 0, -1))

    def begin(self, mask: np.ndarray, chosen: dict[str, Any]) -> None:
        """New episodes in the rows of the mask: at the ``state`` towards the ``goal`` chosen, or drawn."""
        self.drawing = mask
        if chosen and set(chosen) != {"state", "goal"}:
            raise ConfigError(f"reset options are {brief([*chosen])}; give 'state' and 'goal', or neither")
        fresh = self.set_state(**chosen) if chosen else self.reset()
        self.data = fresh if mask.all() else torch.where(torch.from_numpy(mask), fresh, self.data)

    def move(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Move every row; its reward (float64), termination and truncation, (n,) each."""
        self.data.set("action", torch.from_numpy(actions))
        after = super().step(self.data).get("next")
        keys = ("reward", "terminated", "truncated")
        reward, terminated, truncated = (after.get(key)[:, 0].numpy() for key in keys)
        self.data = after.exclude("reward")
        return reward.astype(np.float64), terminated, truncated


def observation_space(world: SceneSet, history: int, table: np.ndarray | None) -> spaces.Dict:
    """Observation space of one row: ids, or the table's entries (features or pixels)."""
    scene = spaces.Discrete(world.num_scenes)
    if table is None:
        state = spaces.MultiDiscrete([world.num_states] * history)
        return spaces.Dict(state_id=state, goal_id=spaces.Discrete(world.num_states), scene_id=scene)
    low, high = (0, 255) if table.dtype == np.uint8 else (table.min(), table.max())
    box: dict[str, Any] = {"low": low, "high": high, "dtype": table.dtype.type}
    return spaces.Dict(
        observation=spaces.Box(shape=(history, *table.shape[1:]), **box),
        goal_observation=spaces.Box(shape=table.shape[1:], **box),
        scene_id=scene,
    )


class TellsLimit:
    """Mixin: the environment's ``EnvSpec`` has the task's ``limit`` of actions as ``max_episode_steps``."""

    limit: int
    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """The spec that Gymnasium made it from, with the limit in effect."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = copy.deepcopy(spec)
        if self._spec is not None:
            self._spec.max_episode_steps = min(self.limit, self._spec.max_episode_steps or self.limit)
