"""How speed and memory change with the number of rooms, of environments and of workers."""

from __future__ import annotations

import math
import multiprocessing
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import psutil
import torch

from benchmarks.memory_suite import peak_so_far
from benchmarks.report import Options, Report, Requirement, Row
from benchmarks.trainer import running, small
from benchmarks.worlds import generated_files, tiled, tiled_files
from vusfa.scenes import SceneSet

__all__ = ["Measured", "measure", "measure_files", "run"]

#: Numbers of environments, with all rooms active and in memory.
ENVS = (64, 1024, 4096)
#: Rooms in files: copies of the bundled ones; generated ones of 80 states, for which heads are shared.
TILED, GENERATED = (4, 40, 400), (4, 4000, 10_000)
#: Rooms in which episodes begin at a time, and frames for which one is active: many times the 64 x 500 frames
#: until the last episode in a room that is left has ended.
ACTIVE, STAY = 4, 400_000
#: Requirements: frames per second and share of the rate with four rooms in 400 rooms; seconds to open 10,000
#: rooms, share of the rate with four, and MiB.
RATE_400, SHARE_400 = 20_000.0, 0.75
OPEN_10K, SHARE_10K, MEMORY_10K = 20.0, 0.5, 3 * 10**9 / 2**20


class Measured(NamedTuple):
    """One point of the grid.

    Attributes:
        states: of all rooms.
        speed: of complete updates, frames per second.
        resident, peak: memory after them, and the most so far, in MiB.
        opened, summarized, again: seconds to open the files; to read all features for fingerprint and
            statistics; to open them again, with the statistics from the cache.
    """

    states: int
    speed: float
    resident: float
    peak: float
    opened: float = 0.0
    summarized: float = 0.0
    again: float = 0.0


def run(options: Options) -> Report:
    """Complete VUSFA updates, one process per point; with ``--quick`` two points in this process."""
    report = Report("scaling")
    if options.quick:
        points = {"in memory": measure(2, [*small(options)], 0.0, 1)}
        points["in files"] = measure_files("generated", 3, _rotating(options, shared=True), 0.0, 1)
        for place, found in points.items():
            _add(report, f"rooms {place}", found, found.speed)
        return report
    timing = options.seconds, options.threads
    for envs in ENVS:
        for workers in (1, 2) if envs == ENVS[1] else (1,):
            overrides = [*small(options), f"collector.num_envs={envs}"]
            overrides += ["collector=multi_sync", f"collector.num_workers={workers}"] if workers > 1 else []
            found = _apart(measure, 4, overrides, *timing)
            label = f"4 rooms in memory, {envs} environments, {workers} worker{'s' * (workers > 1)}"
            _add(report, label, found, report.rows[0].value if report.rows else found.speed)
    for kind, rooms_, shared in (("tiled", TILED, False), ("generated", GENERATED, True)):
        overrides = _rotating(options, shared)
        of_kind = {rooms: _apart(measure_files, kind, rooms, overrides, *timing) for rooms in rooms_}
        for rooms, found in of_kind.items():
            _add(report, f"{rooms} {kind} rooms, {ACTIVE} active", found, of_kind[4].speed)
        _require(report, kind, of_kind)
    return report


def _require(report: Report, kind: str, found: dict[int, Measured]) -> None:
    """Requirements, and how the numbers grow: with the power of the number of rooms that these rows print."""
    first, last = (found[rooms] for rooms in (min(found), max(found)))
    times, rooms = math.log(max(found) / min(found)), max(found)
    for name, values in {"rate": (first.speed, last.speed), "memory": (first.peak, last.peak)}.items():
        power = math.log(values[1] / values[0]) / times
        report.rows.append(Row(f"{kind}: {name} grows with the number of rooms to the power", power, ""))
    share, name = last.speed / first.speed, f"{rooms} rooms, {ACTIVE} active"
    if kind == "tiled":
        report.requirements.append(Requirement(name, last.speed, RATE_400, "frames/s"))
        report.requirements.append(Requirement(f"{name}, of the rate with 4", share, SHARE_400, "times"))
        return
    report.requirements += [
        Requirement(f"{name}, to open", last.opened, OPEN_10K, "s", at_least=False),
        Requirement(f"{name}, of the rate with 4", share, SHARE_10K, "times"),
        Requirement(f"{name}, resident", last.peak, MEMORY_10K, "MiB", at_least=False),
    ]


def _add(report: Report, label: str, found: Measured, beside: float) -> None:
    peer = report.rows[0].name if report.rows else ""
    report.rows.append(
        Row(f"{label} ({found.states:,} states)", found.speed, "frames/s", peer, found.speed / beside)
    )
    if found.opened:
        note = f"statistics {found.summarized:.3g} s; again, with them, {found.again:.3g} s"
        report.rows.append(Row(f"{label}, to open", found.opened, "s", note=note))
    report.rows.append(Row(f"{label}, resident memory", found.resident, "MiB", note=f"peak {found.peak:.0f}"))


def _rotating(options: Options, shared: bool) -> list[str]:
    sizes = {"num_envs": 8, "active": 1} if options.quick else {"num_envs": ENVS[0], "active": ACTIVE}
    overrides = [*small(options), f"collector.num_envs={sizes['num_envs']}", "env.goals=random:5"]
    overrides += [f"env.active_scenes={sizes['active']}", f"env.scene_stay={STAY}"]
    return [*overrides, f"agent.shared_heads={str(shared).lower()}"]


def _apart(call: object, *arguments: object) -> Measured:
    """Measure in a process of its own."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(call, *arguments).result()  # type: ignore[arg-type]


def measure(rooms: int, overrides: Sequence[str], seconds: float, threads: int) -> Measured:
    """All rooms in memory, and active all the time."""
    scenes = tiled(rooms)
    return Measured(scenes.num_states, *_speed(scenes, overrides, seconds, threads), peak_so_far())


def measure_files(kind: str, rooms: int, overrides: Sequence[str], seconds: float, threads: int) -> Measured:
    """Rooms in files, opened lazily, of which some are active at a time; they are written first."""
    with tempfile.TemporaryDirectory() as folder:
        {"tiled": tiled_files, "generated": generated_files}[kind](Path(folder), rooms)
        times = [time.perf_counter()]
        scenes = SceneSet.open(folder, lazy=True)
        times.append(time.perf_counter())
        _ = scenes.fingerprint
        times.append(time.perf_counter())
        scenes = SceneSet.open(folder, lazy=True)
        _ = scenes.fingerprint
        times.append(time.perf_counter())
        found = Measured(scenes.num_states, *_speed(scenes, overrides, seconds, threads), peak_so_far())
        opened, summarized, again = (after - before for before, after in pairwise(times))
        return found._replace(opened=opened, summarized=summarized, again=again)


def _speed(scenes: SceneSet, overrides: Sequence[str], seconds: float, threads: int) -> tuple[float, float]:
    """Frames per second of complete updates, and resident memory after them in MiB."""
    torch.set_num_threads(threads)
    with running(overrides, scenes) as ours:
        ours.update()
        torch.set_num_threads(threads)
        began, frames = time.perf_counter(), 0
        while not frames or time.perf_counter() - began < seconds:
            frames += ours.update()
        return frames / (time.perf_counter() - began), psutil.Process().memory_info().rss / 2**20
