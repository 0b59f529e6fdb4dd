"""The task in Gymnasium: ``gymnasium.make("vusfa/TargetNav-v0")``, and vectorized by ``make_vec``.

Each row draws its starts and goals from a NumPy generator of its own, so that row i of a vector environment
reset with seed s walks exactly like a single one reset with seed s + i.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from vusfa.envs.goals import GoalSpec
from vusfa.envs.gym_rows import Observation, Rows, Scenes, TellsLimit, observation_space
from vusfa.envs.observation import observation_table
from vusfa.errors import ActionError, ConfigError

__all__ = ["ENV_ID", "TargetNavGym", "TargetNavVector", "register"]

ENV_ID = "vusfa/TargetNav-v0"


def register() -> None:
    """Make the task known to Gymnasium; ``import vusfa.envs`` does it.

    >>> register()
    >>> gymnasium.make("vusfa.envs:vusfa/TargetNav-v0", scenes="bathroom").action_space
    Discrete(4)
    """
    if ENV_ID not in gymnasium.registry:
        entries = {name: f"vusfa.envs.gym:TargetNav{name}" for name in ("Gym", "Vector")}
        gymnasium.register(ENV_ID, entry_point=entries["Gym"], vector_entry_point=entries["Vector"])


class TargetNavVector(TellsLimit, VectorEnv[Observation, np.ndarray, np.ndarray]):
    """Target-driven visual navigation for many agents, each operation on all of them at once.

    Args:
        num_envs: n, rows.
        scenes: a :class:`SceneSet`, or bundled names and files; all bundled rooms by default.
        goals: see :mod:`vusfa.envs.goals`.
        observation: "index": ``state_id`` (n, H), ``goal_id`` (n,); "features" or "pixels": ``observation``
            (n, H, ...) and ``goal_observation``, as :class:`vusfa.envs.SceneObservation` writes them; always
            ``scene_id``.
        render_mode: "rgb_array" or None.
        panels: what to render, see :meth:`TargetNavEnv.render`.
        goal_sampling: "episode" draws a goal for each episode; with "fixed" row i keeps goal ``i % G``.
        autoreset_mode: "NextStep", Gymnasium's default: the step after an episode's end ignores the action,
            begins the next episode, and earns 0. Or "Disabled": ended rows wait for ``reset`` with a
            ``reset_mask``, as TorchRL's ``GymWrapper`` does it.
        max_episode_steps: another name of ``max_steps``, as Gymnasium passes it on from a spec.
        options: further arguments of :class:`TargetNavEnv` (history, max_steps, goal_reward, ...).

    Raises:
        ConfigError: an argument out of range.

    ``info`` holds ``collided`` and ``shortest_path``. ``reset(options={"state": 3, "goal": 80})`` begins at a
    given state (global ids).

    >>> envs = gymnasium.make_vec("vusfa/TargetNav-v0", 8, "vector_entry_point", scenes="bathroom")
    >>> envs.reset(seed=0)[0]["state_id"].shape, envs.metadata["autoreset_mode"]
    ((8, 4), <AutoresetMode.NEXT_STEP: 'NextStep'>)
    """

    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]
        "render_modes": ["rgb_array"],
        "render_fps": 4,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        scenes: Scenes | None = None,
        goals: GoalSpec = "paper",
        observation: str = "index",
        render_mode: str | None = None,
        panels: Sequence[str] | None = None,
        goal_sampling: str = "episode",
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        **options: Any,
    ) -> None:
        modes = {mode.value: mode for mode in (AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED)}
        for name, value, choices in (
            ("observation", observation, ["index", "features", "pixels"]),
            ("render_mode", render_mode, [None, "rgb_array"]),
            ("autoreset_mode", autoreset_mode, [*modes, *modes.values()]),
        ):
            if value not in choices:
                raise ConfigError(f"{name} is {value!r}; it is one of {', '.join(map(str, choices[:3]))}")
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}  # type: ignore[misc]
        if max_episode_steps is not None:
            options.setdefault("max_steps", max_episode_steps)
        self.rows = Rows(scenes, num_envs, goals=goals, goal_sampling=goal_sampling, **options)
        self.limit, self.num_envs = self.rows.max_steps, num_envs
        self.render_mode, self.panels = render_mode, panels
        world = self.rows.scenes
        self.table = None if observation == "index" else observation_table(world, observation)[:, 0].numpy()
        self.single_observation_space = observation_space(world, self.rows.history, self.table)
        self.single_action_space = gymnasium.spaces.Discrete(world.num_actions)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.ended = np.zeros(num_envs, dtype=np.bool_)
        self._seeds = [-1] * num_envs

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin episodes in all rows, or in those of ``options["reset_mask"]`` (n,) bool.

        Row i is seeded with ``seed + i``, or with the i-th of several seeds; ``options`` may hold ``state``
        and ``goal``, one for all rows or one for each.
        """
        options = dict(options or {})
        mask = np.asarray(options.pop("reset_mask", np.ones(self.num_envs, dtype=np.bool_)))
        if mask.dtype != np.bool_ or mask.shape != (self.num_envs,) or not mask.any():
            raise ConfigError(f"reset_mask is {mask!r}; give ({self.num_envs},) bool with at least one True")
        if isinstance(seed, Sequence):
            seeds = list(seed)
        else:
            seeds = [None if seed is None else seed + row for row in range(self.num_envs)]
        if len(seeds) != self.num_envs:
            raise ConfigError(
                f"{len(seeds)} seeds for {self.num_envs} environments; give one number, or one each"
            )
        for row, row_seed in enumerate(seeds):
            if mask[row] and (row_seed is not None or self.rows.rngs[row] is None):
                self.rows.rngs[row], self._seeds[row] = seeding.np_random(row_seed)
        self.rows.begin(mask, options)
        self.ended = self.ended & ~mask
        return self._observe(), self._info(mask)

    def step(
        self, actions: np.ndarray
    ) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Move every row by its action (n,), or begin its next episode if it ended with the step before."""
        again, actions = self.ended, np.asarray(actions)
        if self.rows.data.is_empty():
            raise ConfigError("step() was called before reset(); call reset() first")
        if actions.shape != (self.num_envs,):
            raise ActionError(f"actions are of shape {actions.shape}; give one each, ({self.num_envs},)")
        if again.any() and self.autoreset_mode == AutoresetMode.DISABLED:
            raise ConfigError(
                f"the episode of row {int(again.argmax())} is over; reset it with a reset_mask, or make"
                " the environment with autoreset_mode='NextStep'"
            )
        reward, terminated, truncated = self.rows.move(
            np.where(again, 0, actions) if again.any() else actions
        )
        if again.any():
            self.rows.begin(again, {})
            reward = np.where(again, 0, reward)
            terminated, truncated = terminated & ~again, truncated & ~again
        self.ended = terminated | truncated
        return self._observe(), reward, terminated, truncated, self._info(np.ones_like(again))

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture of each row, (h, w, 3) uint8; None without a render mode."""
        if self.render_mode is None:
            return None
        return tuple(self.rows.render(self.rows.data, row, self.panels) for row in range(self.num_envs))

    @property  # type: ignore[misc]
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """The generators of the rows."""
        return tuple(self.rows.rngs)

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """The seeds of the rows."""
        return tuple(self._seeds)

    def _observe(self) -> Observation:
        keys = ("state_id", "goal_id", "scene_id")
        state, goal, scene = (self.rows.data.get(key).numpy().copy() for key in keys)
        if self.table is None:
            return {"state_id": state, "goal_id": goal, "scene_id": scene}
        return {"observation": self.table[state], "goal_observation": self.table[goal], "scene_id": scene}

    def _info(self, mask: np.ndarray) -> dict[str, Any]:
        info: dict[str, Any] = {}
        for key in ("collided", "shortest_path"):
            value = self.rows.data.get(key)[:, 0].numpy()
            info[key] = np.where(mask, value, np.zeros_like(value))
            info[f"_{key}"] = mask.copy()
        return info


