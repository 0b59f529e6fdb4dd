"""A page from the command line: ``vusfa report``."""

from __future__ import annotations

import shlex
import sys
import uuid
from pathlib import Path
from typing import Literal

from vusfa.envs.dynamics import MAX_STEPS
from vusfa.errors import printable
from vusfa.files import check_file, check_folder
from vusfa.report.build import write_report
from vusfa.report.cells import read_source
from vusfa.report.content import Options
from vusfa.report.page import even
from vusfa.report.runs import split_name
from vusfa.scenes import SceneSet
from vusfa.training import set_threads
from vusfa.training.loggers import make_loggers

__all__ = ["report_runs"]


def report_runs(
    sources: list[str],
    *,
    out: Path = Path("report.html"),
    title: str = "What the runs learned",
    goals_per_scene: int | None = None,
    seeds: int = 1,
    walks: int = 3,
    max_steps: int = MAX_STEPS,
    mode: Literal["sampled", "greedy"] = "sampled",
    runs: Path = Path("runs"),
    scenes: list[str] | None = None,
    megabytes: float = 40.0,
    wandb: Literal["online", "offline"] | None = None,
    project: str = "vusfa",
    threads: int = 1,
) -> None:
    """Write one self-contained HTML page of runs and results.

    Its tables are written beside it as CSV, unrounded, in the folder PAGE_tables. NAME=FOLDER labels a model
    NAME, which must not be an option's; runs of one name are seeds of one model, unless their settings
    differ. vusfa report vusfa shows a pretrained agent, without a training.

    Args:
        sources: folders of runs of vusfa train, of results, of sweeps or of experiments; names of pretrained
            agents.
        out: the page.
        title: title of the page.
        goals_per_scene: limit of goals per scene in the explorer; by default as many as megabytes allows.
        seeds: runs per model in the explorer, the first ones given.
        walks: sampled episodes to each of these goals.
        max_steps: limit of actions of these episodes.
        mode: mode of the evaluations in results.
        runs: folder of the logs and checkpoints of results, RUNS/EXPERIMENT/RUN.
        scenes: bundled names and files, if they have moved since the training.
        megabytes: size limit of the page; goals, then pictures are left out to keep it.
        wandb: send the tables to W&B, too; offline leaves them beside the page.
        project: project of W&B.
        threads: processor threads; more than 1 pays on an idle machine only.
    """
    set_threads(threads)
    check_file(out, "out")
    check_folder(out.with_name(f"{out.stem}_tables"), "out")
    options = Options(
        title=title,
        goals_per_scene=goals_per_scene,
        seeds=seeds,
        walks=walks,
        max_steps=max_steps,
        megabytes=megabytes,
        command=shlex.join(["vusfa", "report", *map(_shown, sources), "--out", _shown(str(out))]),
        scenes=None if scenes is None else SceneSet.open(scenes),
        tell=lambda line: print(printable(line), file=sys.stderr),
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
    print(f"next: open {out} in a browser", file=sys.stderr)


def _shown(source: str) -> str:
    """A path as a page shows it: relative to the current folder, or its last part."""
    name, path = split_name(source)
    absolute = path.absolute()
    inside = absolute.is_relative_to(Path.cwd())
    shown = absolute.relative_to(Path.cwd()) if inside else Path("...", absolute.name)
    return f"{name}={shown}" if name else str(shown)
