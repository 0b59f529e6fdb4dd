"""The same updates on a GPU, and the time to solve there."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack

import torch

from benchmarks.report import Options, Report, Requirement, Row
from benchmarks.solve_checks import check_of_trainer
from benchmarks.solve_suite import solve_row, train_until
from benchmarks.timing import Work, interleaved
from benchmarks.trainer import Running, running, small

__all__ = ["run"]

ENVS = (1024, 4096, 16384)
FRAMES, SECONDS = 1e6, 60.0


def run(options: Options) -> Report:
    """Complete updates at several numbers of environments, with one frame and with four; time to solve."""
    report = Report("gpu")
    if not torch.cuda.is_available():
        report.skipped = "this machine has no CUDA device"
        return report
    base = ["device=cuda", "agent.model=vusfa", *small(options)]
    best = 0.0
    for history in (1, 4):
        for envs in (8,) if options.quick else ENVS:
            with ExitStack() as stack:
                sizes = [f"agent.history={history}", f"collector.num_envs={envs}"]
                ours = stack.enter_context(running([*base, *sizes]))
                work = {"ours": Work(_synchronised(ours))}
                timing = interleaved(work, options.repetitions, options.seconds)["ours"]
            name = f"updates on the GPU, history {history}, {envs} environments"
            report.rows.append(Row(name, timing.per_second, "frames/s", samples=tuple(timing.rates)))
            best = max(best, timing.per_second)
    with running(base) as ours:
        trainer = ours.trainer
        check = check_of_trainer(trainer, options)
        cap, every = (0.5, 0.5) if options.quick else (options.cap, 5.0)
        outcome = train_until(_synchronised(ours), check, cap, every, trainer.settings["total_frames"])
    report.rows.append(solve_row("vusfa on the GPU", [outcome]))
    report.requirements.append(Requirement("training on one GPU", best, FRAMES, "frames/s"))
    what = "time to solve on one GPU"
    report.requirements.append(Requirement(what, outcome.seconds, SECONDS, "s", at_least=False))
    return report


def _synchronised(ours: Running) -> Callable[[], int]:
    def update() -> int:
        frames = ours.update()
        torch.cuda.synchronize()
        return frames

    return update
