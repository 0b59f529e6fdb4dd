"""The paper's Figure 2: python recipes/transfer.py run, then python recipes/transfer.py show

Each trained model (a cell of recipes/table1.py) is trained on towards new goals: 1, 2 and 4 steps from
trained ones, and anywhere; five sets of goals a kind, the same for all models, with training from scratch
beside it. A cell a model, seed and kind goes to results/transfer; what is there is skipped. ``show`` draws
the figure and prints the table from results alone.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import torch
import tyro
from rich.console import Console
from rich.progress import track

from vusfa.errors import CheckpointError, VusfaError
from vusfa.experiments.fine_tune import fine_tune, fine_tuning_settings
from vusfa.experiments.runs import Run, read_run, read_runs, write_run
from vusfa.experiments.transfer import KINDS, new_goals, walked_lengths
from vusfa.modules.presets import MODELS
from vusfa.report.transfer_figure import difference_table, draw_transfer, transfer_table
from vusfa.scenes import SceneSet
from vusfa.training import load_agent, run_facts, set_threads


def run(
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
) -> None:
    """Run the cells that results do not hold yet.

    Args:
        models: of the four.
        seeds: of the cells that are trained on.
        kinds: of new goals.
        sets: of goals, each kind.
        frames: of each training.
        every: frames between two points of a curve.
        source: experiment whose chosen checkpoints are trained on.
        results: where cells are read and written.
        runs: where that experiment's checkpoints lie.
        experiment: where cells go.
    """
    set_threads(1)
    for seed in seeds:
        for kind in kinds:
            for model in models:
                name = f"{model}-{seed}-{kind}"
                if (results / experiment / name / "cell.json").exists():
                    print(f"{results / experiment / name}: already there")
                    continue
                trained = read_run(results, source, f"{model}-{seed}").info["checkpoint"]
                checkpoint = runs / source / f"{model}-{seed}" / trained
                if not checkpoint.exists():
                    raise CheckpointError(
                        f"{checkpoint}: missing; run recipes/table1.py with the same --runs"
                    )
                _, scenes, state = load_agent(checkpoint)
                began, curves = time.monotonic(), []
                for index in track(range(sets), description=name, console=Console(stderr=True)):
                    goals = new_goals(scenes, state["goals"], kind, index)
                    settings = fine_tuning_settings(state["config"], goals, frames, seed)
                    pair = {
                        way: fine_tune(start, settings, scenes, every=every)
                        for way, start in (("trained on", state), ("from scratch", None))
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
                print(write_run(results, Run(experiment, name, info, {})))


def show(
    *,
    results: Path = Path("results"),
    experiment: str = "transfer",
    threshold: float = 250.0,
    scenes: list[str] | None = None,
    out: Path = Path("transfer.png"),
) -> None:
    """Print the table, and draw the figure.

    Args:
        results: folder of results.
        experiment: whose cells.
        threshold: actions an episode; the table tells after how many frames the mean comes down to it. Half
            of those that are allowed when not given.
        scenes: bundled names and files, in order; the bundled rooms that the cells name when not given.
        out: the picture.
    """
    found = read_runs(results, experiment)
    if not found:
        raise VusfaError(f"{results / experiment}: no results; run recipes/transfer.py run first")
    world = SceneSet.open(scenes or found[0].info["scenes"])
    sets = {run.info["kind"]: [entry["goals"] for entry in run.info["curves"]] for run in found}
    bounds = {kind: [walked_lengths(world, torch.tensor(g)) for g in goals] for kind, goals in sets.items()}
    print(transfer_table(found, threshold, bounds), difference_table(found), sep="\n\n")
    print(draw_transfer(found, out, bounds))


if __name__ == "__main__":
    try:
        tyro.extras.subcommand_cli_from_dict({"run": run, "show": show})
    except VusfaError as error:
        sys.exit(f"error: {error}")
