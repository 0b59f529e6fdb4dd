"""Tables of an experiment: numbers with intervals, beside the random walk and the shortest path.

Rows are dictionaries; a number with an interval is an :class:`~vusfa.evaluation.statistics.Estimate`. Means
are over goals, each of which weighs the same, unless a row says "mean of scenes".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from vusfa.evaluation.baselines import RANDOM_WALK, SHORTEST_PATH
from vusfa.evaluation.long_table import (
    DISTANCE_BINS,
    MEAN_OF_SCENES,
    MEAN_OF_STATES,
    SUBSETS,
    distance_bin,
)
from vusfa.evaluation.metrics import metrics_within
from vusfa.evaluation.statistics import (
    Draws,
    Sums,
    bootstrap_improvement,
    bootstrap_iqm,
    bootstrap_mean,
    make_draws,
    paired_difference,
)
from vusfa.modules.config import MODELS
from vusfa.report.experiment import Experiment

__all__ = [
    "columns",
    "comparison_rows",
    "distance_rows",
    "middle_rows",
    "model_pairs",
    "model_rows",
    "run_rows",
]

Row = dict[str, Any]

COMPARED = ("success_500", "success_100", "spl")
#: Share of successful episodes from which trained goals count as solved.
SOLVED = 0.9


def columns() -> list[str]:
    """All metrics but ``length``, which ``length_ratio`` compares with the shortest path."""
    return [metric.name for metric in metrics_within((500, 100), 500) if metric.name != "length"]


def run_rows(experiment: Experiment) -> list[Row]:
    """One row per run: length of the training, whether the trained goals are solved, and the difference of
    sampled and exact success.

    Returns:
        rows with model, seed, run, frames, checkpoint, training_s, cell_s, trained (success within 500),
        solved, exact_z: the sampled success minus the exact one in standard deviations. Starts are drawn
        uniformly, so an episode to goal g succeeds with the probability p_g, and the deviation is that of
        ``sum_g p_g (1 - p_g) / n_g``. NaN without exact values.
    """
    rows = []
    for label, runs in experiment.runs.items():
        for run in runs:
            found = experiment.sums(label, "sampled", [run.seed])["success_500"]
            exact = experiment.sums(label, "exact", [run.seed]).get("success_500")
            over, under = (part[0, experiment.trained].sum() for part in found)
            reached = (over / under).item()
            row = {"model": label, "seed": run.seed, "run": f"{run.experiment}/{run.name}"}
            row |= {key: run.info.get(key) for key in ("frames", "checkpoint", "training_s", "cell_s")}
            row |= {"trained": reached, "solved": reached >= SOLVED}
            rows.append(row | {"exact_z": math.nan if exact is None else _deviations(found, exact)})
    return rows


def _deviations(sampled: Sums, exact: Sums) -> float:
    chance, number = exact.numerator[0].clamp(0, 1), sampled.denominator[0]
    variance = (number * chance * (1 - chance)).sum()
    gap = (sampled.numerator[0] - number * chance).sum()
    return (gap / variance.sqrt()).item() if variance > 0 else math.nan


def model_rows(
    experiment: Experiment,
    mode: str,
    resamples: int = 2000,
    places: Sequence[str] | None = None,
    metrics: Sequence[str] | None = None,
) -> list[Row]:
    """One row per model, subset of goals and scene, with both averages over the scenes; the random walk and
    the shortest path are among the models.

    Args:
        experiment: the runs.
        mode: ``sampled``, ``greedy`` or ``exact``.
        resamples: of the bootstrap over seeds and goals.
        places: names of scenes and of averages; all by default.
        metrics: names of metrics; all by default.

    Returns:
        rows with mode, goals, scene, model, seeds, num_goals and the metrics that there are.
    """
    rows: list[Row] = []
    names = [scene.name for scene in experiment.scenes.scenes]
    for subset, mask in _subsets(experiment).items():
        parts = {name: mask & (experiment.scene == index) for index, name in enumerate(names)}
        parts |= {MEAN_OF_SCENES: mask, MEAN_OF_STATES: mask}
        for place in parts if places is None else places:
            head = {"mode": mode, "goals": subset, "scene": place}
            found = _rows_of(
                experiment, mode, parts[place], resamples, metrics, by_scene=place == MEAN_OF_SCENES
            )
            rows += [head | row for row in found]
    return rows


def distance_rows(
    experiment: Experiment,
    mode: str,
    resamples: int = 2000,
    models: Sequence[str] | None = None,
    metrics: Sequence[str] | None = None,
) -> list[Row]:
    """One row per model and distance of the goal from the nearest trained one, in actions.

    Args:
        experiment, mode, resamples, metrics: see :func:`model_rows`.
        models: labels of models and baselines; all by default.
    """
    rows: list[Row] = []
    bins = torch.bucketize(experiment.distance_to_trained, torch.tensor(DISTANCE_BINS), right=True) - 1
    for index in bins[bins >= 0].unique().tolist():
        head = {"mode": mode, "distance": distance_bin(index)}
        rows += [head | row for row in _rows_of(experiment, mode, bins == index, resamples, metrics, models)]
    return rows


def middle_rows(experiment: Experiment, mode: str, resamples: int = 2000) -> list[Row]:
    """The interquartile mean over seeds and scenes, per model and subset of goals.

    Args:
        experiment, mode: see :func:`model_rows`.
        resamples: of the bootstrap over seeds within scenes.
    """
    rows = []
    for subset, mask in _subsets(experiment).items():
        for label in experiment.runs:
            sums = experiment.sums(label, mode)
            row: Row = {"mode": mode, "goals": subset, "model": label, "seeds": len(experiment.runs[label])}
            for name in COMPARED:
                if name in sums:
                    scores = _scores(sums[name], experiment.scene, mask)
                    row[name] = bootstrap_iqm(scores, resamples=resamples)
            if sums:
                rows.append(row)
    return rows


def model_pairs(experiment: Experiment) -> list[tuple[str, str]]:
    """Each model and the one before it, the last and the first, and all with the untrained network and the
    random walk."""
    four = [name for name in MODELS if name in experiment.runs]
    pairs = [*zip(four[1:], four, strict=False)]
    pairs += [(four[-1], four[0])] if len(four) > 2 else []
    extra = [label for label in experiment.runs if label not in (*MODELS, "untrained")]
    pairs += [(label, four[-1]) for label in extra if four]
    pairs += [(name, "untrained") for name in four if "untrained" in experiment.runs]
    return pairs + [(label, RANDOM_WALK) for label in experiment.runs]


def comparison_rows(
    experiment: Experiment,
    mode: str,
    resamples: int = 2000,
    pairs: Sequence[tuple[str, str]] | None = None,
) -> list[Row]:
    """One model against another, paired by seed and goal.

    Args:
        experiment, mode, resamples: see :func:`model_rows`.
        pairs: labels; :func:`model_pairs` by default.

    Returns:
        rows with mode, goals, metric, model, against, seeds (in common), difference (of pairs: same seeds,
        same goals) and improvement (probability that a run of the model does better in a scene than one of
        the other; none against the random walk).
    """
    rows: list[Row] = []
    for subset, mask in _subsets(experiment).items():
        scene = experiment.scene[mask]
        for label, other in model_pairs(experiment) if pairs is None else pairs:
            seeds = experiment.seeds(label)
            if other != RANDOM_WALK:
                seeds = [seed for seed in seeds if seed in experiment.seeds(other)]
            one, two = (experiment.sums(name, mode, seeds) for name in (label, other))
            for name in [name for name in COMPARED if seeds and name in one and name in two]:
                first, second = (_masked(sums[name], mask) for sums in (one, two))
                row: Row = {"mode": mode, "goals": subset, "metric": name, "model": label, "against": other}
                row["seeds"] = len(seeds)
                row["difference"] = paired_difference(
                    first, second, scene, draws=_draws(len(seeds), scene, resamples)
                )
                if other != RANDOM_WALK:
                    better, worse = (_scores(sums[name], experiment.scene, mask) for sums in (one, two))
                    row["improvement"] = bootstrap_improvement(better, worse, resamples=resamples)
                rows.append(row)
    return rows


def _subsets(experiment: Experiment) -> dict[str, Tensor]:
    masks = (experiment.trained, ~experiment.trained, torch.ones_like(experiment.trained))
    return {name: mask for name, mask in zip(SUBSETS, masks, strict=True) if bool(mask.any())}


def _draws(seeds: int, scene: Tensor, resamples: int) -> Draws:
    return _kept_draws(seeds, tuple(scene.tolist()), resamples)


@lru_cache(maxsize=8)
def _kept_draws(seeds: int, scene: tuple[int, ...], resamples: int) -> Draws:
    """Bootstrap draws, cached for all tables of these goals."""
    return make_draws(seeds, torch.tensor(scene), resamples=resamples)


def _rows_of(
    experiment: Experiment,
    mode: str,
    mask: Tensor,
    resamples: int,
    metrics: Sequence[str] | None,
    models: Sequence[str] | None = None,
    by_scene: bool = False,
) -> list[Row]:
    rows, scene = [], experiment.scene[mask]
    for label in [*experiment.runs, RANDOM_WALK, SHORTEST_PATH] if bool(mask.any()) else []:
        sums = experiment.sums(label, mode) if models is None or label in models else {}
        if not sums:
            continue
        seeds = len(sums["success_500"].numerator) if label in experiment.runs else 0
        row: Row = {"model": label, "seeds": seeds or "–", "num_goals": int(mask.sum())}
        for name in sums if metrics is None else [name for name in metrics if name in sums]:
            part = _masked(sums[name], mask)
            drawn = _draws(len(part.numerator), scene, resamples)
            row[name] = bootstrap_mean(part, scene, by_scene=by_scene, draws=drawn)
        rows.append(row)
    return rows


def _masked(sums: Sums, mask: Tensor) -> Sums:
    return Sums(sums.numerator[:, mask], sums.denominator[:, mask])


def _scores(sums: Sums, scene: Tensor, mask: Tensor) -> Tensor:
    """(K, T): the means of each seed in each scene that has such goals."""
    columns = [mask & (scene == index) for index in scene[mask].unique().tolist()]
    parts = [_masked(sums, column) for column in columns]
    return torch.stack([part.numerator.sum(1) / part.denominator.sum(1) for part in parts], 1)
