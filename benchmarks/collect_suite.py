"""Collection with the VUSFA agent (4 frames, 4 rooms) beside a bare loop and a feature-fed collector.

With the recipe's 256 environments, with fewer and with more: calls dominate a step of few rows.
"""

from __future__ import annotations

from contextlib import ExitStack

from benchmarks.peers.bare_update import BareTraining
from benchmarks.peers.feature_fed import feature_fed
from benchmarks.report import Options, Report, Requirement, Row, counted
from benchmarks.timing import Timing, Work, interleaved, ratio
from benchmarks.trainer import running, small

__all__ = ["run"]


SIZES = (64, 256, 1024)


def run(options: Options) -> Report:
    """Frames per second of the recipe's collector with constant weights."""
    report = Report("collect")
    for size in (8,) if options.quick else SIZES:
        _at(size, options, report)
    return report


def _at(size: int, options: Options, report: Report) -> None:
    overrides = ["agent.model=vusfa", "agent.history=4", *small(options), f"collector.num_envs={size}"]
    with ExitStack() as stack:
        ours = stack.enter_context(running(overrides))
        fed = stack.enter_context(feature_fed(overrides))
        bare = BareTraining(ours.trainer)
        counts = sorted({1, options.threads})
        works = {
            f"{name}, {counted(threads, 'thread')}": Work(call, threads)
            for threads in counts
            for name, call in (("ours", ours.collect), ("bare loop", bare.collect), ("features", fed.collect))
        }
        timings = interleaved(works, options.repetitions, options.seconds)
    for threads in counts:
        many = counted(threads, "thread")
        mine, label = timings[f"ours, {many}"], f"{size} environments, {many}"
        for name in ("bare loop", "features"):
            peer = timings[f"{name}, {many}"]
            report.rows.append(_row(f"collection, {label}", mine, name, ratio(mine, peer)))
            report.rows.append(_row(f"collection, {name}, {label}", peer))
    many = counted(options.threads, "thread")
    timing, loop = (timings[f"{name}, {many}"] for name in ("ours", "bare loop"))
    what = f"collection beside the bare loop, {size} environments"
    report.requirements.append(Requirement(what, ratio(timing, loop), 0.85, "of its speed"))


def _row(name: str, timing: Timing, peer: str = "", times: float | None = None) -> Row:
    return Row(name, timing.per_second, "frames/s", peer, times, samples=tuple(timing.rates))
