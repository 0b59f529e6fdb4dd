"""One page of what runs learned: python recipes/report.py runs/A results/table1 --out report.html

SOURCES are folders of recipes/train.py, evaluated by it or by recipes/zero_shot.py; or results: a cell, or an
experiment with all its cells. NAME=FOLDER calls a model NAME; runs of one name are seeds of one thing. The
page is a single file that asks for nothing from outside; its tables lie beside it as CSV, unrounded, in the
folder PAGE_tables, and go to W&B with --wandb.
"""

from __future__ import annotations

import shlex
import sys
import uuid
from pathlib import Path
from typing import Annotated, Literal

import tyro

from vusfa.errors import VusfaError
from vusfa.files import check_folder
from vusfa.report import Options, read_source, write_report
from vusfa.report.page import even
from vusfa.training import set_threads
from vusfa.training.loggers import make_loggers


def report(
    sources: Annotated[list[str], tyro.conf.Positional],
    *,
    out: Path = Path("report.html"),
    title: str = "What the runs learned",
    goals_per_scene: int = 24,
    seeds: int = 1,
    walks: int = 3,
    max_steps: int = 500,
    mode: Literal["sampled", "greedy"] = "sampled",
    runs: Path = Path("runs"),
    megabytes: float = 40.0,
    wandb: Literal["online", "offline"] | None = None,
    project: str = "vusfa",
    threads: int = 1,
) -> None:
    """Write a report of runs and results.

    Args:
        sources: folders of runs, cells or experiments; NAME=FOLDER calls a model NAME.
        out: the page.
        title: of the page.
        goals_per_scene: goals of each scene in the explorer, at most.
        seeds: runs of each model in the explorer, the first ones given.
        walks: sampled walks to each of these goals.
        max_steps: actions allowed in these walks.
        mode: of the evaluations that results hold.
        runs: where the trainings of results keep logs and checkpoints, as RUNS/EXPERIMENT/CELL.
        megabytes: what the page may weigh; goals, then pictures are left out to keep it.
        wandb: send the tables to W&B, too; offline leaves them beside the page.
        project: of W&B.
        threads: processor threads; more than 1 pays on an idle machine only.
    """
    set_threads(threads)
    check_folder(out.absolute().parent, "out")
    options = Options(
        title=title,
        goals_per_scene=goals_per_scene,
        seeds=seeds,
        walks=walks,
        max_steps=max_steps,
        megabytes=megabytes,
        command=shlex.join(["python", "recipes/report.py", *sources, "--out", str(out)]),
        tell=lambda line: print(line, file=sys.stderr),
    )
    read = [run for source in sources for run in read_source(source, mode, runs)]
    paths, tables = write_report(read, out, options)
    if wandb:
        kept, made = {"sources": sources, "title": title}, uuid.uuid4().hex[:8]
        with make_loggers(
            ["wandb"], out.absolute().parent, kept, run_id=made, project=project, mode=wandb, name=title
        ) as loggers:
            for name, rows in tables.items():
                if rows:
                    loggers.log_table(name, even(rows), 0)
    for path in paths:
        print(path)


if __name__ == "__main__":
    try:
        tyro.cli(report, description=__doc__)
    except VusfaError as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        print("error: interrupted", file=sys.stderr)
        sys.exit(130)
