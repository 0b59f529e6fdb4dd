"""The learning curve of a run as PNG."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vusfa.errors import ConfigError
from vusfa.files import replacing
from vusfa.reading import read_csv

__all__ = ["plot_curve", "read_metrics"]


def read_metrics(path: str | Path) -> dict[str, np.ndarray]:
    """The columns of a run's ``metrics.csv``, each (n,) float64; an empty field is NaN.

    Raises:
        ConfigError: the file is missing, or a field is not a number; frames or seconds are infinite.
    """
    mend = "a run writes metrics.csv in its folder, see docs/training.md"
    columns = read_csv(path, ConfigError, mend)
    for name in ("frames", "seconds"):
        if np.isinf(columns.get(name, 0.0)).any():
            raise ConfigError(f"{path}: column {name!r} holds an infinite number; {mend}")
    return {name: column for name, column in columns.items() if len(column)}


def plot_curve(
    metrics: str | Path, path: str | Path, random_walk: float | None = None, title: str = ""
) -> Path:
    """Draw success and length over shortest path against frames as PNG, atomically: those of evaluations
    during the training or, without any, of the episodes that ended.

    Args:
        metrics: the run's ``metrics.csv``.
        path: the PNG.
        random_walk: success of the random walk, drawn as a line.
        title: title of the figure.

    Raises:
        ConfigError: see :func:`read_metrics`; or there are no rows.
    """
    from matplotlib.figure import Figure  # of the extra "recipes"

    columns = read_metrics(metrics)
    if not columns:
        raise ConfigError(f"{metrics}: no rows yet; train for longer, or log more often (log_every)")
    frames = columns["frames"] / 1000
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    evaluated = "eval/trained/success" in columns
    for goals, color in (("trained", "#1f61b6"), ("validation", "#d6452c")) if evaluated else ():
        success = columns[f"eval/{goals}/success"]
        known = np.isfinite(success)
        upper.plot(frames[known], 100 * success[known], color=color, label=f"{goals} goals")
        ratio = columns[f"eval/{goals}/length_ratio"]
        lower.plot(frames[known], ratio[known], color=color)
    if not evaluated:
        upper.plot(frames, 100 * columns["success"], color="#1f61b6")
        lower.plot(frames, columns["length_ratio"], color="#d6452c")
    upper.set_ylabel("success (%)" if evaluated else "success in training (%)")
    upper.set_ylim(0, 102)
    if random_walk is not None:
        upper.axhline(100 * random_walk, color="#888888", linestyle="--", label="random walk")
    if evaluated or random_walk is not None:
        upper.legend(loc="best", frameon=False)
    lower.axhline(1.0, color="#888888", linestyle="--", label="shortest path")
    lower.set_yscale("log")
    lower.set_ylabel("length / shortest")
    lower.set_xlabel("thousand frames")
    lower.legend(loc="upper right", frameon=False)
    if title:
        upper.set_title(title)
    with replacing(path) as unfinished:
        figure.savefig(unfinished, format="png", dpi=120)
    return Path(path)
