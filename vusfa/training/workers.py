"""Supervision of a collector's worker processes: one that dies, or says nothing for too long, is an error
that names it; none outlives the training."""

from __future__ import annotations

import ctypes
import math
import multiprocessing
import os
import queue
import resource
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

import torch
from torchrl.collectors import BaseCollector, MultiSyncCollector

from vusfa.errors import VusfaError, WorkerError
from vusfa.training.signals import STOPPING, signals_held

__all__ = ["Silence", "begin_worker", "end_of", "started", "supervised", "watch"]

#: What one wait, or one update between two waits, counts at most towards a time limit, in seconds; a quarter
#: of the limit is the other bound: a training that was suspended (Ctrl-Z, a laptop's lid) does not hold that
#: against its workers.
LONGEST_WAIT = 10.0
_PR_SET_PDEATHSIG = 1


def begin_worker(autocast: bool) -> None:
    """Initialization of every worker process.

    A terminal sends Ctrl-C and its hang-up to all processes; the main one decides. Where that is killed, a
    worker ends, too.
    """
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # a forked one has handlers of the main process
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPPING)  # see started()
    if sys.platform.startswith("linux"):
        with suppress(AttributeError, OSError):
            ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    parent = multiprocessing.parent_process()
    if parent is not None and not parent.is_alive():  # killed while this process was starting
        os._exit(1)
    if autocast:
        torch.set_autocast_dtype("cpu", torch.bfloat16)
        torch.set_autocast_enabled("cpu", True)
        # The cache would keep weights converted before an update for as long as the worker lives.
        torch.set_autocast_cache_enabled(False)


