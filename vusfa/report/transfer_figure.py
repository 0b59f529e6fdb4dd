"""Tables and figure of fine-tuning, the paper's Figure 2: ``vusfa transfer show``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch

from vusfa.evaluation.baselines import RANDOM_WALK, SHORTEST_PATH
from vusfa.evaluation.exact import expected_walks
from vusfa.evaluation.statistics import Estimate, Sums, bootstrap_mean
from vusfa.experiments.runs import Run, no_results, read_runs
from vusfa.experiments.transfer import (
    FINE_TUNED,
    FROM_SCRATCH,
    KINDS,
    area_under,
    curves_of,
    frames_to,
)
from vusfa.files import check_file, replacing
from vusfa.report.markdown import markdown
from vusfa.scenes import SceneSet

__all__ = [
    "baseline_lengths",
    "difference_table",
    "draw_transfer",
    "mean_over",
    "show_transfer",
    "transfer_table",
    "transfer_tables",
]

STARTS = (FINE_TUNED, FROM_SCRATCH)
_MEAN = "length, mean of the curve"
BOUNDS = (RANDOM_WALK, SHORTEST_PATH)
PAIRS = (("usfa", "gvf"), ("sfdp", "usfa"), ("vusfa", "sfdp"), ("vusfa", "gvf"))
_COLOURS = {"gvf": "#0072b2", "usfa": "#e69f00", "sfdp": "#009e73", "vusfa": "#cc79a7"}


def mean_over(values: Sequence[Sequence[float]]) -> Estimate:
    """Mean over seeds and sets of goals with its bootstrap interval, NaN left out.

    Args:
        values: one per seed and set of goals.

    >>> mean_over([[1.0, 3.0], [1.0, 3.0]]).value
    2.0
    """
    numbers = torch.tensor(values, dtype=torch.float64)
    there = ~numbers.isnan()
    sums = Sums(numbers.nan_to_num(), there.to(torch.float64))
    return bootstrap_mean(sums, torch.zeros(numbers.shape[1], dtype=torch.int64))


def transfer_tables(runs: Sequence[Run], scenes: SceneSet, threshold: float = 250.0) -> tuple[str, str]:
    """:func:`transfer_table` with the baselines' lengths in these scenes, and :func:`difference_table`."""
    return transfer_table(runs, threshold, baseline_lengths(runs, scenes)), difference_table(runs)


def baseline_lengths(runs: Sequence[Run], scenes: SceneSet) -> dict[str, list[tuple[float, float]]]:
    """By kind, for each set of goals, the expected actions of a random walk and of the shortest path, as
    :func:`~vusfa.experiments.transfer.walked_lengths`; every goal is computed once."""
    sets = {run.info["kind"]: [entry["goals"] for entry in curves_of(run.info)] for run in runs}
    goals = torch.tensor(sorted({goal for kind in sets.values() for group in kind for goal in group}))
    walks = expected_walks(None, scenes, goals)
    groups = {
        kind: [torch.isin(goals, torch.tensor(group)) for group in groups] for kind, groups in sets.items()
    }
    return {
        kind: [(walks.length[rows].mean().item(), walks.shortest[rows].mean().item()) for rows in masks]
        for kind, masks in groups.items()
    }


def transfer_table(
    runs: Sequence[Run], threshold: float, bounds: Mapping[str, Sequence[tuple[float, float]]] | None = None
) -> str:
    """Markdown: per kind, model and start the mean length over the training, at its start and end, and the
    frames to a threshold, each with its 95 % interval over seeds and sets of goals.

    Args:
        runs: of the experiment.
        threshold: actions per episode.
        bounds: see :func:`baseline_lengths`; a row each below the models.
    """
    rows, bounds, to_threshold = [], bounds or {}, f"frames to {threshold:g}"
    for kind, model, here in _groups(runs):
        for start in STARTS:
            curves = [[entry[start] for entry in curves_of(run.info)] for run in here]
            area = mean_over([[area_under(c["frames"], c["length"]) for c in row] for row in curves])
            first, last = (mean_over([[c["length"][end] for c in row] for row in curves]) for end in (0, -1))
            to = [[frames_to(c["frames"], c["length"], threshold) for c in row] for row in curves]
            arrived = sum(not math.isnan(value) for row in to for value in row)
            row = {"new goals": kind, "model": model, "training": start, "seeds": len(here)}
            row |= {_MEAN: _number(area), "at first": _number(first), "at last": _number(last)}
            row[to_threshold] = _number(mean_over(to), 0) if arrived else None
            rows.append(row | {"came there": f"{arrived} of {sum(map(len, to))}"})
    for kind, pairs in bounds.items():
        for index, name in enumerate(BOUNDS):
            length = _number(mean_over([[pair[index] for pair in pairs]]))
            rows.append({"new goals": kind, "model": name, _MEAN: length})
    heads = ["new goals", "model", "training", "seeds", _MEAN, "at first", "at last"]
    return markdown(rows, [*heads, to_threshold, "came there"])


