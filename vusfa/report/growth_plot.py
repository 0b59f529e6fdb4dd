"""The plot of ``vusfa generalise``: results in rooms never seen by the number of rooms trained in."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from vusfa.errors import ResultError
from vusfa.evaluation.baselines import RANDOM_WALK
from vusfa.evaluation.statistics import Estimate, bootstrap_mean
from vusfa.experiments.runs import Run
from vusfa.files import replacing
from vusfa.report.unseen import policy_sums, run_label

__all__ = ["draw_growth", "growth"]

#: Metrics and titles of the panels.
_PANELS = {"success_100": "success in 100 actions (%)", "spl": "SPL (%)"}
_AGENT = "agent"


def growth(runs: Sequence[Run], metric: str) -> dict[str, dict[int, Estimate]]:
    """Means by number of rooms trained in, per series, with 95 % bootstrap intervals over seeds and goals.

    A series are runs whose names differ only in a number at the end (``name=rooms8``, ``name=rooms30``) and
    that were tested in the same rooms. The random walk is a series, too, under the number 0.

    Args:
        runs: of ``vusfa generalise``.
        metric: of :data:`vusfa.report.result_tables.COMPARED`.

    Raises:
        ResultError: fewer than two numbers of rooms in every series.
    """
    groups: dict[tuple[str, int, tuple[str, ...]], list[Run]] = {}
    for run in runs:
        series, rooms = run_label(run).rstrip("0123456789"), tuple(run.info["tested_in"])
        groups.setdefault((series, len(run.info["trained_in"]), rooms), []).append(run)
    found: dict[tuple[str, str], dict[int, Estimate]] = {}
    for (series, number, _), group in groups.items():
        part, tables = group[0].info.get("part"), [run.rows() for run in group]
        where = f" ({part})" if part else ""
        for mode, label, place in ((_AGENT, series, number), ("exact", RANDOM_WALK, 0)):
            sums, scene = policy_sums(tables, mode)
            found.setdefault((label, where), {})[place] = bootstrap_mean(sums[metric], scene)
    grown = [key for key, points in found.items() if len(points) > 1]
    if not grown:
        raise ResultError(
            "there is no series to draw: give vusfa generalise names that end in the number of rooms, such as"
            " name=rooms8 trained=8 and name=rooms30 trained=30"
        )
    walks = [(RANDOM_WALK, where) for where in dict.fromkeys(where for _, where in grown)]
    return {label + where: dict(sorted(found[label, where].items())) for label, where in [*grown, *walks]}


def draw_growth(runs: Sequence[Run], path: str | Path) -> Path:
    """Draw :func:`growth` as PNG, atomically; the random walk is a dashed line.

    Raises:
        ResultError: see :func:`growth`.
    """
    from matplotlib.figure import Figure  # of the extra "recipes"

    figure = Figure(figsize=(8.4, 3.4), layout="constrained")
    for panel, (metric, title) in zip(figure.subplots(1, 2), _PANELS.items(), strict=True):
        ticks: set[int] = set()
        for name, points in growth(runs, metric).items():
            values = [100 * estimate.value for estimate in points.values()]
            if 0 in points:
                panel.axhline(values[0], color="#777777", linestyle="--", lw=1, label=name)
                continue
            errors = [
                [100 * (estimate.value - estimate.low) for estimate in points.values()],
                [100 * (estimate.high - estimate.value) for estimate in points.values()],
            ]
            panel.errorbar(list(points), values, yerr=errors, fmt="o-", ms=5, capsize=3, label=name)
            ticks |= set(points)
        panel.set_xscale("log")
        panel.set_xticks(sorted(ticks), [str(tick) for tick in sorted(ticks)])
        panel.minorticks_off()
        panel.set(title=title, xlabel="rooms trained in")
        panel.set_ylim(bottom=0)
        panel.grid(alpha=0.3)
        panel.spines[["top", "right"]].set_visible(False)
    panel.legend(loc="lower right", frameon=False, fontsize=8)
    with replacing(path) as unfinished:
        figure.savefig(unfinished, format="png", dpi=120)
    return Path(path)
