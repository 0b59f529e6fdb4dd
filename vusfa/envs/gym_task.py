"""Common part of the single and the vector Gymnasium environment: a batched environment, in NumPy."""

from __future__ import annotations

import copy
import reprlib
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
from vusfa.envs.observation import observation_table
from vusfa.envs.starts import DRAW_LIMIT
from vusfa.errors import ActionError, ConfigError
from vusfa.scenes import SceneSet

__all__ = ["GymTask", "Observation", "Scenes", "TellsLimit"]

Scenes = SceneSet | str | PathLike[str] | Sequence[str | PathLike[str]]
Observation = dict[str, Any]


class _Rows(TargetNavEnv):
    """A batched environment whose rows draw from generators of their own, as Gymnasium's seeding has it."""

    def __init__(self, scenes: Scenes | None, num_rows: int, **options: Any) -> None:
        if not isinstance(scenes, SceneSet):
            scenes = SceneSet.bundled() if scenes is None else SceneSet.open(scenes)
        super().__init__(scenes, batch_size=[num_rows], shortest_path=True, **options)
        self.rngs: list[Any] = [None] * num_rows
        self.drawing = np.zeros(num_rows, dtype=np.bool_)

    def _draw(self, *count: int) -> Tensor:
        draws = np.zeros((self.numel(), *count), dtype=np.int64)
        for row in self.drawing.nonzero()[0]:
            draws[row] = self.rngs[row].integers(DRAW_LIMIT, size=count)
        return torch.from_numpy(np.moveaxis(draws, 0, -1))


class TellsLimit:
    """Base of environments whose Gymnasium ``EnvSpec`` tells the task's limit of actions."""

    _task: GymTask
    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """What Gymnasium made it from; ``max_episode_steps`` is the limit in effect."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None:
            limits = [self._task.rows.max_steps, spec.max_episode_steps]
            spec = copy.deepcopy(spec)
            spec.max_episode_steps = min(limit for limit in limits if limit is not None)
        self._spec = spec


class GymTask:
    """Rows of a batched environment, their data and their observations."""

    def __init__(
        self,
        scenes: Scenes | None,
        num_rows: int,
        observation: str,
        render_mode: str | None,
        panels: Sequence[str] | None,
        options: dict[str, Any],
    ) -> None:
        if observation not in ("index", "features", "pixels"):
            raise ConfigError(f"observation is {observation!r}; it is 'index', 'features' or 'pixels'")
        if render_mode not in (None, "rgb_array"):
            raise ConfigError(f"render_mode is {render_mode!r}; it is None or 'rgb_array'")
        self.rows = _Rows(scenes, num_rows, **options)
        self.panels = panels
        self.data = TensorDict(batch_size=[num_rows])
        world = self.rows.scenes
        self.table = None if observation == "index" else observation_table(world, observation)[:, 0].numpy()
        self.observation_space = self._space()
        self.action_space = spaces.Discrete(world.num_actions)

    def _space(self) -> spaces.Dict:
        world, history = self.rows.scenes, self.rows.history
        scene = spaces.Discrete(world.num_scenes)
        if self.table is None:
            return spaces.Dict(
                state_id=spaces.MultiDiscrete([world.num_states] * history),
                goal_id=spaces.Discrete(world.num_states),
                scene_id=scene,
            )
        is_pixels = self.table.dtype == np.uint8
        low, high = (0, 255) if is_pixels else (self.table.min(), self.table.max())
        box: dict[str, Any] = {"low": low, "high": high, "dtype": self.table.dtype.type}
        return spaces.Dict(
            observation=spaces.Box(shape=(history, *self.table.shape[1:]), **box),
            goal_observation=spaces.Box(shape=self.table.shape[1:], **box),
            scene_id=scene,
        )

    def begin(self, mask: np.ndarray, options: dict[str, Any] | None) -> None:
        """New episodes in the rows of the mask: at a chosen ``state`` towards a chosen ``goal``, or drawn."""
        self.rows.drawing = mask
        chosen = options or {}
        if chosen and set(chosen) != {"state", "goal"}:
            raise ConfigError(
                f"reset options are {reprlib.repr([*chosen])}; give 'state' and 'goal', or neither"
            )
        fresh = self.rows.set_state(**chosen) if chosen else self.rows.reset()
        self.data = fresh if mask.all() else torch.where(torch.from_numpy(mask), fresh, self.data)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Move every row; its reward (float64), termination and truncation, (n,) each."""
        if self.data.is_empty():
            raise ConfigError("step() was called before reset(); call reset() first")
        action = np.asarray(action)
        if action.shape != (self.rows.numel(),):
            raise ActionError(f"actions are of shape {action.shape}; give one each, {(self.rows.numel(),)}")
        self.data.set("action", torch.from_numpy(action))
        after = self.rows.step(self.data).get("next")
        reward, terminated, truncated = (
            after.get(key)[:, 0].numpy() for key in ("reward", "terminated", "truncated")
        )
        self.data = after.exclude("reward")
        return reward.astype(np.float64), terminated, truncated

    def observe(self) -> Observation:
        """What the rows see, (n, ...) each."""
        state, goal, scene = (self.data.get(key).numpy() for key in ("state_id", "goal_id", "scene_id"))
        if self.table is None:
            return {"state_id": state.copy(), "goal_id": goal.copy(), "scene_id": scene.copy()}
        return {
            "observation": self.table[state],
            "goal_observation": self.table[goal],
            "scene_id": scene.copy(),
        }

    def info(self) -> dict[str, np.ndarray]:
        """Additional facts about the rows, (n,) each."""
        collided, path = (self.data.get(key)[:, 0].numpy() for key in ("collided", "shortest_path"))
        return {"collided": collided.copy(), "shortest_path": path.copy()}

    def render(self, row: int) -> np.ndarray:
        """A picture of one row, (h, w, 3) uint8."""
        return self.rows.render(self.data, row, self.panels)