def difference_table(runs: Sequence[Run]) -> str:
    """Markdown: differences of the mean length over the training, paired by seed and set of goals, with 95 %
    intervals: of each model fine-tuned from the same model from scratch, and of neighbors fine-tuned.

    Below 0: fewer actions than the one it is compared with.

    Args:
        runs: of the experiment; the seeds that both sides of a pair have count.
    """
    areas: dict[tuple[str, str, str], dict[int, list[float]]] = {}
    for run in runs:
        for start in STARTS:
            here = areas.setdefault((run.info["kind"], run.info["model"], start), {})
            curves = [entry[start] for entry in curves_of(run.info)]
            here[run.info["seed"]] = [area_under(c["frames"], c["length"]) for c in curves]
    rows = []
    for kind in KINDS:
        models = [model for model in _COLOURS if (kind, model, STARTS[0]) in areas]
        pairs = [((model, STARTS[0]), (model, STARTS[1])) for model in models]
        pairs += [((a, STARTS[0]), (b, STARTS[0])) for a, b in PAIRS if a in models and b in models]
        for one, other in pairs:
            left, right = areas[(kind, *one)], areas[(kind, *other)]
            seeds = sorted(left.keys() & right.keys())
            if seeds:
                paired = [[a - b for a, b in zip(left[s], right[s], strict=True)] for s in seeds]
                against = other[0] if one[0] != other[0] else other[1]
                row = {"new goals": kind, FINE_TUNED: one[0], "against": against, "seeds": len(seeds)}
                rows.append(row | {"difference, mean of the curve": _number(mean_over(paired))})
    return markdown(rows, list(rows[0]) if rows else [])


def draw_transfer(
    runs: Sequence[Run],
    path: str | Path,
    bounds: Mapping[str, Sequence[tuple[float, float]]] | None = None,
) -> Path:
    """Draw episode length over frames as PNG, atomically.

    A panel per kind of goals, with 95 % bands and the baselines in gray (``bounds``, see
    :func:`transfer_table`).
    """
    from matplotlib.figure import Figure  # of the extra "recipes"

    kinds = [kind for kind in KINDS if any(run.info["kind"] == kind for run in runs)]
    figure = Figure(figsize=(4.2 * len(kinds), 4.6), layout="constrained")
    panels = figure.subplots(1, len(kinds), sharey=True, squeeze=False)[0]
    for kind, model, here in _groups(runs):
        panel = panels[kinds.index(kind)]
        for start, style in zip(STARTS, ("-", ":"), strict=True):
            curves = [[entry[start] for entry in curves_of(run.info)] for run in here]
            frames = curves[0][0]["frames"]
            points = [
                mean_over([[c["length"][i] for c in row] for row in curves]) for i in range(len(frames))
            ]
            thousand = [frame / 1000 for frame in frames]
            label = model if start == FINE_TUNED else f"{model}, from scratch"
            colour = _COLOURS.get(model, "#555555")
            panel.plot(thousand, [p.value for p in points], style, color=colour, label=label)
            panel.fill_between(
                thousand, [p.low for p in points], [p.high for p in points], color=colour, alpha=0.15, lw=0
            )
        panel.set_title(f"new goals: {kind}")
        panel.set_xlabel("thousand frames")
    for kind, panel in zip(kinds, panels, strict=True):
        for index, style in enumerate(("--", "-.") if kind in (bounds or {}) else ()):
            height = mean_over([[pair[index] for pair in (bounds or {})[kind]]]).value
            panel.axhline(height, linestyle=style, color="#777777", lw=1, label=BOUNDS[index])
    panels[0].set_ylabel("actions per episode")
    handles, labels = panels[-1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False, fontsize=8)
    with replacing(path) as unfinished:
        figure.savefig(unfinished, format="png", dpi=120)
    return Path(path)


def _groups(runs: Sequence[Run]) -> list[tuple[str, str, list[Run]]]:
    models = [*_COLOURS, *sorted({run.info["model"] for run in runs} - _COLOURS.keys())]
    groups = []
    for kind in KINDS:
        for model in models:
            here = [run for run in runs if (run.info["kind"], run.info["model"]) == (kind, model)]
            if here:
                groups.append((kind, model, here))
    return groups


def _number(estimate: Estimate, digits: int = 1) -> str:
    value, low, high = (f"{part:,.{digits}f}" for part in (estimate.value, estimate.low, estimate.high))
    return f"{value} [{low}, {high}]"


def show_transfer(
    *,
    results: Path = Path("results"),
    experiment: str = "transfer",
    threshold: float = 250.0,
    scenes: list[str] | None = None,
    out: Path = Path("transfer.png"),
) -> None:
    """Print the tables of ``vusfa transfer run``, and draw the figure.

    Args:
        results: folder of results.
        experiment: name of the experiment.
        threshold: actions per episode; the table has the frames until the mean falls to it.
        scenes: bundled names and files, in order; the bundled rooms that the runs name when not given.
        out: the picture.
    """
    check_file(out)
    found = read_runs(results, experiment)
    if not found:
        raise no_results(results, experiment, command="vusfa transfer run")
    world = SceneSet.open(scenes or found[0].info["scenes"])
    print(*transfer_tables(found, world, threshold), sep="\n\n")
    bounds = baseline_lengths(found, world)
    print(draw_transfer(found, out, bounds))
