"""The paper's Table 1: ``vusfa table1``."""

from __future__ import annotations

import dataclasses
import shutil
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

from omegaconf import open_dict

from vusfa.cluster.cells import Cell, run_cells
from vusfa.conf.compose import as_text
from vusfa.errors import ConfigError, check_choices
from vusfa.experiments.measure import choose_checkpoint, measure_checkpoint
from vusfa.experiments.runs import check_run_name, read_run, write_run
from vusfa.experiments.training import compose_settings, train
from vusfa.files import check_folder, replacing
from vusfa.limits import brief
from vusfa.modules.config import MODELS

__all__ = ["checkpoints", "table1", "table1_cell"]


def checkpoints(folder: Path, overrides: list[str], stages: list[float]) -> list[Path]:
    """Train up to each stage and keep a checkpoint there; existing ones are kept.

    With ``early_stopping.success`` the only checkpoint is the one that the training ended with.
    """
    cfg = compose_settings([*overrides, f"folder={as_text(str(folder))}", "evaluation.goals=null"])
    if cfg.early_stopping.success is not None:
        stages = stages[-1:]
    # interpolated now: schedules end where the whole training ends, whichever part of it runs
    total, last = cfg.total_frames, folder / "checkpoint.pt"
    kept = [folder / f"checkpoint-{round(100 * stage)}.pt" for stage in stages]
    for stage, path in zip(stages, kept, strict=True):
        if path.exists():
            continue
        with open_dict(cfg):
            cfg.total_frames, cfg.resume = round(stage * total), str(last) if last.exists() else None
        code = train(cfg, overrides).exit_code
        if code:
            sys.exit(code)
        with replacing(path) as unfinished:
            shutil.copy(last, unfinished)
    return kept


def table1(
    overrides: list[str] = [],  # noqa: B006
    *,
    experiment: str = "table1",
    models: list[str] = ["untrained", *MODELS],  # noqa: B006
    seeds: list[int] = [0, 1, 2, 3, 4],  # noqa: B006
    stages: list[float] = [0.8, 0.9, 1.0],  # noqa: B006
    results: Path = Path("results"),
    runs: Path = Path("runs"),
    manifest: Path | None = None,
    again: bool = False,
    launcher: str = "serial",
    launcher_options: list[str] = [],  # noqa: B006
) -> None:
    """The paper's Table 1: train, choose a checkpoint and evaluate, per model and seed.

    Results go to RESULTS/EXPERIMENT/MODEL-SEED; existing ones are skipped, interrupted trainings resumed.
    "untrained" is VUSFA before its first update. ``vusfa tables`` prints the tables.

    Args:
        overrides: settings of vusfa train, such as preset=paper.
        experiment: name of the table.
        models: of the four, and untrained.
        seeds: the same for all models.
        stages: fractions of the training after which a checkpoint is a candidate.
        results: where results are written.
        runs: where trainings keep their checkpoints.
        manifest: of episodes; that of the bundled rooms when not given.
        again: evaluate existing results again, from the chosen checkpoints.
        launcher, launcher_options: what runs the cells: serial, local, slurm or ray (docs/cluster.md).
    """
    check_choices("models", models, ["untrained", *MODELS])
    check_run_name(experiment)
    if not stages or not all(0 < stage <= 1 for stage in stages):
        raise ConfigError(f"stages is {brief(stages)}; give shares of the training, above 0 and up to 1")
    check_folder(runs / experiment, "runs")
    places: dict[str, Any] = {
        "experiment": experiment,
        "results": results,
        "runs": runs,
        "manifest": manifest,
    }
    cells = [
        Cell(
            results / experiment / f"{model}-{seed}",
            partial(table1_cell, overrides, model, seed, stages, places),
        )
        for seed in seeds
        for model in models
    ]
    run_cells(cells, launcher, launcher_options, again)


def table1_cell(
    overrides: list[str], model: str, seed: int, stages: list[float], places: dict[str, Any]
) -> Path:
    """Train and evaluate one model with one seed; of an existing result only the evaluation is made again.

    Args:
        overrides, stages: of :func:`table1`.
        model, seed: of the cell.
        places: further arguments of :func:`table1` by name.
    """
    experiment, results, runs, manifest = (places[n] for n in ("experiment", "results", "runs", "manifest"))
    name, began, untrained = f"{model}-{seed}", time.monotonic(), model == "untrained"
    run, facts = runs / experiment / name, dict[str, Any]()
    if (results / experiment / name / "cell.json").exists():
        info = read_run(results, experiment, name).info
        chosen, settings = run / info["checkpoint"], info["overrides"]
        facts = {key: info[key] for key in ("validation_spl", "cell_s") if key in info}
    else:
        settings = [*overrides, f"agent.model={'vusfa' if untrained else model}", f"seed={seed}"]
        kept = checkpoints(run, settings, [0.0] if untrained else sorted(stages))
        scores = choose_checkpoint(kept, manifest)
        chosen = next(iter(scores))
        facts["validation_spl"] = {path.name: score for path, score in scores.items()}
    facts |= {"model": model, "row": model} if untrained else {}
    measured = measure_checkpoint(chosen, experiment, name, settings, manifest)
    facts.setdefault("cell_s", round(time.monotonic() - began, 1))
    return write_run(results, dataclasses.replace(measured, info={**measured.info, **facts}))
