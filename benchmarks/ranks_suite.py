"""Data-parallel learners and worker processes beside one process; each rank and worker has one thread.

From its file, results/scaling/ranks.json, :mod:`benchmarks.scaling_model` makes its predictions.
"""

from __future__ import annotations

import multiprocessing
import os
import socket
import statistics
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from typing import Any

import torch
from omegaconf import OmegaConf
from torch import distributed

from benchmarks.report import Options, Report, Requirement, Row
from benchmarks.timing import Work, interleaved
from benchmarks.trainer import Running, recipe_settings, running
from vusfa.scenes import Scene, SceneSet
from vusfa.training import make_trainer
from vusfa.training.ranks import Ranks
from vusfa.training.rendezvous import joined

__all__ = ["run"]

#: Times the rate of one rank that two reach on two cores; the same of two workers for an agent with pixels.
TWICE = 1.6
AGENTS = {
    "ids, 4 frames": ["agent.history=4"],
    "features, 4 frames": ["agent.history=4", "agent.observation=features"],
    "LSTM": ["agent=lstm"],
    "pixels": ["agent=pixels", "scenes=[bathroom]", "collector.num_envs=64", "collector.rollout=10"],
}
TINY = ["scenes=[bathroom]", "agent.hidden_size=16", "agent.embedding_size=16"]


def run(options: Options) -> Report:
    """Ranks, workers, and what an update costs."""
    report = Report("ranks")
    few = ["ids, 4 frames"]
    for name in few if options.quick else [*few, "pixels"]:
        _ranks(name, options, report)
    for name in few if options.quick else AGENTS:
        _workers(name, options, report)
    _constants(options, report)
    return report


def _settings(name: str, options: Options) -> list[str]:
    tiny = [*TINY, "collector.num_envs=8", "collector.rollout=4"] if options.quick else []
    return ["agent.model=vusfa", *AGENTS[name], *tiny, *options.overrides, "threads=1"]


def _ranks(name: str, options: Options, report: Report) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(2, mp_context=context) as pool:
        calls = [pool.submit(_rank, rank, port, _settings(name, options), options) for rank in range(2)]
        found = calls[0].result()
        calls[1].result()
    one = f"{name}: 1 rank"
    report.rows.append(Row(one, statistics.median(found["one"]), "frames/s", samples=tuple(found["one"])))
    for kind, label in (("each", "2 ranks, as many environments each"), ("all", "2 ranks, as many in all")):
        times = statistics.median(b / a for a, b in zip(found["one"], found[kind], strict=True))
        value, samples = statistics.median(found[kind]), tuple(found[kind])
        report.rows.append(Row(f"{name}: {label}", value, "frames/s", one, times, samples=samples))
        if kind == "each":
            report.requirements.append(Requirement(f"{name}: two ranks beside one", times, TWICE, "times"))
    if name == "ids, 4 frames":
        rows = {"gradient": "bytes", "all-reduce of the gradient": "s", "all-reduce of one number": "s"}
        report.rows += [Row(key, found[key], unit) for key, unit in rows.items()]


