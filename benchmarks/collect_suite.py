"""Collection with the VUSFA agent (4 frames, 4 rooms) beside a bare loop, and fed with features."""

from __future__ import annotations

from contextlib import ExitStack

from benchmarks.peers.bare_update import BareTraining
from benchmarks.peers.feature_fed import feature_fed
from benchmarks.report import Options, Report, Requirement, Row
from benchmarks.timing import Timing, Work, interleaved, ratio
from benchmarks.trainer import make_trainer, small

__all__ = ["run"]


def run(options: Options) -> Report:
    """Frames a second of the recipe's collector, weights standing still."""
    overrides = ["agent.model=vusfa", "agent.history=4", *small(options)]
    report = Report("collect")
    with ExitStack() as stack:
        ours = make_trainer(overrides)
        stack.callback(ours.close)
        fed = feature_fed(overrides)
        stack.callback(fed.close)
        bare = BareTraining(ours)
        counts = sorted({1, options.threads})
        works = {
            f"{name}, {threads} threads": Work(call, threads)
            for threads in counts
            for name, call in (("ours", ours.collect), ("bare loop", bare.collect), ("features", fed.collect))
        }
        timings = interleaved(works, options.repetitions, options.seconds)
    for threads in counts:
        mine = timings[f"ours, {threads} threads"]
        for name in ("bare loop", "features"):
            peer = timings[f"{name}, {threads} threads"]
            report.rows.append(_row(f"collection, {threads} threads", mine, name, ratio(mine, peer)))
            report.rows.append(_row(f"collection, {name}, {threads} threads", peer))
    timing, loop = (timings[f"{name}, {options.threads} threads"] for name in ("ours", "bare loop"))
    share = ratio(timing, loop)
    report.requirements.append(Requirement("collection beside the bare loop", share, 0.85, "of its speed"))
    return report


def _row(name: str, timing: Timing, peer: str = "", times: float | None = None) -> Row:
    return Row(name, timing.per_second, "frames/s", peer, times, samples=tuple(timing.rates))
