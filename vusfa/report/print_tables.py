"""All tables of experiments from results on disk: ``vusfa tables``."""

from __future__ import annotations

import sys
from pathlib import Path

from vusfa.evaluation.long_table import MEAN_OF_STATES, SUBSETS
from vusfa.experiments.runs import read_runs
from vusfa.files import check_file, check_folder, write_csv
from vusfa.report.experiment import Experiment, read_experiment
from vusfa.report.generated import write_documents
from vusfa.report.growth_plot import draw_growth
from vusfa.report.markdown import flat_rows, markdown
from vusfa.report.result_tables import (
    columns,
    comparison_rows,
    distance_rows,
    middle_rows,
    model_rows,
    run_rows,
)
from vusfa.report.robustness import robustness_table
from vusfa.report.success_plot import draw_success
from vusfa.report.unseen import unseen_table
from vusfa.scenes import SceneSet
from vusfa.training import set_threads

__all__ = ["print_tables"]

MODES = {"sampled": "actions drawn", "greedy": "the likeliest action", "exact": "computed, actions drawn"}


def print_tables(
    experiments: list[str] = ["table1"],  # noqa: B006
    *,
    results: Path = Path("results"),
    out: Path | None = None,
    docs: Path | None = None,
    plot: Path | None = None,
    scenes: list[str] | None = None,
    resamples: int = 2000,
    threads: int = 1,
) -> None:
    """Print the tables of experiments that share their episodes, in Markdown and with 95 % intervals.

    Intervals are over seeds and goals; the tables are written as CSV, too, unrounded. Nothing is trained and
    no episode is run: the numbers come from the episodes in RESULTS.

    Args:
        experiments: folders of results, shown together; or generalise or robustness alone.
        results: their folder.
        out: folder for the CSV files; RESULTS/tables when not given.
        docs: write the tables that the documentation shows to this folder (docs/generated), and print none.
        plot: draw success to trained and to unseen goals as PNG; of generalise, success and SPL by the number
            of rooms trained in.
        scenes: bundled names and files, in order; the bundled rooms that the runs name when not given.
        resamples: of the bootstrap.
        threads: processor threads; more than 1 pays on an idle machine only.
    """
    set_threads(threads)
    if docs is not None:
        for path in write_documents(results, check_folder(docs, "docs")):
            print(path)
    elif experiments == ["generalise"]:
        drawn = None if plot is None else check_file(plot, "plot")
        found = read_runs(results, "generalise")
        print(unseen_table(found))
        if drawn is not None:
            print(draw_growth(found, drawn), file=sys.stderr)
    elif experiments == ["robustness"]:
        print(robustness_table(read_runs(results, "robustness")))
    else:
        folder = check_folder(out or results / "tables", "out")
        world = SceneSet.open(scenes) if scenes else None
        if plot is not None:
            check_file(plot, "plot")
        _print(read_experiment(results, experiments, world), folder, resamples, plot)


def _print(experiment: Experiment, folder: Path, resamples: int, plot: Path | None) -> None:
    names = ["model", "seeds", "num_goals", *columns()]
    runs = run_rows(experiment)
    heads = ["model", "seed", "frames", "checkpoint", "training_s", "trained", "solved", "exact_z"]
    _show("Runs", runs, heads)
    unsolved = [
        f"{row['model']} of seed {row['seed']} ({100 * row['trained']:.1f} % after {row['frames']:,} frames)"
        for row in runs
        if row["frames"] and not row["solved"]
    ]
    if unsolved:
        print(f"Trained goals NOT solved (success below 90 %): {'; '.join(unsolved)}.\n")
    every, far, middle, compared = [], [], [], []
    for mode, words in MODES.items():
        found = model_rows(experiment, mode, resamples)
        for subset in SUBSETS:
            rows = [row for row in found if (row["goals"], row["scene"]) == (subset, MEAN_OF_STATES)]
            _show(f"{subset.capitalize()} goals, {words}", rows, names)
        if mode == "sampled":
            for subset in ("unseen", "all"):
                rows = [row for row in found if row["goals"] == subset]
                _show(f"Scene by scene, {subset} goals, {words}", rows, ["scene", *names])
        every += found
        far += distance_rows(experiment, mode, resamples)
        middle += middle_rows(experiment, mode, resamples)
        compared += comparison_rows(experiment, mode, resamples)
    if plot is not None:
        chosen = [row for row in every if (row["mode"], row["scene"]) == ("sampled", MEAN_OF_STATES)]
        print(draw_success(chosen, plot), file=sys.stderr)
    drawn = [[row for row in rows if row["mode"] == "sampled"] for rows in (far, middle, compared)]
    _show("By actions from the nearest trained goal, actions drawn", drawn[0], ["distance", *names])
    _show("Interquartile mean over seeds and scenes, actions drawn", drawn[1], ["goals", *names])
    heads = ["goals", "metric", "model", "against", "seeds", "difference", "improvement"]
    _show("Paired differences and probabilities of improvement, both in %, actions drawn", drawn[2], heads)
    for name, rows in (
        ("runs", runs), ("models", every), ("distance", far), ("middle", middle), ("compared", compared),
    ):  # fmt: skip
        print(write_csv(folder / f"{name}.csv", flat_rows(rows)), file=sys.stderr)


def _show(title: str, rows: list[dict[str, object]], columns: list[str]) -> None:
    """Print a table with its title, if it has rows."""
    if rows:
        print(f"### {title}\n\n{markdown(rows, columns)}\n")