def _rank(rank: int, port: int, overrides: list[str], options: Options) -> dict[str, Any]:
    """One of two ranks: turns of rank 0 alone and of both, and the time of an all-reduce."""
    names = {"RANK": rank, "WORLD_SIZE": 2, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
    os.environ.update({name: str(value) for name, value in names.items()})
    torch.set_num_threads(1)
    settings: Any = OmegaConf.to_container(recipe_settings(overrides))
    double = settings["collector"] | {"num_envs": 2 * settings["collector"]["num_envs"]}
    found: dict[str, Any] = {"one": [], "each": [], "all": []}
    with joined(settings) as ranks, ExitStack() as stack:

        def begun(settings: dict[str, Any], ranks: Ranks) -> Running:
            trainer = make_trainer(settings, ranks=ranks)
            return Running(trainer, stack.enter_context(trainer.collecting()))

        alone = begun(settings, Ranks()) if rank == 0 else None
        both = {"each": begun({**settings, "collector": double}, ranks), "all": begun(settings, ranks)}
        for _ in range(2):  # the first compiles, and fills the buffers
            ranks.first(lambda: alone.update() if alone else 0)
            for ours in both.values():
                ours.update()
        for _ in range(options.repetitions):
            turn = ranks.first(lambda: _turn(alone, options.seconds))
            found["one"].append(turn["frames"] / turn["seconds"])
            for name, ours in both.items():
                began, before = time.perf_counter(), ours.trainer.frames
                for _ in range(turn["updates"]):
                    ours.update()
                found[name].append((ours.trainer.frames - before) / (time.perf_counter() - began))
        params = list(both["all"].trainer.algorithm.parameters())
        number = sum(param.numel() for param in params)
        found["gradient"] = 4 * number
        found["all-reduce of the gradient"] = _reduced(number, options)
        found["all-reduce of one number"] = _reduced(1, options)
    return found


def _turn(ours: Running | None, seconds: float) -> dict[str, float]:
    assert ours is not None
    began, frames, updates = time.perf_counter(), 0, 0
    while not updates or time.perf_counter() - began < seconds:
        frames += ours.update()
        updates += 1
    return {"frames": frames, "updates": updates, "seconds": time.perf_counter() - began}


def _reduced(number: int, options: Options) -> float:
    """Median seconds of an all-reduce of float32 numbers."""
    values, taken = torch.ones(number), []
    for _ in range(3 if options.quick else 20):
        distributed.barrier()
        began = time.perf_counter()
        distributed.all_reduce(values)
        taken.append(time.perf_counter() - began)
    return statistics.median(taken)


def _workers(name: str, options: Options, report: Report) -> None:
    """One process, and two workers, one collector after the other."""
    torch.set_num_threads(1)
    rates = {}
    for kind in ("single", "multi_sync", "multi_async"):
        with running([*_settings(name, options), f"collector={kind}", "collector.num_workers=2"]) as ours:
            for _ in range(3):
                ours.update()
            turn = _turn(ours, 2 * options.seconds)
            rates[kind] = turn["frames"] / turn["seconds"]
        label = f"{name}: collector={kind}" + ", 2 workers" * (kind != "single")
        peer = "" if kind == "single" else f"{name}: collector=single"
        times = rates[kind] / rates["single"] if peer else None
        report.rows.append(Row(label, rates[kind], "frames/s", peer, times))


def _constants(options: Options, report: Report) -> None:
    """What an update and a scene cost."""
    overrides = _settings("ids, 4 frames", options)
    settings = recipe_settings(overrides)
    envs = settings.collector.num_envs
    seconds: dict[int, float] = {}
    with ExitStack() as stack:
        works, frames = {}, {}
        for factor in (1, 4):
            ours = stack.enter_context(running([*overrides, f"collector.num_envs={factor * envs}"]))
            works[str(factor)] = Work(_one(ours), 1)
            frames[str(factor)] = factor * envs * settings.collector.rollout
        timings = interleaved(works, options.repetitions, options.seconds)
        seconds = {frames[name]: 1.0 / timing.per_second for name, timing in timings.items()}
        with torch.profiler.profile(with_flops=True) as profile:
            ours.update()
        operations = sum(event.flops for event in profile.key_averages()) / frames["4"]
        report.rows.append(Row("operations of an update", operations, "FLOP/frame"))
        calls = sum(1 for event in profile.events() if event.cpu_parent is None)
        report.rows.append(Row("torch calls of an update", calls, "calls"))
        report.rows.append(Row("steps of a rollout", settings.collector.rollout, "steps"))
    (few, quick), (many, slow) = sorted(seconds.items())
    each = (slow - quick) / (many - few)
    report.rows.append(Row("an update's time per frame", each, "s/frame"))
    report.rows.append(Row("an update's fixed time", max(quick - each * few, 0.0), "s"))
    report.rows.append(Row("frames of an update per rank", few, "frames"))
    _scenes(report)


def _one(ours: Running) -> Callable[[], int]:
    def update() -> int:
        ours.update()
        return 1

    return update


def _scenes(report: Report) -> None:
    """Seconds and bytes of the bundled scenes, per state."""
    paths = [scene.path for scene in SceneSet.bundled().scenes if scene.path is not None]
    taken = []
    for _ in range(3):
        began = time.perf_counter()
        scenes = SceneSet(Scene.load(path) for path in paths)
        taken.append(time.perf_counter() - began)
    states = scenes.num_states
    report.rows.append(Row("opening scenes", statistics.median(taken) / states, "s/state"))
    size = scenes.features.element_size() * scenes.features[0].numel()
    report.rows.append(Row("features of a state", size, "bytes"))
