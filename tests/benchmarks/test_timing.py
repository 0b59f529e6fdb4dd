"""Medians, turns and processor time, against a clock that is told the time."""

from __future__ import annotations

import pytest
import torch

from benchmarks.timing import Clock, Sample, Timing, Work, interleaved, ratio


class Told(Clock):
    def __init__(self) -> None:
        self.now = self.used = 0.0

    def wall(self) -> float:
        return self.now

    def cpu(self) -> float:
        return self.used


def test_workloads_take_turns_after_one_unmeasured_call_each():
    clock, log = Told(), []

    def work(name: str, wall: float, cpu: float):
        def call() -> int:
            log.append(name)
            clock.now += wall
            clock.used += cpu
            return 6

        return Work(call)

    timings = interleaved({"a": work("a", 1.0, 2.0), "b": work("b", 2.0, 2.0)}, 2, 2.0, clock)
    assert log == ["a", "b", *("a", "a", "b") * 2]
    assert timings["a"].samples == (Sample(12, 2.0, 4.0),) * 2
    assert (timings["a"].per_second, timings["a"].per_cpu_second) == (6.0, 3.0)
    assert ratio(timings["a"], timings["b"]) == 2.0
    assert ratio(timings["a"], timings["b"], cpu=True) == 1.0


def test_a_ratio_is_taken_within_rounds():
    slow_later = [Timing(tuple(Sample(n, t, t) for t in (1.0, 4.0, 2.0))) for n in (30, 10)]
    assert ratio(*slow_later) == pytest.approx(3.0)


def test_threads_are_set_for_each_workload_and_put_back():
    before, seen = torch.get_num_threads(), []
    work = Work(lambda: seen.append(torch.get_num_threads()) or 1, threads=before + 1)
    interleaved({"x": work}, 1, 0.0)
    assert seen == [before + 1] * 2
    assert torch.get_num_threads() == before


def test_threads_are_put_back_after_a_failure():
    before = torch.get_num_threads()
    with pytest.raises(ZeroDivisionError):
        interleaved({"x": Work(lambda: 1 // 0, threads=before + 1)}, 1, 0.0)
    assert torch.get_num_threads() == before
