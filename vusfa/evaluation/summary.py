"""Summaries of the long table: per scene and over scenes, trained and unseen goals apart."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import pandas as pd
from torch import Tensor

from vusfa.envs.dynamics import MAX_STEPS
from vusfa.errors import printable
from vusfa.evaluation.episodes import Episodes
from vusfa.evaluation.long_table import (
    SUBSETS,
    WITHIN,
    average_over_scenes,
    episode_rows,
    pool,
    random_walk_rows,
    select_goals,
)
from vusfa.evaluation.metrics import METRICS, get_metric
from vusfa.evaluation.starts import Unreachable
from vusfa.scenes import Scene, SceneSet

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["count_pairs", "metric_columns", "print_summary", "random_walk_summary", "summarize", "summary"]

Row = dict[str, Any]


def summary(episodes: Episodes, policy: str, within: Sequence[int] = WITHIN) -> list[Row]:
    """Metrics of one policy, per subset of goals and scene and averaged over the scenes.

    Args:
        episodes: of the policy.
        policy: its name.
        within: see :func:`~vusfa.evaluation.metrics.metrics_within`.

    Returns:
        rows, see :func:`summarize`.

    >>> import torch
    >>> one, scene = torch.tensor([1, 1]), torch.tensor([0, 1])
    >>> episodes = Episodes(scene, one, one, scene < 1, one * 9, one * 9, one, one > 0, ("hall", "attic"), 9)
    >>> [(row["goals"], row["scene"], row["success_9"]) for row in summary(episodes, "walker")][:3]
    [('trained', 'hall', 1.0), ('trained', 'attic', 0.0), ('trained', 'mean of scenes', 0.5)]
    """
    return summarize(episode_rows(episodes, policy, within=within))


def summarize(table: pd.DataFrame) -> list[Row]:
    """One row per model, subset of goals and scene of a long table that holds one seed and mode per model.

    Returns:
        rows with policy, goals (trained, unseen or all), scene, num_goals, num_episodes (NaN for exact
        values) and the metrics, NaN where there is none; averages over the scenes as in
        :func:`~vusfa.evaluation.long_table.average_over_scenes`.
    """
    rows: list[Row] = []
    names = [*table.metric.cat.categories]
    for model in table.model.cat.categories:
        for subset in SUBSETS:
            part = select_goals(table[table.model == model], subset)
            if not len(part):
                continue
            averages = average_over_scenes(part, ["metric"])
            values = averages.pivot(index="scene", columns="metric", values="value")
            counted = part[part.metric == next(name for name in names if name.startswith("success_"))]
            sizes = pool(counted, ["scene"]).set_index("scene").denominator
            goals = counted.groupby("scene", observed=True, sort=True).goal.nunique()
            for scene in averages.scene.unique():
                row: Row = {"policy": str(model), "goals": subset, "scene": str(scene)}
                row["num_goals"] = int(goals.get(scene, goals.sum()))
                exact = (part["mode"] == "exact").all()
                row["num_episodes"] = math.nan if exact else int(sizes.get(scene, sizes.sum()))
                found = values.loc[scene].to_dict()
                rows.append(row | {name: float(found.get(name, math.nan)) for name in [*names, *METRICS]})
    return rows


def metric_columns(rows: Iterable[Mapping[str, Any]]) -> list[str]:
    """The columns of rows that hold metrics, in the order of the registry.

    >>> metric_columns([{"policy": "gvf", "success_100": 0.5, "spl": 0.2, "success_500": 0.8}])
    ['success_500', 'success_100', 'spl']
    """
    names = {key for row in rows for key in row}
    limits = [name for name in names if name.startswith("success_") and name[8:].isdigit()]
    limits.sort(key=lambda name: -int(name[8:]))
    return [*limits, *(name for name in METRICS if name in names)]


def random_walk_summary(
    scenes: SceneSet,
    goals: Tensor,
    trained: Tensor,
    max_steps: int = MAX_STEPS,
    within: Sequence[int] = WITHIN,
    unreachable: Unreachable = "skip",
) -> list[Row]:
    """Rows of :func:`summary` for the random walk's exact success; arguments as in
    :func:`~vusfa.evaluation.long_table.random_walk_rows`."""
    return summarize(random_walk_rows(scenes, goals, trained, max_steps, within, unreachable))


def count_pairs(scenes: Iterable[Scene], unreachable: Unreachable) -> str:
    """A sentence on the pairs of start and goal without a path, and how tables count them.

    >>> count_pairs(SceneSet.bundled(["bathroom"]).scenes, "skip")
    'Every goal can be reached from every start.'
    """
    lost = {scene.name: sum(int((part < 0).sum()) for part in scene.all_distances()) for scene in scenes}
    lost = {name: count for name, count in lost.items() if count}
    if not lost:
        return "Every goal can be reached from every start."
    counted = {
        "skip": "no episode starts where its goal cannot be reached; a goal without starts is left out",
        "fail": "such pairs are drawn as any other, and count as failures",
    }[unreachable]
    listed = ", ".join(f"{count} in {name}" for name, count in lost.items())
    return f"Pairs of start and goal without a path: {listed}; {counted}."


def print_summary(rows: Sequence[Row], console: Console | None = None, note: str = "") -> None:
    """Print summaries, one table per subset of goals, policies side by side scene by scene.

    Args:
        rows: of :func:`summary` and :func:`random_walk_summary`; metrics without any number are left out.
        console: the terminal by default.
        note: a line below.
    """
    from rich import box  # of the extra "recipes"; the rest of this module does without
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = console or Console()
    names = [name for name in metric_columns(rows) if not all(math.isnan(row[name]) for row in rows)]
    metrics = [get_metric(name) for name in names]
    for subset in SUBSETS:
        chosen = [row for row in rows if row["goals"] == subset]
        if not chosen or (subset == "all" and len({row["goals"] for row in rows}) == 2):
            continue  # nothing, or what one of the other two tables shows already
        table = Table(
            title=f"{subset} goals", title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0)
        )
        for name in ("scene", "policy"):  # these break before a number would
            table.add_column(name, overflow="fold")
        for metric in metrics:
            table.add_column(metric.short, justify="right", no_wrap=True)
        for scene in dict.fromkeys(row["scene"] for row in chosen):
            group = [row for row in chosen if row["scene"] == scene]
            for place, row in enumerate(group):
                table.add_row(
                    Text(printable(scene) if place == 0 else ""),
                    Text(printable(row["policy"])),
                    *(metric.text(row[metric.name]) for metric in metrics),
                    end_section=place == len(group) - 1,
                )
        console.print(table)
    console.print(f"{', '.join(f'{metric.short}: {metric.heading}' for metric in metrics)}")
    if note:
        console.print(Text(printable(note)))
