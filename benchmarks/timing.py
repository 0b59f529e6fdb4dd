"""Timing of workloads in turn, so that a slow machine slows all of them down.

A workload is a function that does some work and returns how much (frames, episodes). Workloads take turns,
A B A B ..., each turn a fixed time; the result is the median over turns, and a ratio is the median of
the ratios within a round. Processor time counts this process and the worker processes below it.
"""

from __future__ import annotations

import gc
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import psutil
import torch

__all__ = ["Clock", "Sample", "Timing", "Work", "interleaved", "ratio"]


@dataclass(frozen=True)
class Work:
    """A workload to time.

    Args:
        call: does some work and returns how much.
        threads: threads of torch during the call.
    """

    call: Callable[[], int]
    threads: int = 1


@dataclass(frozen=True)
class Sample:
    """One turn: units of work, wall-clock seconds, processor seconds."""

    units: int
    wall: float
    cpu: float


@dataclass(frozen=True)
class Timing:
    """All turns of one workload.

    >>> timing = Timing((Sample(10, 1.0, 2.0), Sample(30, 1.0, 2.0), Sample(20, 1.0, 2.0)))
    >>> timing.per_second, timing.per_cpu_second
    (20.0, 10.0)
    """

    samples: tuple[Sample, ...]

    @property
    def rates(self) -> list[float]:
        """Units per second, for each turn."""
        return [sample.units / sample.wall for sample in self.samples]

    @property
    def cpu_rates(self) -> list[float]:
        """Units per processor second, for each turn."""
        return [sample.units / sample.cpu for sample in self.samples]

    @property
    def per_second(self) -> float:
        """Median over turns."""
        return statistics.median(self.rates)

    @property
    def per_cpu_second(self) -> float:
        """Median over turns."""
        return statistics.median(self.cpu_rates)


class Clock:
    """Wall-clock time and processor time of this process and its live child processes."""

    def __init__(self) -> None:
        self._process = psutil.Process()

    def wall(self) -> float:
        """Seconds since some moment."""
        return time.perf_counter()

    def cpu(self) -> float:
        """Processor seconds used so far."""
        total = time.process_time()
        for child in self._process.children(recursive=True):
            try:
                times = child.cpu_times()
            except psutil.NoSuchProcess:  # it has just ended
                continue
            total += times.user + times.system
        return total


def interleaved(
    works: Mapping[str, Work], repetitions: int, seconds: float, clock: Clock | None = None
) -> dict[str, Timing]:
    """Time workloads in turn, after one unmeasured call of each.

    Args:
        works: by name.
        repetitions: turns per workload.
        seconds: a turn ends with the first call after this time.
        clock: source of the time.

    >>> timings = interleaved({"sleep": Work(lambda: 1)}, repetitions=2, seconds=0.0)
    >>> len(timings["sleep"].samples)
    2
    """
    clock = clock or Clock()
    threads = torch.get_num_threads()
    samples: dict[str, list[Sample]] = {name: [] for name in works}
    try:
        for work in works.values():
            torch.set_num_threads(work.threads)
            work.call()
        gc.collect()
        for _ in range(repetitions):
            for name, work in works.items():
                torch.set_num_threads(work.threads)
                samples[name].append(_turn(work.call, seconds, clock))
    finally:
        torch.set_num_threads(threads)
    return {name: Timing(tuple(taken)) for name, taken in samples.items()}


def ratio(ours: Timing, peer: Timing, cpu: bool = False) -> float:
    """How many times faster ours is: the median of the ratios within a round.

    Args:
        ours, peer: timed in turn.
        cpu: compare processor seconds instead of seconds.
    """
    pairs = (
        zip(ours.cpu_rates, peer.cpu_rates, strict=True) if cpu else zip(ours.rates, peer.rates, strict=True)
    )
    return statistics.median(a / b for a, b in pairs)


def _turn(call: Callable[[], int], seconds: float, clock: Clock) -> Sample:
    began, cpu, units = clock.wall(), clock.cpu(), 0
    while True:
        units += call()
        wall = clock.wall() - began
        if wall >= seconds:
            # a processor's clock may stand still for a hundredth of a second
            return Sample(units, max(wall, 1e-9), max(clock.cpu() - cpu, 1e-9))
