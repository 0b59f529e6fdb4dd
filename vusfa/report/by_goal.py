"""Tables per goal and per distance from the trained goals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import pandas as pd
import torch

from vusfa.evaluation.long_table import DISTANCE_BINS, WITHIN, distance_bin, distance_to_trained, pool
from vusfa.report.runs import LoggedRun
from vusfa.report.tables import long_table, over_seeds
from vusfa.scenes import SceneSet

__all__ = ["distance_rows", "goal_rows"]

Row = dict[str, Any]


def goal_rows(runs: Sequence[LoggedRun], within: Sequence[int] = WITHIN) -> list[Row]:
    """One row per model and goal, for the floor maps.

    Args:
        runs: those without an evaluation are left out.
        within: limits of actions to report success for.

    Returns:
        rows with model, scene, goal (state id), trained (in any seed), seeds, num_episodes and the metrics
        over the episodes of all seeds; and where every seed has them, the exact values ``exact_100``,
        ``exact_500`` and ``exact_spl``, means over the seeds.
    """
    table = long_table(runs, within)
    if table is None:
        return []
    key = ["model", "scene", "goal"]
    walked = table[table["mode"] != "exact"]
    counts = walked.groupby(key, observed=True, sort=True).agg(
        trained=("trained", "any"), seeds=("seed", "nunique")
    )
    success = next(name for name in table.metric.cat.categories if name.startswith("success_"))
    counts["num_episodes"] = (
        pool(walked[walked.metric == success], key).set_index(key).denominator.astype(int)
    )
    values = pool(walked, [*key, "metric"]).pivot(index=key, columns="metric", values="value")
    rows = counts.join(pd.DataFrame(values.to_numpy(), index=values.index, columns=list(values.columns)))
    exact = table[table["mode"] == "exact"]
    if len(exact):
        means = exact.groupby([*key, "metric"], observed=True).value.mean().unstack("metric")
        number = exact.groupby("model", observed=True).run.nunique()
        wanted = {label: sum(run.label == label for run in runs) for label in number.index}
        complete = [label for label in number.index if number[label] == wanted[label]]
        means = means[means.index.get_level_values("model").isin(complete)]
        means.columns = [f"exact_{name.removeprefix('success_')}" for name in means.columns]
        rows = rows.join(means)
    return [
        {name: value for name, value in row.items() if not (name.startswith("exact_") and math.isnan(value))}
        for row in rows.reset_index().to_dict("records")
    ]


def distance_rows(runs: Sequence[LoggedRun], scenes: SceneSet, within: Sequence[int] = WITHIN) -> list[Row]:
    """One row per model and distance of the goal from the nearest trained goal.

    Args:
        runs: those without an evaluation, or without trained goals in it, are left out.
        scenes: of the episodes.
        within: limits of actions to report success for.

    Returns:
        rows with model, distance (text, such as "3–4"), from and to (actions, inclusive), seeds, num_goals
        (of the first seed), and the metrics over the seeds with ``_low`` and ``_high``.
    """
    groups: dict[tuple[str, int], list[Row]] = {}
    names: list[str] = []
    for run in runs:
        if run.episodes is None or not bool(run.episodes.trained.any()):
            continue
        table = run.rows(within)
        table = table[table["mode"] != "exact"]
        names = [name for name in table.metric.cat.categories]
        index = {name: scenes.scene_index(name) for name in run.episodes.scene_names}
        scene = torch.tensor([index[name] for name in table.scene])
        goal, trained = (torch.tensor(table[name].to_numpy()) for name in ("goal", "trained"))
        far = distance_to_trained(scenes, scene, goal, trained)
        table = table.assign(bin=torch.bucketize(far, torch.tensor(DISTANCE_BINS), right=True).numpy() - 1)
        table = table[table.bin >= 0]
        numbers = table.groupby("bin")[["scene", "goal"]].apply(lambda part: len(part.drop_duplicates()))
        pooled = pool(table, ["bin", "metric"]).pivot(index="bin", columns="metric", values="value")
        for place, row in pooled.iterrows():
            groups.setdefault((run.label, int(place)), []).append(
                row.to_dict() | {"num_goals": int(numbers[place])}
            )
    order = list(dict.fromkeys(run.label for run in runs))
    rows = []
    for (label, place), group in sorted(
        groups.items(), key=lambda item: (order.index(item[0][0]), item[0][1])
    ):
        low, high = DISTANCE_BINS[place], (*DISTANCE_BINS, math.nan)[place + 1] - 1
        head = {"model": label, "distance": distance_bin(place), "from": low, "to": high, "seeds": len(group)}
        rows.append(head | {"num_goals": group[0]["num_goals"]} | over_seeds(group, names))
    return rows
