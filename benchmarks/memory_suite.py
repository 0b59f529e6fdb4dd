"""Memory: bytes per frame, peak of a training, and growth."""

from __future__ import annotations

import gc
import resource
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import psutil
import torch

from benchmarks.report import Options, Report, Requirement, Row
from benchmarks.trainer import apart, running, small

__all__ = ["bytes_a_frame", "growth", "peak", "peak_so_far", "run"]

#: Growth over the updates, MiB: the allocator's slack.
SLACK = 8.0


def run(options: Options) -> Report:
    """Run each measurement in its own process."""
    report = Report("memory")
    tiny = small(options)
    kinds = {
        "ids": ["agent.model=vusfa", *tiny],
        "features": ["agent.model=vusfa", "agent.observation=features", *tiny],
    }
    for place, more in (("collector", []), ("worker pipes", ["collector=multi_sync"])):
        size = {kind: apart(bytes_a_frame, [*given, *more]) for kind, given in kinds.items()}
        times = size["features"] / size["ids"]
        report.rows.append(Row(f"{place}: a frame as ids", size["ids"], "bytes", "features", times))
        report.rows.append(Row(f"{place}: a frame as features", size["features"], "bytes"))
    most = {kind: apart(peak, given, 1 if options.quick else 5) for kind, given in kinds.items()}
    times = most["features"] / most["ids"]
    report.rows.append(Row("peak resident memory of a training", most["ids"], "MiB", "features", times))
    report.rows.append(Row("peak resident memory, features", most["features"], "MiB"))
    updates = 20 if options.quick else 10_000
    grown = apart(growth, small(replace(options, quick=True)), updates)
    report.rows.append(Row(f"growth over {updates:,} updates", grown, "MiB", note="of a tiny network"))
    if not options.quick:
        what = f"growth of resident memory over {updates:,} updates"
        report.requirements.append(Requirement(what, grown, SLACK, "MiB", at_least=False))
    return report


def bytes_a_frame(overrides: Sequence[str]) -> float:
    """Bytes per frame of a collected batch."""
    with running(overrides) as ours:
        batch = next(ours.batches)
    return batch.bytes() / batch.numel()


def peak(overrides: Sequence[str], updates: int) -> float:
    """Peak memory of this process after some updates, in MiB."""
    with running(overrides) as ours:
        for _ in range(updates):
            ours.update()
    return peak_so_far()


def peak_so_far() -> float:
    """Peak memory of this process so far, in MiB."""
    status = Path("/proc/self/status")
    if status.exists():  # of this process alone; getrusage may report the parent's
        line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def growth(overrides: Sequence[str], updates: int) -> float:
    """Resident memory after some updates minus that after a tenth of them, in MiB."""
    torch.set_num_threads(1)
    own, before = psutil.Process(), 0
    with running(overrides) as ours:
        for index in range(updates + updates // 10):
            if index == updates // 10:
                gc.collect()
                before = own.memory_info().rss
            ours.update()
        gc.collect()
        after = own.memory_info().rss
    return (after - before) / 2**20
