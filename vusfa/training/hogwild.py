"""Lock-free A3C: processes that each collect, differentiate and step for themselves, on shared weights.

In A3C (Mnih et al. 2016, https://arxiv.org/abs/1602.01783, Algorithm S3), as in Hogwild! (Recht et al. 2011),
no update waits for another. Here the weights, the optimizer's accumulators and the bottleneck's multiplier
lie in shared memory. Each of N worker processes has ``num_envs / N`` environments of its own; it collects a
rollout, computes its gradient and applies it in place, while others do the same. An update may be lost where
two processes write one number at the same moment. The learning rate falls with the frames of all workers.

The main process trains nothing: it counts frames, keeps the log and writes checkpoints, of the weights as
they are at that moment. Runs do not repeat number for number; a resumed run begins new episodes.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, multiprocessing
from torchrl.collectors import BaseCollector

from vusfa.algorithms import annealed
from vusfa.errors import ConfigError, WorkerError
from vusfa.objectives import TFRMSprop
from vusfa.training.collectors import MakeEnv, make_collector, rows_per_worker
from vusfa.training.trainer import Trainer
from vusfa.training.workers import Silence, begin_worker, end_of, started

__all__ = ["HogwildTrainer"]

#: Seconds that a worker gets to finish its update at the end.
PATIENCE = 30.0


class HogwildTrainer(Trainer):
    """A :class:`~vusfa.training.Trainer` whose updates are made by its workers.

    Args:
        make_env: of :func:`~vusfa.training.make_collector`; the others are those of the trainer.

    Raises:
        ConfigError: an algorithm or optimizer that keeps more than can be shared, another device than the
            processor, or environments that the workers cannot share out evenly.
    """

    def __init__(self, *, make_env: MakeEnv, settings: Mapping[str, Any], **parts: Any) -> None:
        self._make_env, chosen = make_env, settings["collector"]
        single = partial(_make_single, make_env, settings, 0)
        super().__init__(make_collector=single, settings=settings, **parts)
        rows_per_worker(chosen["kind"], chosen["num_envs"], chosen["num_workers"])
        if settings["algorithm"]["name"] != "usf":
            raise ConfigError(
                f"collector=hogwild trains with algorithm=usf, not {settings['algorithm']['name']}: a replay"
                " buffer or a second optimizer step would be each worker's own; give another collector"
            )
        if not isinstance(self.optimizer, TFRMSprop):
            raise ConfigError(
                f"collector=hogwild shares the accumulators of optim=a3c or optim=tf_rmsprop, not those of"
                f" {settings['optim']['kind']}; give one of these, or another collector"
            )
        if next(self.agent.parameters()).device.type != "cpu":
            raise ConfigError(f"collector=hogwild needs device=cpu, not {settings['device']}")

    def _content(self, folder: Path, merged: Mapping[str, Any]) -> dict[str, Any]:
        # workers move the weights while a file is written
        return copy.deepcopy(super()._content(folder, merged))

    @contextmanager
    def collecting(self) -> Iterator[Iterator[Any]]:
        """Reports of new workers, which train until the context ends; see :meth:`update`."""
        self._waiting = None  # workers begin new episodes
        self.agent.share_memory()
        optimizer: Any = self.optimizer
        optimizer.share_memory()
        workers: Any = _Workers(self)
        try:
            self._collector = workers
            yield iter(workers)
        except WorkerError:
            workers.patience = 0.0  # one that is stopped would not end, nor those that wait for its lock
            raise
        finally:
            self._collector = None
            workers.close()

    def update(self, batches: Iterator[Any]) -> tuple[TensorDictBase, dict[str, Tensor]]:
        """Record one update of a worker.

        Args:
            batches: those of :meth:`collecting`.

        Returns:
            no frames, and the numbers to log.

        Raises:
            WorkerError: a worker has died, or has been silent for too long.
        """
        began = time.monotonic()
        frames, episodes, terms = next(batches)
        optim = self.settings["optim"]
        for group in self.optimizer.param_groups:
            group["lr"] = annealed(self.frames, optim["lr"], optim["horizon"])
        self.frames += frames
        self.updates += 1
        self.episodes.add(episodes)
        self.terms.update(terms)
        self.seconds += time.monotonic() - began
        return self.goals.new_empty(0), terms


class _Workers:
    """Worker processes, and their reports."""

    patience = PATIENCE

    def __init__(self, trainer: HogwildTrainer) -> None:
        settings = trainer.settings
        # as TorchRL's collectors; a forked process would share more than the weights
        method = multiprocessing.get_start_method(allow_none=True) or "spawn"
        context: Any = multiprocessing.get_context(method)
        self.ended, self.frames = context.Event(), context.Value("q", trainer.frames)
        limit = settings["collector"].get("timeout")
        names = ("scenes", "goals", "agent", "algorithm", "optimizer")  # pickled as one: they share tensors
        parts = {name: getattr(trainer, name) for name in names}
        self.procs: list[Any] = []
        self.reports: list[Any] = []
        try:
            with started(None if limit is None else max(limit, 120.0), may_end=True):
                for rank in range(settings["collector"]["num_workers"]):
                    receiver, sender = context.Pipe(duplex=False)
                    make = partial(_make_single, trainer._make_env, settings, rank)
                    given = parts, make, settings, rank, self.frames, self.ended, sender
                    process = context.Process(target=_work, args=given, daemon=True)
                    process.start()
                    sender.close()  # the worker's alone: its end is then the end of its reports
                    self.procs.append(process)
                    self.reports.append(receiver)
        except BaseException:
            self.patience = 0.0
            self.close()
            raise
        self.silence = Silence(self.procs, limit)

    def __iter__(self) -> Iterator[Any]:
        open_: list[Any] = list(self.reports)
        while open_:
            ready: list[Any] = wait(open_, timeout=1.0)
            for report in ready:
                self.silence.ends(self.reports.index(report))
            self.silence.check()
            for report in ready:
                try:
                    yield _tensors(*report.recv())
                except (EOFError, OSError):
                    open_.remove(report)
                    self._check(self.reports.index(report))
                    self.silence.ends(self.reports.index(report), for_good=True)

    def _check(self, rank: int) -> None:
        process = self.procs[rank]
        process.join()
        if process.exitcode:
            raise WorkerError(end_of(process.pid, process.exitcode, rank))

    def close(self) -> None:
        """Ends the workers after their current update."""
        self.ended.set()
        until = time.monotonic() + self.patience
        while any(process.is_alive() for process in self.procs) and time.monotonic() < until:
            ready: list[Any] = wait(self.reports, timeout=0.1)
            for report in ready:  # a worker whose report nobody reads would not end
                with suppress(EOFError, OSError):
                    report.recv()
            if any(process.exitcode for process in self.procs):  # its lock may be held for ever
                break
        for process in self.procs:
            if process.is_alive():
                process.kill()
            process.join()
        for report in self.reports:
            report.close()


def _work(
    parts: Mapping[str, Any],
    make: Any,
    settings: Mapping[str, Any],
    rank: int,
    frames: Any,
    ended: Any,
    sender: Connection,
) -> None:
    """A worker: rollouts, gradients and steps until all workers together have ``total_frames``."""
    begin_worker(False)
    torch.set_num_threads(1)
    torch.manual_seed(settings["seed"] + 7919 * (rank + 1) + frames.value)
    trainer = Trainer(**parts, make_collector=make, settings=settings)
    size = settings["collector"]["rollout"] * settings["collector"]["num_envs"]
    size //= settings["collector"]["num_workers"]
    with trainer.collecting() as batches:
        while not ended.is_set():
            with frames.get_lock():
                trainer.frames = frames.value
                if trainer.frames >= settings["total_frames"]:
                    break
                frames.value += size
            _, terms = trainer.update(batches)
            episodes = {name: value.tolist() for name, value in trainer.episodes.state_dict().items()}
            trainer.episodes.flush()
            sender.send((size, episodes, {name: float(value.detach()) for name, value in terms.items()}))


def _tensors(
    frames: int, episodes: dict[str, Any], terms: dict[str, float]
) -> tuple[int, Any, dict[str, Tensor]]:
    return (
        frames,
        {name: torch.tensor(value, dtype=torch.float64) for name, value in episodes.items()},
        {name: torch.tensor(value) for name, value in terms.items()},
    )


def _make_single(
    make_env: MakeEnv, settings: Mapping[str, Any], rank: int, policy: TensorDictModuleBase
) -> BaseCollector:
    """The collector of a worker's own environments."""
    chosen = settings["collector"]
    rows = chosen["num_envs"] // chosen["num_workers"]
    return make_collector(
        "single",
        make_env,
        policy,
        num_envs=rows,
        rollout=chosen["rollout"],
        seed=settings["seed"] + rank,
        first_goal=rank * rows,
    )
