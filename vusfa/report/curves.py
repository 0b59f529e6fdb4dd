"""Learning curves: mean and range over seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vusfa.report.runs import LoggedRun

__all__ = ["band", "curve_names", "learning_curves"]

_POINTS = 400  # of a curve on the page; longer logs are thinned
_EVALUATED = tuple(
    f"eval/{goals}/{name}"
    for name in ("success", "spl", "length_ratio")
    for goals in ("trained", "validation")
)
_PLAIN = (
    *_EVALUATED,
    "success",
    "length",
    "length_ratio",
    "collisions",
    "explained_variance",
    "entropy",
    "kl",
    "loss_critic",
    "loss_successor",
    "hindsight_value",
    "grad_norm",
)
_PER_SCENE = ("success", "length", "length_ratio", *_EVALUATED[:4])
#: Rates of the episodes that ended, biased upwards early in a training: shown for runs without evaluations.
_ENDED = ("success", "length_ratio")


def curve_names(runs: Sequence[LoggedRun]) -> list[str]:
    """Columns of metrics.csv on the page: the general ones that any run logged, and those per scene.

    Where every run was evaluated during its training, these evaluations stand in place of the rates of the
    episodes that ended.

    >>> from pathlib import Path
    >>> log = dict.fromkeys(["frames", "success", "scene/hall/success", "lr"], np.ones(1))
    >>> curve_names([LoggedRun("gvf", 0, Path(), {}, log)])
    ['success', 'scene/hall/success']
    """
    logged = dict.fromkeys(name for run in runs for name in run.curves)
    evaluated = all(_EVALUATED[0] in run.curves for run in runs)
    measures = [name for name in _PLAIN if not (evaluated and name in _ENDED)]
    per_scene = [
        name
        for name in logged
        if name.startswith("scene/") and name.split("/", 2)[-1] in {*_PER_SCENE} & {*measures}
    ]
    return [name for name in measures if name in logged] + per_scene


def band(
    curves: Sequence[tuple[np.ndarray, np.ndarray]], points: int = _POINTS
) -> dict[str, list[float | None]]:
    """Mean, minimum and maximum of several curves on common frames.

    Curves are interpolated linearly, over the frames that all cover: a mean would jump where one ends.

    Args:
        curves: pairs of frames (n,), rising, and values (n,); NaN values are left out.
        points: largest number of common frames, spread evenly over all that occur.

    Returns:
        x, mean, low and high, lists of one length.

    >>> one, two = np.array([0.0, 10.0, 20.0]), np.array([0.0, 20.0])
    >>> found = band([(one, np.array([0.0, 1.0, 2.0])), (two, np.array([4.0, 6.0]))])
    >>> found["mean"], found["low"]
    ([2.0, 3.0, 4.0], [0.0, 1.0, 2.0])
    """
    known = [(x[np.isfinite(y)], y[np.isfinite(y)]) for x, y in curves]
    known = [(x, y) for x, y in known if len(x)]
    if not known:
        return {"x": [], "mean": [], "low": [], "high": []}
    first, last = max(x[0] for x, _ in known), min(x[-1] for x, _ in known)
    grid = np.unique(np.concatenate([x for x, _ in known]))
    grid = grid[(grid >= first) & (grid <= last)]
    if len(grid) > points:
        grid = grid[np.unique(np.linspace(0, len(grid) - 1, points).round().astype(int))]
    if not len(grid):
        return {"x": [], "mean": [], "low": [], "high": []}
    values = np.stack([np.interp(grid, x, y) for x, y in known])
    parts = {"mean": values.mean(0), "low": values.min(0), "high": values.max(0)}
    return {"x": grid.tolist(), **{name: _plain(part) for name, part in parts.items()}}


def learning_curves(runs: Sequence[LoggedRun]) -> list[dict[str, Any]]:
    """The curves of every model and metric.

    Args:
        runs: those without a log are left out.

    Returns:
        a dictionary per model and metric: model, name (the column), seeds, the lists of :func:`band` over
        frames, and ``minutes``: the same frames in minutes of training, mean over seeds.
    """
    found = []
    for label in dict.fromkeys(run.label for run in runs):
        group = [run for run in runs if run.label == label and "frames" in run.curves]
        for name in curve_names(group):
            logged = [run.curves for run in group if name in run.curves]
            drawn = band([(log["frames"], log[name]) for log in logged])
            found.append(
                {"model": label, "name": name, "seeds": len(logged), **drawn}
                | {"minutes": _minutes(logged, drawn["x"])}
            )
    return found


def _minutes(logs: Sequence[Mapping[str, np.ndarray]], frames: Sequence[float | None]) -> list[float | None]:
    timed = [log for log in logs if "seconds" in log]
    if not timed:
        return [None] * len(frames)
    grid = np.array(frames, dtype=np.float64)
    minutes = np.stack([np.interp(grid, log["frames"], log["seconds"]) for log in timed]) / 60
    return _plain(minutes.mean(0))


def _plain(values: np.ndarray) -> list[float | None]:
    """Rounded to five significant digits, enough for a drawing."""
    return [float(f"{value:.5g}") if np.isfinite(value) else None for value in values]
