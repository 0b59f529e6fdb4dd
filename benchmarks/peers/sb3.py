"""Stable-Baselines3 on the Gymnasium vector environment, as its users have it, as fast as we can make that.

Observations are features (standardised once, which only helps it). The vector environment sends ids and the
wrapper looks features up once a step; sending features from the environment itself would look them up twice
wherever an episode ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env.base_vec_env import VecEnv
from torch import Tensor, nn

from vusfa.conf.settings import MAX_STEPS
from vusfa.envs import resolve_goals
from vusfa.scenes import SceneSet

__all__ = ["SceneVecEnv", "SiameseExtractor", "make_sb3", "sb3_actions", "sb3_probabilities"]


class SceneVecEnv(VecEnv):
    """``gymnasium.make_vec("vusfa/TargetNav-v0")`` with features as observations.

    SB3 wants the first observation of the next episode at once and the last one of the old in ``infos``; the
    vector environment resets rows when it is told to, so this tells it.

    Args:
        scenes: the world.
        num_envs: environments.
        seed: of the environments' draws.
        options: of :class:`vusfa.envs.TargetNavEnv`.
    """

    def __init__(self, scenes: SceneSet, num_envs: int, seed: int = 0, **options: Any) -> None:
        table = scenes.features[:, 0]
        self._table = ((table - table.mean(0)) / table.std(0, correction=0).clamp(min=1e-3)).contiguous()
        self._envs = gymnasium.make_vec(
            "vusfa.envs:vusfa/TargetNav-v0", num_envs, "vector_entry_point", scenes=scenes, **options
        )
        self._seed: int | None = seed
        self._scenes = np.eye(scenes.num_scenes, dtype=np.float32)
        history = self._envs.single_observation_space["state_id"].shape[0]  # type: ignore[index]
        width = scenes.feature_size
        space = spaces.Dict(
            observation=spaces.Box(-np.inf, np.inf, (history, width), np.float32),
            goal=spaces.Box(-np.inf, np.inf, (width,), np.float32),
            scene=spaces.Box(0.0, 1.0, (scenes.num_scenes,), np.float32),
        )
        super().__init__(num_envs, space, self._envs.single_action_space)

    def reset(self) -> dict[str, np.ndarray]:
        """Begin episodes everywhere."""
        ids, _ = self._envs.reset(seed=self._seed)
        self._seed = None
        return self._look_up(ids)

    def step_async(self, actions: np.ndarray) -> None:
        """Remember the actions."""
        self._actions = actions

    def step_wait(self) -> Any:
        """Observations, rewards, ends, and what became of each environment."""
        ids, reward, terminated, truncated, _ = self._envs.step(self._actions)
        done = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if done.any():
            rows = done.nonzero()[0]
            last = self._look_up({key: value[rows] for key, value in ids.items()})
            for place, row in enumerate(rows):
                infos[row]["terminal_observation"] = {key: value[place] for key, value in last.items()}
                infos[row]["TimeLimit.truncated"] = bool(truncated[row] and not terminated[row])
            ids, _ = self._envs.reset(options={"reset_mask": done})
        return self._look_up(ids), reward.astype(np.float32), done, infos

    def _look_up(self, ids: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        state, goal = torch.from_numpy(ids["state_id"]), torch.from_numpy(ids["goal_id"])
        frames = self._table.index_select(0, state.reshape(-1)).view(*state.shape, -1)
        return {
            "observation": frames.numpy(),
            "goal": self._table.index_select(0, goal).numpy(),
            "scene": self._scenes[ids["scene_id"]],
        }

    def close(self) -> None:
        """End the environments."""
        self._envs.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute of each environment."""
        return [getattr(self._envs, attr_name, None)] * len(self._indices(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Not offered."""
        raise NotImplementedError

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Not offered."""
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Nothing is wrapped."""
        return [False] * len(self._indices(indices))

    def _indices(self, indices: Any) -> Sequence[int]:
        return range(self.num_envs) if indices is None else np.atleast_1d(indices)  # type: ignore[return-value]


class SiameseExtractor(BaseFeaturesExtractor):
    """Our layers up to the fusion, in SB3's way: state and goal through the same two layers, then one.

    Args:
        space: the observation space of :class:`SceneVecEnv`.
        width: of every layer.
    """

    def __init__(self, space: spaces.Dict, width: int = 512) -> None:
        super().__init__(space, features_dim=width)
        history, features = space["observation"].shape  # type: ignore[misc]
        self.history = history
        self.encoder = nn.Sequential(nn.Linear(history * features, width), nn.ReLU(), nn.Linear(width, width))
        self.fusion = nn.Sequential(nn.Linear(2 * width + space["scene"].shape[0], width), nn.ReLU())  # type: ignore[index]

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        """(B, width)."""
        state = self.encoder(observations["observation"].flatten(1))
        goal = self.encoder(observations["goal"].repeat(1, self.history))
        return self.fusion(torch.cat([state, goal, observations["scene"]], -1))


def make_sb3(
    algorithm: str,
    scenes: SceneSet,
    goals: Any = "paper",
    *,
    num_envs: int,
    width: int = 512,
    history: int = 4,
    seed: int = 0,
    **settings: Any,
) -> Any:
    """An A2C or PPO of SB3 with layers as wide as ours.

    Args:
        algorithm: "A2C" or "PPO".
        scenes, goals, num_envs, history: the task.
        width: of every layer.
        seed: of everything.
        settings: of the algorithm.
    """
    import stable_baselines3

    env = SceneVecEnv(
        scenes, num_envs, seed, goals=resolve_goals(scenes, goals), history=history, max_steps=MAX_STEPS
    )
    shape = {
        "features_extractor_class": SiameseExtractor,
        "features_extractor_kwargs": {"width": width},
        "net_arch": {"pi": [width], "vf": [width]},
        "activation_fn": nn.ReLU,
    }
    threads = torch.get_num_threads()
    kind = getattr(stable_baselines3, algorithm)
    model = kind("MultiInputPolicy", env, policy_kwargs=shape, device="cpu", seed=seed, **settings)
    torch.set_num_threads(threads)
    return model


def sb3_actions(model: Any, ids: dict[str, Tensor]) -> Tensor:
    """Sampled actions (n,) of a trained model for state, goal and scene ids; for our evaluation."""
    table: SceneVecEnv = model.get_env()
    observation = table._look_up({key: value.numpy() for key, value in ids.items()})
    return torch.from_numpy(model.predict(observation, deterministic=False)[0])


@torch.no_grad()
def sb3_probabilities(model: Any, state: Tensor, goal: Tensor, scene: Tensor) -> Tensor:
    """Probabilities (n, A) of a trained model's actions for ids (n,), of one frame each; for our exact
    evaluation."""
    table: SceneVecEnv = model.get_env()
    ids = {"state_id": state.unsqueeze(-1), "goal_id": goal, "scene_id": scene}
    observation = table._look_up({key: value.numpy() for key, value in ids.items()})
    model.policy.set_training_mode(False)
    tensors, _ = model.policy.obs_to_tensor(observation)
    return model.policy.get_distribution(tensors).distribution.probs
