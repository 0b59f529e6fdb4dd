"""How speed and memory change with the number of rooms, of environments and of workers."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor

import torch

from benchmarks.memory_suite import peak_so_far
from benchmarks.report import Options, Report, Requirement, Row
from benchmarks.trainer import running, small
from benchmarks.worlds import tiled

__all__ = ["measure", "run"]

ROOMS, ENVS = (4, 40, 400), (64, 1024, 4096)
#: Active scenes of the rows that rotate, and the share of the rate with that many rooms that more rooms keep.
ACTIVE, KEPT = 4, 0.75


def run(options: Options) -> Report:
    """Complete VUSFA updates, one process per point of the grid."""
    report = Report("scaling")
    rooms_, envs_ = ((2,), (8,)) if options.quick else (ROOMS, ENVS)
    points = [(rooms, envs, 1, 0) for rooms in rooms_ for envs in envs_]
    points += [(rooms, envs_[len(envs_) // 2], 2, 0) for rooms in rooms_]
    active = 1 if options.quick else ACTIVE
    points += [(rooms, envs_[0], 1, active) for rooms in rooms_ if rooms > active]
    for rooms, envs, workers, active in points:
        overrides = [*small(options), f"collector.num_envs={envs}"]
        if active:
            overrides.append(f"env.active_scenes={active}")
        if workers > 1:
            overrides += ["collector=multi_sync", f"collector.num_workers={workers}"]
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
            call = pool.submit(measure, rooms, overrides, options.seconds, options.threads)
            states, speed, memory = call.result()
        label = (
            f"{rooms} rooms ({states:,} states), {envs} environments, {workers} worker{'s' * (workers > 1)}"
            + f", {active} active" * bool(active)
        )
        first = report.rows[0].value if report.rows else speed
        peer = report.rows[0].name if report.rows else ""
        report.rows.append(Row(label, speed, "frames/s", peer, speed / first if peer else None))
        report.rows.append(Row(f"{label}, peak memory", memory, "MiB"))
        if active:
            name = f"{rooms} rooms, {active} active, keep the rate of {rooms_[0]}"
            report.requirements.append(Requirement(name, speed / first, KEPT, "times"))
    return report


def measure(rooms: int, overrides: Sequence[str], seconds: float, threads: int) -> tuple[int, float, float]:
    """Number of states, frames per second of complete updates, peak memory of the main process in MiB."""
    torch.set_num_threads(threads)
    scenes = tiled(rooms)
    with running(overrides, scenes) as ours:
        ours.update()
        torch.set_num_threads(threads)
        began, frames = time.perf_counter(), 0
        while not frames or time.perf_counter() - began < seconds:
            frames += ours.update()
        speed = frames / (time.perf_counter() - began)
    return scenes.num_states, speed, peak_so_far()
