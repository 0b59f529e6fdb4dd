"""``collector=ray``: environments in actors of a Ray cluster (https://docs.ray.io); the connection to one.

Needs Ray, the extra ``cluster``; without it nothing here imports it.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from concurrent.futures import TimeoutError as Overdue
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from types import ModuleType
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from vusfa.errors import ConfigError, VusfaError, WorkerError
from vusfa.limits import brief

__all__ = ["RayWorkers", "check_ray_address", "connected", "import_ray"]

#: Seconds that the machine at an address gets to answer, and Ray on it.
_ANSWER, _RAY_ANSWER = 5.0, 15.0


def import_ray() -> ModuleType:
    """The package ``ray``.

    Raises:
        ConfigError: it is not installed.
    """
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # Ray then leaves CUDA's variable alone
    try:
        import ray
    except ImportError as error:
        raise ConfigError(f"this needs Ray ({error}): pip install 'vusfa[cluster]'") from error
    return ray


def check_ray_address(address: str) -> None:
    """Check that a Ray cluster answers at an address.

    Raises:
        ConfigError: the address is malformed, or nobody answers there, or something else than Ray.

    >>> check_ray_address("localhost")
    Traceback (most recent call last):
    ...
    vusfa.errors.ConfigError: the Ray address is 'localhost'; give HOST:PORT, such as 10.0.0.1:6379
    """
    if address.startswith("ray://"):
        raise ConfigError(
            f"the Ray address is {brief(address)}, of Ray's client; give HOST:6379 on a machine of the"
            " cluster, or send the command there with ray job submit"
        )
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ConfigError(f"the Ray address is {brief(address)}; give HOST:PORT, such as 10.0.0.1:6379")
    mend = "begin one with ray start --head, or give another address"
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=_ANSWER).close()
    except OSError as error:
        reason = error.strerror or str(error)
        raise ConfigError(f"no Ray cluster answers at {brief(address)} ({reason}); {mend}") from error
    # in a process of its own: a connection to anything but Ray ends the process that tries it
    command = [sys.executable, "-m", "ray.scripts.scripts", "health-check", "--address", address]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_RAY_ANSWER, check=False)
    except subprocess.TimeoutExpired as error:
        raise ConfigError(f"what answers at {brief(address)} is no Ray cluster; {mend}") from error
    if done.returncode:
        words = done.stderr.strip().splitlines()[-1:] or ["it does not say why"]
        raise ConfigError(f"the Ray cluster at {brief(address)} cannot be used ({brief(words[0])}); {mend}")


@contextmanager
def connected(address: str | None = None, log_to_driver: bool = False) -> Iterator[ModuleType]:
    """Context with a connection to Ray; gives the package.

    A process that is connected stays so. Otherwise it is connected to the cluster at the address, or at
    ``RAY_ADDRESS``; without either, Ray is started on this machine for as long as the context lasts.

    Args:
        address: ``HOST:PORT``.
        log_to_driver: print here what workers print.

    Raises:
        ConfigError: Ray is not installed, or see :func:`check_ray_address`.
    """
    ray = import_ray()
    if ray.is_initialized():
        yield ray
        return
    address = address or os.environ.get("RAY_ADDRESS") or None
    given: dict[str, Any] = {"log_to_driver": log_to_driver, "logging_level": "warning"}
    if address in (None, "local"):
        given["include_dashboard"] = False
    elif address != "auto":
        check_ray_address(str(address))
    with _own_signals():
        try:
            ray.init(address="local" if address is None else address, **given)
        except (ConnectionError, RuntimeError, ValueError, OSError) as error:
            reason = " ".join(str(error).split())
            raise ConfigError(f"cannot connect to Ray ({brief(reason)}); give another address") from error
    try:
        yield ray
    finally:
        with _own_signals():
            ray.shutdown()


@contextmanager
def _own_signals() -> Iterator[None]:
    """Context after which SIGTERM means what it did before: Ray takes it."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


