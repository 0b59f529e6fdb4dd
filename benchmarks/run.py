"""Measure the library beside its alternatives: python benchmarks/run.py --suite train

Needs the extra ``bench``. Writes OUT/SUITE.json, with --avx2 OUT/SUITE-avx2.json, and prints tables; each
requirement is a line, PASS or FAIL. The exit code is 1 when a requirement fails, except with --quick, whose
numbers mean nothing.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from enum import StrEnum
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

sys.path.insert(0, str(Path(__file__).parents[1]))  # a script's own folder is there, not the one above

from benchmarks.machine import AVX2, describe_machine, foreign_load
from benchmarks.report import Options, Report, write_reports
from benchmarks.table import print_machine, print_report
from vusfa.training.memory import keep_memory


class Suite(StrEnum):
    """Suites that can be measured."""

    env = "env"
    train = "train"
    collect = "collect"
    update = "update"
    solve = "solve"
    precision = "precision"
    memory = "memory"
    eval = "eval"
    gpu = "gpu"
    scaling = "scaling"
    ranks = "ranks"
    all = "all"


#: The modules of each suite, in order; each has ``run(options) -> Report``.
MODULES: dict[str, tuple[str, ...]] = {
    "env": ("env_suite",),
    "collect": ("collect_suite",),
    "update": ("update_suite",),
    "solve": ("solve_suite",),
    "precision": ("precision_suite",),
    "memory": ("memory_suite",),
    "eval": ("eval_suite",),
    "gpu": ("gpu_suite",),
    "scaling": ("scaling_suite",),
    "ranks": ("ranks_suite",),
}
#: Several modules under one name.
GROUPS = {"train": ("collect", "update", "solve", "memory"), "all": tuple(MODULES)}
#: Load of other programs, in cores, above which timings are doubtful.
BUSY = 0.2


def measure(suite: str, options: Options, keep: Callable[[list[Report]], object]) -> list[Report]:
    """Run the modules of a suite.

    Args:
        suite: a name of :class:`Suite`.
        options: of the measurement.
        keep: gets the reports so far after every module, and after every training of the time to solve: what
            a measurement that is interrupted leaves.
    """
    reports: list[Report] = []
    for name in [name for part in GROUPS.get(suite, (suite,)) for name in MODULES[part]]:
        module = import_module(f"benchmarks.{name}")
        if name == "solve_suite":
            reports.append(module.run(options, lambda part: keep([*reports, part])))
        else:
            reports.append(module.run(options))
        keep(reports)
    return reports


def main(
    suite: Annotated[Suite, typer.Option(help="what to measure")] = Suite.all,
    quick: Annotated[bool, typer.Option(help="tiny sizes, to see that everything runs")] = False,
    out: Annotated[Path, typer.Option(help="folder of the JSON file")] = Path("runs/benchmarks"),
    threads: Annotated[int, typer.Option(min=1, help="threads of torch, on two cores")] = 2,
    repetitions: Annotated[int, typer.Option(min=1, help="turns of each workload")] = 5,
    seconds: Annotated[float, typer.Option(min=0.0, help="length of a turn")] = 1.0,
    cap: Annotated[
        float, typer.Option(min=0.0, help="seconds of a training to solve, with its checks")
    ] = 900.0,
    change: Annotated[
        list[str] | None, typer.Option("--set", help="a recipe's setting: autocast=true")
    ] = None,
    avx2: Annotated[bool, typer.Option(help="imitate a processor that has AVX2 alone")] = False,
) -> None:
    """Measure, print and write down."""
    if avx2 and not AVX2.items() <= os.environ.items():  # read by the libraries when they are loaded
        os.execve(sys.executable, sys.orig_argv, {**os.environ, **AVX2})
    options = Options(quick, repetitions, seconds, threads, cap, tuple(change or ()), avx2)
    if quick:
        options = replace(options, repetitions=1, seconds=0.0)
    keep_memory()  # as in the recipes, and for the peers, too
    multiprocessing.set_forkserver_preload(["benchmarks.trainer"])  # imported once, for all processes
    console, machine = Console(), describe_machine()
    machine["foreign_load"] = round(foreign_load(), 2)
    print_machine(machine, console)
    if machine["foreign_load"] > BUSY:
        console.print(f"other programs keep {machine['foreign_load']} cores busy: timings are doubtful")
    path = out / f"{suite.value}{'-avx2' * avx2}.json"
    reports = measure(suite.value, options, partial(write_reports, path, machine, options))
    for report in reports:
        print_report(report, console, quick)
    console.print(f"written: {path}", soft_wrap=True)
    failed = any(not line.passed for report in reports for line in report.requirements)
    raise typer.Exit(1 if failed and not quick else 0)


if __name__ == "__main__":
    typer.run(main)
