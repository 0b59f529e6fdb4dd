"""Gymnasium's and TorchRL's ways to step environments in worker processes."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AsyncVectorEnv
from torchrl.collectors import Collector
from torchrl.envs import GymWrapper, ParallelEnv

__all__ = ["async_vector", "make_gym", "parallel_env"]


def make_gym(quick: bool = False) -> gymnasium.Env[Any, Any]:
    """The task with one agent, as Gymnasium registers it."""
    return gymnasium.make("vusfa.envs:vusfa/TargetNav-v0", scenes="bathroom" if quick else None)


def _wrapped(quick: bool) -> GymWrapper:
    return GymWrapper(make_gym(quick))


def parallel_env(workers: int, quick: bool, stack: ExitStack) -> Callable[[], int]:
    """TorchRL's ParallelEnv over Gymnasium environments, in a Collector with random actions."""
    steps = 20 if quick else 200
    env = ParallelEnv(workers, partial(_wrapped, quick))
    collector = Collector(
        env,
        None,
        frames_per_batch=workers * steps,
        total_frames=-1,
        track_traj_ids=False,
        auto_register_policy_transforms=False,
    )
    stack.callback(collector.shutdown)
    batches = iter(collector)
    return lambda: next(batches).numel()


def async_vector(workers: int, quick: bool, stack: ExitStack) -> Callable[[], int]:
    """Gymnasium's AsyncVectorEnv with random actions."""
    steps = 20 if quick else 200
    envs = AsyncVectorEnv([partial(make_gym, quick)] * workers)
    stack.callback(envs.close)
    envs.reset(seed=0)
    rng = np.random.default_rng(0)

    def walk() -> int:
        for _ in range(steps):
            envs.step(rng.integers(4, size=workers))
        return steps * workers

    return walk
