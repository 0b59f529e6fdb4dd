"""Data collection: in one process, or in several that wait for each other or run asynchronously.

===============  ============================================================================================
``single``       the environments step in this process. Runs repeat number for number, and resume so.
``multi_sync``   worker processes collect with the same weights and wait for each other; a batch has all rows.
``multi_async``  worker processes never wait: a batch has the rows of the first that is ready. Weights are in
                 shared memory, so an update reaches workers in mid-rollout: A3C.
``ray``          as ``multi_sync``; the workers are actors of Ray: :mod:`vusfa.cluster.ray_workers`.
``hogwild``      worker processes train, too: :mod:`vusfa.training.hogwild`.
===============  ============================================================================================

Rows get the same goals however they are spread over processes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.collectors import BaseCollector, Collector, MultiAsyncCollector, MultiSyncCollector
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.transforms import Compose, Transform

from vusfa.cluster.ray_workers import RayWorkers
from vusfa.envs import TargetNavEnv
from vusfa.errors import CheckpointError, ConfigError, WorkerError
from vusfa.limits import MAX_BATCH_FRAMES, brief
from vusfa.scenes import SceneSet, check_home
from vusfa.torchrl_private import carrier, end_weight_sharing, put_carrier
from vusfa.training.content import check_like, mended, restore
from vusfa.training.workers import begin_worker, started, watch

__all__ = [
    "KINDS",
    "check_goals_dealt",
    "close_collector",
    "collector_state",
    "coming_goals",
    "load_collector_state",
    "make_collector",
    "make_env",
    "opened",
    "rows_per_worker",
]

KINDS = ("single", "multi_sync", "multi_async", "ray", "hogwild")

MakeEnv = Callable[..., EnvBase]


def make_env(scenes: SceneSet, transforms: Sequence[Transform] = (), **settings: Any) -> EnvBase:
    """Environment of the task, with the transforms that the agent needs.

    Args:
        scenes: the world.
        transforms: of the agent, such as an LSTM's first state; put around copies, so that each worker has
            its own.
        settings: of :class:`~vusfa.envs.TargetNavEnv`.

    >>> make_env(SceneSet.bundled(["bathroom"]), batch_size=[5], history=1).batch_size
    torch.Size([5])
    """
    env = TargetNavEnv(scenes, shortest_path=True, **settings)
    if not transforms:
        return env
    return TransformedEnv(env, Compose(*(transform.clone() for transform in transforms)))


def rows_per_worker(kind: str, num_envs: int, num_workers: int, rollout: int = 1) -> int:
    """Number of environments per worker.

    Raises:
        ConfigError: unknown kind, no steps, or the environments cannot be shared out evenly.

    >>> rows_per_worker("multi_sync", num_envs=40, num_workers=2)
    20
    """
    if kind not in KINDS:
        raise ConfigError(f"collector.kind is {kind!r}; it must be one of {', '.join(KINDS)}")
    if num_envs < 1 or num_workers < 1:
        raise ConfigError(
            f"collector.num_envs is {num_envs} and collector.num_workers {num_workers}; both must be 1 or"
            " more"
        )
    if rollout < 1:
        raise ConfigError(f"collector.rollout is {rollout}; it must be 1 or more")
    if num_envs * rollout > MAX_BATCH_FRAMES:
        raise ConfigError(
            f"collector.num_envs is {brief(num_envs)} and collector.rollout {brief(rollout)}; a batch has"
            f" at most {MAX_BATCH_FRAMES:,} frames"
        )
    if kind == "single":
        return num_envs
    if num_envs % num_workers:
        raise ConfigError(
            f"collector.num_envs={num_envs} cannot be shared out among collector.num_workers={num_workers};"
            " make it a multiple"
        )
    return num_envs // num_workers


def check_goals_dealt(num_goals: int, num_envs: int, goal_sampling: str) -> None:
    """Check that every goal has an environment, where each environment keeps its goal.

    >>> check_goals_dealt(num_goals=5, num_envs=4, goal_sampling="fixed")
    Traceback (most recent call last):
    ...
    vusfa.errors.ConfigError: collector.num_envs=4 leaves some of the 5 goals without an environment; give ...
    """
    if goal_sampling == "fixed" and num_envs < num_goals:
        raise ConfigError(
            f"collector.num_envs={num_envs} leaves some of the {num_goals} goals without an environment;"
            f" give {num_goals} or more, or env.goal_sampling=episode"
        )


def make_collector(
    kind: str,
    make_env: MakeEnv,
    policy: TensorDictModuleBase,
    *,
    num_envs: int,
    rollout: int,
    num_workers: int = 1,
    seed: int = 0,
    autocast: bool = False,
    timeout: float | None = None,
    first_goal: int = 0,
    address: str | None = None,
    resources: Mapping[str, float] | None = None,
) -> BaseCollector:
    """Make a collector that never ends; the caller counts the frames.

    Args:
        kind: ``"single"``, ``"multi_sync"``, ``"multi_async"`` or ``"ray"``.
        make_env: called with ``batch_size``, ``first_goal`` and ``seed``, in the worker; picklable.
        policy: writes ``action``; workers get its weights through shared memory.
        num_envs: environments in all.
        rollout: steps T of each environment in a batch; ``multi_async`` gives batches of num_envs /
            num_workers x T frames, the others of num_envs x T.
        num_workers: worker processes, of all kinds but ``single``.
        seed: of the environments and the workers' draws of actions.
        autocast: workers compute in bfloat16 where that is safe; in this process the caller decides, by
            collecting within :class:`torch.autocast`.
        timeout: seconds after which a worker that sends nothing counts as dead; None: never.
        first_goal: of the first environment, where each keeps its goal (``single``).
        address, resources: of :class:`~vusfa.cluster.ray_workers.RayWorkers`, for ``ray``.

    Raises:
        ConfigError: see :func:`rows_per_worker`; the policy's agent was made for other scenes; for ``ray``
            also :func:`~vusfa.cluster.ray_workers.connected`.
        WorkerError: the workers cannot start.
    """
    rows = rows_per_worker(kind, num_envs, num_workers, rollout)
    shared: dict[str, Any] = {
        "total_frames": -1,
        "auto_register_policy_transforms": False,
        "use_buffers": True,
    }
    # Made here in any case: what is wrong with the settings then shows as an error of ours, not as a
    # worker's.
    env = make_env(batch_size=[rows], first_goal=first_goal, seed=seed)
    check_home(policy, env)
    if kind == "single":
        # Told where everything is, the collector does not copy each step to see that it is there.
        shared |= {"device": env.device, "track_traj_ids": False}
        return Collector(env, policy, frames_per_batch=rows * rollout, **shared)
    makers = [
        partial(make_env, batch_size=[rows], first_goal=worker * rows, seed=seed + worker)
        for worker in range(num_workers)
    ]
    if kind == "ray":
        given: dict[str, Any] = {"seed": seed, "autocast": autocast, "timeout": timeout, "address": address}
        given |= {"frames_per_batch": num_envs * rollout, "resources": resources or {}}
        workers: Any = RayWorkers(makers, policy, **given)
        return workers
    threads = torch.get_num_threads()  # without num_threads= the collector takes some of this process's away
    shared |= {
        "num_threads": threads,
        "num_sub_threads": 1,
        "init_fn": partial(begin_worker, autocast),
    }
    with started(None if timeout is None else max(timeout, 120.0)):
        if kind == "multi_sync":
            collector: BaseCollector = MultiSyncCollector(
                makers, policy, frames_per_batch=num_envs * rollout, cat_results=0, **shared
            )
        else:
            collector = MultiAsyncCollector(makers, policy, frames_per_batch=rows * rollout, **shared)
        collector.set_seed(seed)
    watch(collector, timeout)
    return collector


@contextmanager
def opened(make: Callable[[], BaseCollector]) -> Iterator[BaseCollector]:
    """Context manager of a collector, whose processes end with the context.

    A collector with workers changes this process's number of threads, which is restored.
    """
    threads = torch.get_num_threads()
    try:
        collector = make()
        try:
            yield collector
        except WorkerError:
            for worker in getattr(collector, "procs", ()):  # they would wait for the one that is gone
                with suppress(ValueError):
                    worker.kill()
            raise
        finally:
            close_collector(collector)
    finally:
        torch.set_num_threads(threads)


def close_collector(collector: BaseCollector) -> None:
    """End a collector's processes."""
    collector.shutdown()
    if not isinstance(collector, RayWorkers):
        end_weight_sharing(collector)  # an exception's traceback is enough to keep it alive


