"""The plot of a table of results: success to trained and to unseen goals, per model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from vusfa.errors import ResultError
from vusfa.evaluation.baselines import RANDOM_WALK, SHORTEST_PATH
from vusfa.files import replacing

__all__ = ["draw_success"]

_PANELS = ("trained", "unseen")


def draw_success(rows: Sequence[Mapping[str, Any]], path: str | Path, within: str = "success_500") -> Path:
    """Draw success per model with 95 % intervals as PNG, atomically; the random walk is a line.

    Args:
        rows: of :func:`vusfa.report.result_tables.model_rows`, of one mode and one average over scenes.
        path: of the PNG.
        within: the metric, an estimate in 0..1.

    Raises:
        ResultError: no row has the metric.
    """
    from matplotlib.figure import Figure  # of the extra "recipes"

    models = list(
        dict.fromkeys(row["model"] for row in rows if row["model"] not in (RANDOM_WALK, SHORTEST_PATH))
    )
    if not any(within in row for row in rows if row["model"] in models):
        raise ResultError(f"no result has the metric {within!r}; give experiments that were evaluated")
    figure = Figure(figsize=(8.4, 1.2 + 0.36 * len(models)), layout="constrained")
    for panel, goals in zip(figure.subplots(1, 2, sharey=True), _PANELS, strict=True):
        for row in rows:
            estimate = row.get(within)
            if row["goals"] != goals or estimate is None:
                continue
            if row["model"] == RANDOM_WALK:
                panel.axvline(100 * estimate.value, color="#777777", linestyle="--", lw=1, label=RANDOM_WALK)
            elif row["model"] in models:
                value, low, high = (100 * part for part in estimate)
                place = models.index(row["model"])
                panel.errorbar(
                    value, place, xerr=[[value - low], [high - value]], fmt="o", ms=5, color="#1f61b6"
                )
                beside = (8, "left") if value < 70 else (-8, "right")
                panel.annotate(
                    f"{value:.1f}", (value, place), (beside[0], 5), textcoords="offset points", ha=beside[1],
                    fontsize=8,
                )  # fmt: skip
        panel.set(title=f"{goals} goals", xlim=(-2, 102), xlabel="success in 500 actions (%)")
        panel.grid(axis="x", alpha=0.3)
        panel.spines[["top", "right"]].set_visible(False)
    panel.set_yticks(range(len(models)), models)
    panel.set_ylim(len(models) - 0.5, -0.6)
    panel.legend(loc="center right", frameon=False, fontsize=8)
    with replacing(path) as unfinished:
        figure.savefig(unfinished, format="png", dpi=120)
    return Path(path)
