"""The same task for Gymnasium: ``gymnasium.make("vusfa/TargetNav-v0")``, and a true vector version by
``make_vec``.

Both are thin: they hold a batched :class:`TargetNavEnv` and speak NumPy. Each row draws its starts and goals
from a NumPy generator of its own, so that row i of a vector environment reset with seed s walks exactly like
a single one reset with seed s + i.
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
from vusfa.envs.gym_task import GymTask, Observation, Scenes, TellsLimit
from vusfa.errors import ConfigError

__all__ = ["ENV_ID", "TargetNavGym", "TargetNavVector", "register"]

ENV_ID = "vusfa/TargetNav-v0"


def register() -> None:
    """Make the task known to Gymnasium; ``import vusfa.envs`` does it.

    >>> register()
    >>> gymnasium.make("vusfa.envs:vusfa/TargetNav-v0", scenes="bathroom").action_space
    Discrete(4)
    """
    if ENV_ID not in gymnasium.registry:
        gymnasium.register(
            ENV_ID,
            entry_point="vusfa.envs.gym:TargetNavGym",
            vector_entry_point="vusfa.envs.gym:TargetNavVector",
        )


class TargetNavGym(TellsLimit, gymnasium.Env[Observation, np.int64]):
    """Walk to the place where a picture was taken, one agent.

    Args:
        scenes: a :class:`SceneSet`, or bundled names and files; all bundled rooms by default.
        goals: see :mod:`vusfa.envs.goals`.
        observation: "index": ``state_id`` (H,), ``goal_id``; "features" or "pixels": ``observation`` (H, ...)
            and ``goal_observation``, as :class:`vusfa.envs.SceneObservation` writes them; always
            ``scene_id``.
        render_mode: "rgb_array" or None.
        panels: what to render, see :meth:`TargetNavEnv.render`.
        goal_sampling: "episode" draws a goal for each episode, "fixed" keeps one.
        options: further arguments of :class:`TargetNavEnv` (history, max_steps, goal_reward, ...).

    ``info`` holds ``collided`` and ``shortest_path``. ``reset(options={"state": 3, "goal": 80})`` begins at a
    state of one's choice (global ids).

    >>> env = gymnasium.make("vusfa/TargetNav-v0", scenes="bathroom", goals=[73])
    >>> observation, info = env.reset(options={"state": 72, "goal": 73})
    >>> observation["goal_id"], info["shortest_path"]
    (np.int64(73), 1)
    >>> _, reward, terminated, truncated, _ = env.step(1)
    >>> reward, terminated, truncated
    (1.0, True, False)
    """

    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]
        "render_modes": ["rgb_array"],
        "render_fps": 4,
    }

    def __init__(
        self,
        scenes: Scenes | None = None,
        goals: GoalSpec = "paper",
        observation: str = "index",
        render_mode: str | None = None,
        panels: Sequence[str] | None = None,
        goal_sampling: str = "episode",
        **options: Any,
    ) -> None:
        options = {"goals": goals, "goal_sampling": goal_sampling, **options}
        self._task = GymTask(scenes, 1, observation, render_mode, panels, options)
        self.render_mode = render_mode
        self.observation_space = self._task.observation_space
        self.action_space = self._task.action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode; ``options`` may hold ``state`` and ``goal``."""
        super().reset(seed=seed)
        self._task.rows.rngs[0] = self.np_random
        self._task.begin(np.ones(1, dtype=np.bool_), options)
        return self._observe(), self._info()

    def step(self, action: np.int64) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Move by one action."""
        reward, terminated, truncated = self._task.step(np.array([action]))
        return self._observe(), float(reward[0]), bool(terminated[0]), bool(truncated[0]), self._info()

    def render(self) -> np.ndarray | None:
        """The picture that ``panels`` describe, (h, w, 3) uint8; None without a render mode."""
        return None if self.render_mode is None else self._task.render(0)

    def _observe(self) -> Observation:
        return {key: value[0] for key, value in self._task.observe().items()}

    def _info(self) -> dict[str, Any]:
        return {key: value[0].item() for key, value in self._task.info().items()}


class TargetNavVector(TellsLimit, VectorEnv[Observation, np.ndarray, np.ndarray]):
    """Walk to the place where a picture was taken, many agents in one tensor operation each.

    Arguments are those of :class:`TargetNavGym`; with ``goal_sampling="fixed"`` row i keeps goal ``i % G``.
    Further ones:

    Args:
        num_envs: rows.
        autoreset_mode: "NextStep", Gymnasium's default: the step after an episode's end ignores the action,
            begins the next episode, and earns 0. Or "Disabled": ended rows wait for ``reset`` with a
            ``reset_mask``, as TorchRL's ``GymWrapper`` does it.
        max_episode_steps: another name of ``max_steps``, as Gymnasium passes it on from a spec.

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
        if autoreset_mode not in (*modes, *modes.values()):
            raise ConfigError(f"autoreset_mode is {autoreset_mode!r}; it is one of {', '.join(modes)}")
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}  # type: ignore[misc]
        if max_episode_steps is not None:
            options.setdefault("max_steps", max_episode_steps)
        options = {"goals": goals, "goal_sampling": goal_sampling, **options}
        self._task = GymTask(scenes, num_envs, observation, render_mode, panels, options)
        self._ended = np.zeros(num_envs, dtype=np.bool_)
        self._seeds = [-1] * num_envs
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.single_observation_space = self._task.observation_space
        self.single_action_space = self._task.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

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
            if mask[row] and (row_seed is not None or self._task.rows.rngs[row] is None):
                self._task.rows.rngs[row], self._seeds[row] = seeding.np_random(row_seed)
        self._task.begin(mask, options)
        self._ended = self._ended & ~mask
        return self._task.observe(), self._info(mask)

    def step(
        self, actions: np.ndarray
    ) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Move every row by its action (n,), or begin its next episode if it ended with the step before."""
        again = self._ended
        if again.any():
            if self.autoreset_mode == AutoresetMode.DISABLED:
                raise ConfigError(
                    f"the episode of row {int(again.argmax())} is over; reset it with"
                    " options={'reset_mask': ...}, or make the environment with autoreset_mode='NextStep'"
                )
            actions = np.where(again, 0, actions)
        reward, terminated, truncated = self._task.step(actions)
        if again.any():
            self._task.begin(again, None)
            reward, terminated, truncated = (np.where(again, 0, x) for x in (reward, terminated, truncated))
            terminated, truncated = terminated.astype(np.bool_), truncated.astype(np.bool_)
        self._ended = terminated | truncated
        return self._task.observe(), reward, terminated, truncated, self._info(np.ones_like(again))

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture of each row; None without a render mode."""
        return None if self.render_mode is None else tuple(map(self._task.render, range(self.num_envs)))

    @property  # type: ignore[misc]
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """The generators of the rows."""
        return tuple(self._task.rows.rngs)

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """The seeds of the rows."""
        return tuple(self._seeds)

    def _info(self, mask: np.ndarray) -> dict[str, Any]:
        info: dict[str, Any] = {}
        for key, value in self._task.info().items():
            info[key] = np.where(mask, value, np.zeros_like(value))
            info[f"_{key}"] = mask.copy()
        return info
