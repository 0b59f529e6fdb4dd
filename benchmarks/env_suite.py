"""The environment alone, with a random policy: the cost of TorchRL's conventions over a bare loop."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from functools import partial

import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import EnvBase

from benchmarks.peers.bare_env import BareEnv, random_frames
from benchmarks.peers.gym_vector import async_vector, parallel_env
from benchmarks.report import Options, Report, Requirement, Row, counted
from benchmarks.timing import Timing, Work, interleaved, ratio
from vusfa.envs import resolve_goals
from vusfa.scenes import SceneSet
from vusfa.training import make_collector, make_env
from vusfa.training.collectors import close_collector

__all__ = ["collector_frames", "run"]

SIZES = (1, 16, 128, 1024, 8192)
STEPS = 20
BOUND = 1.5e6


def run(options: Options) -> Report:
    """Frames per processor second at five batch sizes, each beside a bare loop and Gymnasium's workers."""
    scenes = SceneSet.bundled(["bathroom"] if options.quick else None)
    sizes = (1, 16) if options.quick else SIZES
    goals = resolve_goals(scenes, "paper")
    report = Report("env")
    with ExitStack() as stack:
        works: dict[str, Work] = {}
        for size in sizes:
            works[f"ours {size}"] = Work(collector_frames(scenes, size, stack))
            works[f"bare {size}"] = Work(random_frames(BareEnv(scenes, goals, size), STEPS))
        workers = 2
        works["ParallelEnv"] = Work(parallel_env(workers, options.quick, stack))
        works["AsyncVectorEnv"] = Work(async_vector(workers, options.quick, stack))
        timings = interleaved(works, options.repetitions, options.seconds)
    for size in sizes:
        ours, bare = timings[f"ours {size}"], timings[f"bare {size}"]
        report.rows.append(_row(f"TargetNavEnv, {counted(size, 'environment')}", ours, "a bare loop", bare))
        report.rows.append(_row(f"bare loop, {counted(size, 'environment')}", bare))
    large = sizes[-2]
    for name in ("ParallelEnv", "AsyncVectorEnv"):
        label = f"{name}, {workers} workers of one Gymnasium environment"
        report.rows.append(_row(label, timings[name]))
        for size in (sizes[1], large):
            what = f"TargetNavEnv, {counted(size, 'environment')}"
            report.rows.append(_row(what, timings[f"ours {size}"], name, timings[name]))
    if not options.quick:
        report.requirements.append(
            Requirement(
                "Collector, random policy, 1024 environments",
                timings["ours 1024"].per_cpu_second,
                BOUND,
                "frames/cpu s",
            )
        )
    return report


def collector_frames(scenes: SceneSet, size: int, stack: ExitStack) -> Callable[[], int]:
    """The library's own ``single`` collector over ``size`` environments, with actions drawn by one call of
    ``torch.randint``; returns the frames of a batch."""
    policy = TensorDictModule(
        lambda goal: torch.randint(scenes.num_actions, goal.shape), in_keys=["goal_id"], out_keys=["action"]
    )
    make: Callable[..., EnvBase] = partial(make_env, scenes, history=4, goal_sampling="episode")
    collector = make_collector("single", make, policy, num_envs=size, rollout=STEPS)
    stack.callback(close_collector, collector)
    batches = iter(collector)
    return lambda: next(batches).numel()


def _row(name: str, timing: Timing, peer: str = "", other: Timing | None = None) -> Row:
    times = None if other is None else ratio(timing, other, cpu=True)
    samples = tuple(timing.cpu_rates)
    return Row(name, timing.per_cpu_second, "frames/cpu s", peer, times, samples=samples)