class TargetNavGym(TellsLimit, gymnasium.Env[Observation, np.int64]):
    """Target-driven visual navigation for one agent.

    Arguments, observations (without their first dimension) and infos are those of :class:`TargetNavVector`.

    >>> env = gymnasium.make("vusfa/TargetNav-v0", scenes="bathroom", goals=[73])
    >>> observation, info = env.reset(options={"state": 72, "goal": 73})
    >>> observation["goal_id"], info["shortest_path"]
    (np.int64(73), 1)
    >>> _, reward, terminated, truncated, _ = env.step(1)
    >>> reward, terminated, truncated
    (1.0, True, False)
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 4}  # type: ignore[misc]

    def __init__(
        self,
        scenes: Scenes | None = None,
        goals: GoalSpec = "paper",
        observation: str = "index",
        **options: Any,
    ) -> None:
        self._one = TargetNavVector(1, scenes, goals, observation, **options)
        self.limit, self.render_mode = self._one.limit, self._one.render_mode
        self.observation_space = self._one.single_observation_space
        self.action_space = self._one.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode; ``options`` may hold ``state`` and ``goal``."""
        super().reset(seed=seed)
        self._one.rows.rngs[0] = self.np_random
        return self._first(*self._one.reset(options=options))

    def step(self, action: np.int64) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Move by one action."""
        self._one.ended[:] = False  # stepping on after an episode's end is the caller's affair
        observation, reward, *ends, info = self._one.step(np.array([action]))
        terminated, truncated = (bool(end[0]) for end in ends)
        observation, info = self._first(observation, info)
        return observation, float(reward[0]), terminated, truncated, info

    @staticmethod
    def _first(observation: Observation, info: dict[str, Any]) -> tuple[Observation, dict[str, Any]]:
        facts = {key: value[0].item() for key, value in info.items() if not key.startswith("_")}
        return {key: value[0] for key, value in observation.items()}, facts

    def render(self) -> np.ndarray | None:
        """The picture that ``panels`` describe, (h, w, 3) uint8; None without a render mode."""
        pictures = self._one.render()
        return None if pictures is None else pictures[0]
