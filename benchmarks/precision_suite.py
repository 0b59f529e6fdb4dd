"""Updates with ``autocast=auto`` beside ``true`` and ``false``, on this processor and without bfloat16 units.

The latter is an imitation: in a separate process torch, oneDNN and MKL may use AVX2 alone. It multiplies as a
processor without such units does; clock and memory are still this machine's.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from contextlib import ExitStack
from dataclasses import astuple
from pathlib import Path

from benchmarks.machine import AVX2
from benchmarks.report import Options, Report, Requirement, Row
from benchmarks.timing import Sample, Timing, Work, interleaved, ratio
from benchmarks.trainer import running, small

__all__ = ["run"]

SETTINGS = ("auto", "true", "false")


def run(options: Options) -> Report:
    """Updates of VUSFA as ``vusfa train`` makes them, under both kinds of processor."""
    report = Report("precision")
    for processor, environment in (("this processor", {}), ("AVX2 alone (imitated)", AVX2)):
        timings = _elsewhere(options, environment)
        auto, slow = timings["auto"], ratio(timings["true"], timings["false"])
        for name, timing in timings.items():
            row = f"updates, {processor}, autocast="
            if name != "auto":
                report.rows.append(_row(f"{row}auto", auto, f"autocast={name}", ratio(auto, timing)))
                report.rows.append(_row(f"{row}{name}", timing))
        better = timings["true" if slow > 1 else "false"]
        text = f"autocast=auto, {processor}, share of the better of true and false"
        report.requirements.append(Requirement(text, ratio(auto, better), 0.95, "of its speed"))
    return report


def _row(name: str, timing: Timing, peer: str = "", times: float | None = None) -> Row:
    return Row(name, timing.per_second, "frames/s", peer, times, samples=tuple(timing.rates))


def _elsewhere(options: Options, environment: dict[str, str]) -> dict[str, Timing]:
    """Timings of another process, whose libraries read the environment when they start."""
    given = [str(int(options.quick)), str(options.repetitions), str(options.seconds), str(options.threads)]
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.precision_suite", *given, *options.overrides],
        env={**os.environ, **environment},
        cwd=Path(__file__).parents[1],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    taken = json.loads(done.stdout.splitlines()[-1])
    return {name: Timing(tuple(Sample(*sample) for sample in samples)) for name, samples in taken.items()}


def _main(quick: str, repetitions: str, seconds: str, threads: str, *overrides: str) -> None:
    options = Options(bool(int(quick)), int(repetitions), float(seconds), int(threads), overrides=overrides)
    with ExitStack() as stack:
        works = {}
        for setting in SETTINGS:
            changed = ["agent.model=vusfa", *small(options), f"autocast={setting}"]
            ours = stack.enter_context(running(changed))
            works[setting] = Work(ours.update, options.threads)
        timings = interleaved(works, options.repetitions, options.seconds)
    print(json.dumps({name: [astuple(s) for s in timing.samples] for name, timing in timings.items()}))


if __name__ == "__main__":
    _main(*sys.argv[1:])