def coming_goals(collector: Collector) -> Tensor:
    """Goals (G,) that a collector's next batch can have: of episodes that go on, and of those to come."""
    env = _base(collector.env)
    goals = env.coming_goals(collector.requested_frames_per_batch // env.numel())
    if env.goals is goals:
        return goals
    return torch.cat([goals, carrier(collector).get("goal_id").cpu().flatten()]).unique()


def collector_state(collector: BaseCollector) -> dict[str, Any]:
    """State of the environments, as tensors and plain data.

    Empty for a collector with workers, which begins new episodes when it resumes.
    """
    if not isinstance(collector, Collector):
        return {}
    stands = carrier(collector)
    return {
        "env": dict(collector.env.state_dict()),
        "generator": _base(collector.env).get_rng_state(),
        "batch_size": list(stands.batch_size),
        "carrier": stands.to_dict(),
    }


def load_collector_state(
    collector: BaseCollector, state: dict[str, Any], path: str | Path = "the checkpoint"
) -> None:
    """Restore what :func:`collector_state` gave; nothing for a collector with workers.

    Args:
        collector: new, or one that has collected.
        state: of a collector of the same kind and settings; where ``env`` and ``generator`` are None, its
            own draws go on.
        path: of the checkpoint, for messages.

    Raises:
        CheckpointError: the state is of environments in another number, or damaged.
    """
    if not isinstance(collector, Collector) or not state:
        return
    own = collector_state(collector)
    anew = [name for name in ("env", "generator") if state.get(name, own) is None]
    state = {**state, **{name: own[name] for name in anew}}
    if not isinstance(state.get("carrier"), dict):
        raise mended(path, "its entry 'collector.carrier' is missing")
    if state.get("batch_size") != own["batch_size"]:
        raise CheckpointError(
            f"the checkpoint holds {brief(state.get('batch_size'))} environments, the collector"
            f" {own['batch_size']}; leave collector.num_envs as it was"
        )
    known = own["carrier"]
    stands = {name: value for name, value in state["carrier"].items() if name in known}
    if "action" in known:  # a checkpoint from before the first step has none
        stands.setdefault("action", known["action"])
    check_like(path, "collector", {**state, "carrier": stands}, own)
    for name, value in state["carrier"].items():
        spec = collector.env.observation_spec.get(name, None)
        if spec is not None and not value.is_floating_point() and not spec.is_in(value):
            raise mended(path, f"its entry 'collector.carrier.{name}' is out of range")
    restore(path, "collector.env", collector.env.load_state_dict, state["env"])
    restore(path, "collector.generator", _base(collector.env).set_rng_state, state["generator"])
    put_carrier(collector, state["carrier"])


def _base(env: EnvBase) -> TargetNavEnv:
    return env.base_env if isinstance(env, TransformedEnv) else env