class RayWorkers:
    """TorchRL's ``RayCollector`` with a time limit for every batch.

    Args:
        makers: one per worker, each makes its environments; picklable.
        policy: writes ``action``; workers get its weights before every batch.
        frames_per_batch: of all workers together.
        seed: of the environments and the workers' draws of actions.
        autocast: workers compute in bfloat16 where that is safe.
        timeout: seconds after which workers that send nothing count as dead; None: never.
        address: of the cluster, see :func:`connected`.
        resources: that Ray keeps for each worker: ``num_cpus``, ``num_gpus``, ``memory`` or others by name.

    Raises:
        ConfigError: see :func:`connected`.
        WorkerError: the workers cannot start, or one has died or been silent for too long.
    """

    def __init__(
        self,
        makers: Sequence[Callable[[], EnvBase]],
        policy: TensorDictModuleBase,
        *,
        frames_per_batch: int,
        seed: int,
        autocast: bool,
        timeout: float | None,
        address: str | None,
        resources: Mapping[str, float],
    ) -> None:
        self._limit, self._policy = timeout, policy
        self._collector: Any = None
        self._stack = ExitStack()
        try:
            self._ray = self._stack.enter_context(connected(address))
            self._collector = self._wait(
                partial(_make, makers, policy, frames_per_batch, seed, autocast, dict(resources)),
                None if timeout is None else max(timeout, 120.0),
                "the collector's workers have not begun within {limit:g} s (collector.timeout): does the"
                f" cluster have {len(makers)} times {dict(resources) or 'one processor'}?",
            )
        except BaseException:
            self.shutdown()
            raise

    def __iter__(self) -> Iterator[TensorDictBase]:
        batches = iter(self._collector)
        while True:
            yield self._wait(
                partial(_collect, self._ray, self._collector, self._policy, batches),
                self._limit,
                "a worker of the collector has sent nothing for {limit:g} s (collector.timeout)",
            )

    def shutdown(self) -> None:
        """End the workers, and the connection if it was made here."""
        collector, self._collector = self._collector, None
        with self._stack, suppress(self._errors):
            if collector is not None:
                collector.shutdown()

    @property
    def _errors(self) -> type[Exception]:
        return getattr(self, "_ray", import_ray()).exceptions.RayError

    def _wait(self, call: Callable[[], Any], limit: float | None, overdue: str) -> Any:
        """The result of a call, made in a thread: Ray waits for ever."""
        done: Future[Any] = Future()
        threading.Thread(target=_settle, args=(done, call), daemon=True).start()
        try:
            return done.result(limit)
        except Overdue as error:
            raise WorkerError(overdue.format(limit=limit)) from error
        except self._errors as error:
            cause = getattr(error, "cause", None)
            if isinstance(cause, VusfaError):
                raise cause from error
            reason = " ".join(str(error).split("\n")[0].split())
            raise WorkerError(f"a worker of the collector has ended: {brief(reason)}") from error


def _settle(done: Future[Any], call: Callable[[], Any]) -> None:
    try:
        done.set_result(call())
    except BaseException as error:
        done.set_exception(error)


def _make(
    makers: Sequence[Callable[[], EnvBase]],
    policy: TensorDictModuleBase,
    frames_per_batch: int,
    seed: int,
    autocast: bool,
    resources: dict[str, float],
) -> Any:
    from torchrl.collectors.distributed import RayCollector

    known: dict[str, Any] = {
        name: resources.pop(name) for name in ("num_cpus", "num_gpus", "memory") if name in resources
    }
    config: dict[str, Any] = {"num_cpus": 1, **known, "resources": resources}
    collector = RayCollector(
        [partial(_begin, autocast, make) for make in makers],
        policy,
        frames_per_batch=frames_per_batch,
        total_frames=2**62,  # its -1 means none
        sync=True,
        weight_sync_schemes={},  # see _collect
        postproc=_joined,
        collector_kwargs={"auto_register_policy_transforms": False, "track_traj_ids": False},
        remote_configs=config,
        num_collectors=len(makers),
    )
    collector.set_seed(seed)
    return collector


def _collect(
    ray: Any, collector: Any, policy: TensorDictModuleBase, batches: Iterator[TensorDictBase]
) -> Any:
    """The next batch, with the weights as they are now.

    TorchRL's scheme of weights would send buffers, too, such as the table of all features, and fails when a
    policy makes one on the way.
    """
    weights = ray.put({name: value.detach().cpu() for name, value in policy.named_parameters()})
    collector.map_fn(
        "policy.load_state_dict",
        [(weights,)] * collector.num_workers,
        [{"strict": False}] * collector.num_workers,
    )
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "RayCollector iteration started before weight", UserWarning)
        return next(batches)


def _begin(autocast: bool, make: Callable[[], EnvBase]) -> EnvBase:
    """The environments of a worker, in its process."""
    torch.set_num_threads(1)
    if autocast:
        torch.set_autocast_dtype("cpu", torch.bfloat16)
        torch.set_autocast_enabled("cpu", True)
        torch.set_autocast_cache_enabled(False)  # it would keep weights converted before an update
    return make()


def _joined(batch: TensorDictBase) -> TensorDictBase:
    """(workers, B, T) as (workers x B, T)."""
    return batch.flatten(0, 1)
