"""The paper's Figure 2, its runs: ``vusfa transfer run``."""

from __future__ import annotations

import itertools
import time
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import track

from vusfa.cluster.cells import Cell, run_cells
from vusfa.envs.scene_env import check_counts
from vusfa.errors import CheckpointError, check_choices
from vusfa.experiments.fine_tune import fine_tune, fine_tuning_settings
from vusfa.experiments.runs import Run, check_run_name, read_run, write_run
from vusfa.experiments.transfer import FINE_TUNED, FROM_SCRATCH, KINDS, new_goals
from vusfa.modules.config import MODELS
from vusfa.training import load_agent, run_facts, set_threads

__all__ = ["run_transfer", "transfer_cell"]


def run_transfer(
    *,
    models: list[str] = list(MODELS),  # noqa: B006
    seeds: list[int] = [0, 1, 2, 3, 4],  # noqa: B006
    kinds: list[str] = list(KINDS),  # noqa: B006
    sets: int = 5,
    frames: int = 500_000,
    every: int = 50_000,
    source: str = "table1",
    results: Path = Path("results"),
    runs: Path = Path("runs"),
    experiment: str = "transfer",
    launcher: str = "serial",
    launcher_options: list[str] = [],  # noqa: B006
) -> None:
    """Fine-tune the trained models of Table 1 towards new goals near and far; train from scratch beside it.

    Results go to RESULTS/EXPERIMENT/MODEL-SEED-KIND; what is there is skipped. ``vusfa transfer show`` draws
    the figure and prints the tables.

    Args:
        models: of the four.
        seeds: of the runs that are fine-tuned.
        kinds: of new goals.
        sets: of goals, each kind.
        frames: of each training.
        every: frames between two points of a curve.
        source: experiment whose chosen checkpoints are fine-tuned.
        results: where results are read and written.
        runs: where that experiment's checkpoints lie.
        experiment: where results go.
        launcher, launcher_options: what runs the cells: serial, local, slurm or ray (docs/cluster.md).
    """
    check_choices("models", models, MODELS)
    check_choices("kinds", kinds, KINDS)
    check_counts(sets=(sets, 1), frames=(frames, 1), every=(every, 1))
    check_run_name(experiment)
    numbers: dict[str, Any] = {"sets": sets, "frames": frames, "every": every}
    places: dict[str, Any] = {"source": source, "results": results, "runs": runs, "experiment": experiment}
    cells = [
        Cell(
            results / experiment / f"{model}-{seed}-{kind}",
            partial(transfer_cell, model, seed, kind, numbers, places),
        )
        for seed in seeds
        for kind in kinds
        for model in models
    ]
    for model, seed in itertools.product(models, seeds):  # what is missing shows before any work
        read_run(results, source, f"{model}-{seed}")
    run_cells(cells, launcher, launcher_options)


def transfer_cell(model: str, seed: int, kind: str, numbers: dict[str, int], places: dict[str, Any]) -> Path:
    """Fine-tune one trained model towards the sets of one kind of goals, and train from scratch beside it.

    Args:
        model, seed, kind: of the cell.
        numbers, places: arguments of :func:`run_transfer` by name.

    Raises:
        ResultError, CheckpointError: the model's result or checkpoint is missing.
    """
    sets, frames, every = (numbers[name] for name in ("sets", "frames", "every"))
    source, results, runs, experiment = (places[n] for n in ("source", "results", "runs", "experiment"))
    set_threads(1)
    name = f"{model}-{seed}-{kind}"
    trained = read_run(results, source, f"{model}-{seed}").info["checkpoint"]
    checkpoint = runs / source / f"{model}-{seed}" / trained
    if not checkpoint.exists():
        raise CheckpointError(f"{checkpoint}: missing; run vusfa table1 with the same --runs")
    _, scenes, state = load_agent(checkpoint)
    began, curves = time.monotonic(), []
    for index in track(range(sets), description=name, console=Console(stderr=True)):
        goals = new_goals(scenes, state["goals"], kind, index)
        settings = fine_tuning_settings(state["config"], goals, frames, seed)
        pair = {
            label: fine_tune(start, settings, scenes, every=every)
            for label, start in ((FINE_TUNED, state), (FROM_SCRATCH, None))
        }
        curves.append({"goals": goals.tolist(), **pair})
    info = {
        **run_facts(state),
        "kind": kind,
        "frames": frames,
        "cell_s": round(time.monotonic() - began, 1),
        "command": f"recipes/transfer.py run --models {model} --seeds {seed} --kinds {kind}",
        "curves": curves,
    }
    return write_run(results, Run(experiment, name, info, {}))