@contextmanager
def started(limit: float | None, *, may_end: bool = False) -> Iterator[None]:
    """Context in which workers start.

    Signals that end a training wait meanwhile, those to workers until :func:`begin_worker`. Here they act
    within a second. A worker that died of a signal to all processes before it has read what it is given would
    leave this process writing to it for ever.

    Args:
        limit: seconds in which all must have started; None: any time.
        may_end: whether a worker may have done its work before the last one has started.

    Raises:
        WorkerError: one dies, or all together take longer than ``limit`` seconds (None: any time), or the
            system refuses processes, memory or files. Those that did start are ended.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != hard:  # a worker takes about ten
        with suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    before, began = set(multiprocessing.active_children()), time.monotonic()
    seen: set[Any] = set()
    alive = (None, 0) if may_end else (None,)

    def look(number: int, frame: FrameType | None) -> None:
        end_if_signaled()
        seen.update(child for child in multiprocessing.active_children() if child not in before)
        dead = [end_of(child.pid, child.exitcode) for child in seen if child.exitcode not in alive]
        if dead:
            raise WorkerError(dead[0])
        if limit is not None and time.monotonic() - began > limit:
            raise WorkerError(f"they have not begun within {limit:g} s (collector.timeout)")

    with signals_held() as end_if_signaled:
        others = _children()
        try:
            with _every_second(look):
                yield
        except BaseException as error:
            for child in set(multiprocessing.active_children()) - before:
                child.kill()
                child.join()
            for pid in _children() - others:  # one that was interrupted in its start is in no list
                with suppress(ProcessLookupError, ChildProcessError):
                    os.kill(pid, signal.SIGKILL)
                    os.waitpid(pid, 0)
            end_if_signaled()  # TorchRL may have made something else of it
            known = isinstance(error, VusfaError) and not isinstance(error, WorkerError)
            if known or not isinstance(error, Exception):
                raise
            raise _cannot_start(error) from error


def _children() -> set[int]:
    """Processes that this thread has started; none where the system does not say."""
    try:
        with open(f"/proc/self/task/{threading.get_native_id()}/children", encoding="ascii") as file:
            return {int(pid) for pid in file.read().split()}
    except OSError:
        return set()


def _cannot_start(error: Exception) -> WorkerError:
    """The error of workers that the system refuses to start, or that die at it."""
    reason = " ".join(str(error).split("\n")[0].split()) or type(error).__name__
    return WorkerError(
        f"the collector's workers cannot start: {reason}; give fewer collector.num_workers, or allow more"
        " memory, processes and open files (ulimit)"
    )


@contextmanager
def _every_second(look: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Calls a function every second, even while the main thread waits; not in another thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handler = signal.signal(signal.SIGALRM, look)
    signal.setitimer(signal.ITIMER_REAL, 1.0, 1.0)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, handler)


def watch(collector: BaseCollector, limit: float | None) -> None:
    """Make a collector check its workers while it waits for a batch.

    Args:
        collector: begun; any other than one with workers stays as it is.
        limit: seconds without a batch after which a worker counts as dead; None: any time.
    """
    if hasattr(collector, "procs"):
        in_rounds = isinstance(collector, MultiSyncCollector)
        collector.queue_out = _WatchedQueue(collector.queue_out, collector.procs, limit, in_rounds)


@contextmanager
def supervised(collector: BaseCollector) -> Iterator[None]:
    """Context in which a batch is waited for: what TorchRL raises when a worker has died names the worker.

    Raises:
        WorkerError: a worker has died, or has been silent for too long.
    """
    try:
        yield
    except (RuntimeError, OSError, EOFError) as error:
        dead = _dead(getattr(collector, "procs", ()))
        if not dead:
            raise
        raise WorkerError(dead) from error


class Silence:
    """Time since each worker last sent something.

    Args:
        workers: their processes.
        limit: seconds after which a silent one counts as dead; None: any time.
        in_rounds: they wait for each other: who has sent something in a round is not silent.
    """

    def __init__(self, workers: Sequence[Any], limit: float | None, in_rounds: bool = False) -> None:
        self._workers, self._limit = workers, limit
        self._in_rounds, self._sent = in_rounds, set[int]()
        self._clock, self._last = 0.0, time.monotonic()
        self._heard = [0.0] * len(workers)

    def ends(self, index: int, *, for_good: bool = False) -> None:
        """A worker has sent something, or will send no more."""
        self._heard[index] = math.inf if for_good else self._clock
        if self._in_rounds:
            self._sent = self._sent | {index} if len(self._sent) < len(self._workers) else {index}

    def check(self) -> None:
        """Raise a WorkerError that names the workers which have been silent for too long: of these the one
        that a signal has stopped, where there is one, for others may only wait for its lock."""
        now = time.monotonic()
        self._clock += min(now - self._last, LONGEST_WAIT, (self._limit or math.inf) / 4)
        self._last = now
        silent = [i for i, heard in enumerate(self._heard) if self._clock - heard > (self._limit or math.inf)]
        silent = [i for i in silent if i not in self._sent or len(self._sent) == len(self._workers)]
        if silent:
            stopped = [index for index in silent if _is_stopped(self._workers[index].pid)]
            named = ", ".join(f"{i} (process {self._workers[i].pid})" for i in stopped or silent)
            why = "" if stopped or len(silent) == 1 else "; which of them the others wait for cannot be known"
            how = f"{'is stopped by a signal and ' if stopped else ''}has sent nothing for {self._limit:g} s"
            raise WorkerError(f"worker {named} of the collector {how} (collector.timeout){why}")


class _WatchedQueue:
    """The queue on which workers announce their batches."""

    def __init__(
        self, results: Any, workers: Sequence[Any], limit: float | None, in_rounds: bool = False
    ) -> None:
        self._results, self._workers, self._silence = results, workers, Silence(workers, limit, in_rounds)

    def get(self, timeout: float | None = None) -> Any:
        """As a queue's ``get``.

        Raises:
            WorkerError: a worker has died, or has been silent for too long.
        """
        try:
            item = self._results.get(timeout=timeout)
        except queue.Empty:
            self._look()
            raise
        self._silence.ends(item[0][1] if isinstance(item[0], tuple) else item[0])
        self._look()
        return item

    def _look(self) -> None:
        dead = _dead(self._workers)
        if dead:
            raise WorkerError(dead)
        try:
            self._silence.check()
        except WorkerError:
            for worker in self._workers:  # TorchRL would wait ten seconds for a stopped one
                with suppress(ValueError):
                    worker.kill()
            raise

    def __getattr__(self, name: str) -> Any:
        return getattr(self._results, name)


def _is_stopped(pid: int) -> bool:
    """Whether a process is stopped (SIGSTOP, a debugger); false where the system does not say."""
    try:
        with open(f"/proc/{pid}/stat", "rb") as file:
            return file.read().rpartition(b") ")[2][:1] in (b"T", b"t")
    except OSError:
        return False


def _dead(workers: Sequence[Any]) -> str | None:
    """Message about the first worker that has ended."""
    for index, worker in enumerate(workers):
        with suppress(ValueError):  # TorchRL has closed those that it ended itself
            if worker.exitcode is not None:
                return end_of(worker.pid, worker.exitcode, index)
    return None


def end_of(pid: int | None, code: int, index: int | None = None) -> str:
    """Describe how a worker process has ended."""
    name = "a worker of the collector" if index is None else f"worker {index} of the collector"
    if code < 0:
        try:
            how = f"was ended by {signal.Signals(-code).name}"
        except ValueError:
            how = f"was ended by signal {-code}"
        return f"{name} (process {pid}) {how}" + (" (out of memory?)" if code == -signal.SIGKILL else "")
    return f"{name} (process {pid}) ended with exit code {code}"
