"""Tables in which every goal counts for itself: where on the floor, how far from what was trained."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch

from vusfa.evaluation import Episodes
from vusfa.evaluation.metrics import length_ratio, spl, success_rate
from vusfa.report.runs import Run
from vusfa.report.tables import measures, over_seeds
from vusfa.scenes import SceneSet

__all__ = ["distance_rows", "goal_rows"]

Row = dict[str, Any]

# Actions from the nearest trained goal: the first number that belongs to each bin.
_BINS = (0, 1, 3, 5, 8, 12, 17, 23)


def goal_rows(runs: Sequence[Run], within: Sequence[int] = (500, 100)) -> list[Row]:
    """One row for each model and goal: what the floor maps show.

    Args:
        runs: those without an evaluation are left out.
        within: numbers of actions to give the success for.

    Returns:
        rows with model, scene, goal (state id), trained (of any seed), seeds, num_episodes (of all seeds
        together), ``success_k``, spl and length_ratio over all episodes of all seeds; and where every seed
        has them, the exact chances ``exact_100``, ``exact_500`` and ``exact_spl``, means over the seeds.
    """
    exact = _exact_chances(runs)
    found: dict[tuple[str, str], dict[int, list[tuple[Run, Episodes]]]] = {}
    for run in runs:
        if run.episodes is None:
            continue
        for index, scene in enumerate(run.episodes.scene_names):
            part = run.episodes.select(run.episodes.scene == index)
            order = torch.argsort(part.goal, stable=True)
            ids, counts = part.goal[order].unique_consecutive(return_counts=True)
            cells = found.setdefault((run.label, scene), {})
            for goal, rows in zip(ids.tolist(), order.split(counts.tolist()), strict=True):
                mask = torch.zeros(len(part), dtype=torch.bool)
                mask[rows] = True
                cells.setdefault(goal, []).append((run, part.select(mask)))
    return [
        {"model": label, "scene": scene, "goal": goal}
        | _goal_row(parts, within)
        | exact.get((label, scene, goal), {})
        for (label, scene), cells in found.items()
        for goal, parts in sorted(cells.items())
    ]


def _goal_row(parts: Sequence[tuple[Run, Episodes]], within: Sequence[int]) -> Row:
    tables = [table for _, table in parts]
    success, length, shortest = (
        torch.cat([getattr(table, name) for table in tables]) for name in ("success", "length", "shortest")
    )
    limit = max(table.max_steps for table in tables)
    return {
        "trained": any(bool(table.trained.any()) for table in tables),
        "seeds": len({run.seed for run, _ in parts}),
        "num_episodes": len(success),
        **{f"success_{k}": success_rate(success, length, k) for k in sorted({limit, *within}) if k <= limit},
        "spl": spl(success, length, shortest),
        "length_ratio": length_ratio(success, length, shortest),
    }


def _exact_chances(runs: Sequence[Run]) -> dict[tuple[str, str, int], Row]:
    found: dict[tuple[str, str, int], list[Row]] = {}
    for run in runs:
        if run.exact is None or run.episodes is None:
            continue
        table = run.exact
        columns = [column.tolist() for column in (table.success_100, table.success_500, table.spl)]
        for scene, goal, *values in zip(table.scene.tolist(), table.goal.tolist(), *columns, strict=True):
            row = dict(zip(("exact_100", "exact_500", "exact_spl"), values, strict=True))
            found.setdefault((run.label, run.episodes.scene_names[scene], goal), []).append(row)
    seeds = {label: sum(run.label == label for run in runs) for label in {run.label for run in runs}}
    return {
        key: {name: sum(row[name] for row in rows) / len(rows) for name in rows[0]}
        for key, rows in found.items()
        if len(rows) == seeds[key[0]]
    }


def distance_rows(runs: Sequence[Run], scenes: SceneSet, within: Sequence[int] = (500, 100)) -> list[Row]:
    """Success by how far a goal lies from the nearest goal that the model was trained on.

    Args:
        runs: those without an evaluation, or without trained goals in it, are left out.
        scenes: the scenes that the episodes name.
        within: numbers of actions to give the success for.

    Returns:
        rows with model, distance (words, such as "3–4"), from and to (actions from the nearest trained goal
        to this one, inclusive), seeds, num_goals (of the first seed), and ``success_k`` and spl over the
        seeds, with ``_low`` and ``_high``.
    """
    groups: dict[tuple[str, int], list[Row]] = {}
    for run in runs:
        if run.episodes is None or not bool(run.episodes.trained.any()):
            continue
        table = run.episodes
        away = _from_trained(table, scenes)
        edges = torch.tensor([*_BINS[1:]])
        bins = torch.bucketize(away, edges, right=True)
        for place in bins[away >= 0].unique().tolist():
            part = table.select((bins == place) & (away >= 0))
            limits = [k for k in sorted({table.max_steps, *within}) if k <= table.max_steps]
            row = {f"success_{k}": success_rate(part.success, part.length, k) for k in limits}
            row["spl"] = spl(part.success, part.length, part.shortest)
            row["num_goals"] = int(torch.stack([part.scene, part.goal]).unique(dim=1).shape[1])
            groups.setdefault((run.label, place), []).append(row)
    rows = []
    for (label, place), group in sorted(groups.items(), key=lambda item: item[0][1]):
        low, high = _BINS[place], _BINS[place + 1] - 1 if place + 1 < len(_BINS) else math.nan
        words = f"{low} or more" if math.isnan(high) else str(low) if high == low else f"{low}–{int(high)}"
        head = {"model": label, "distance": words, "from": low, "to": high, "seeds": len(group)}
        head["num_goals"] = group[0]["num_goals"]
        rows.append(head | over_seeds(group, measures(group)))
    order = list(dict.fromkeys(run.label for run in runs))
    return sorted(rows, key=lambda row: order.index(row["model"]))


def _from_trained(episodes: Episodes, scenes: SceneSet) -> torch.Tensor:
    """(n,) actions from the nearest trained goal of the same scene to each episode's goal; -1 without any."""
    away = torch.full((len(episodes),), -1)
    for index, name in enumerate(episodes.scene_names):
        here = episodes.scene == index
        trained = episodes.goal[here & episodes.trained].unique()
        if not trained.numel():
            continue
        table = scenes.scenes[scenes.scene_index(name)].distance[trained].to(torch.int64)
        table = torch.where(table < 0, torch.iinfo(torch.int64).max, table)
        nearest = table.amin(0)
        nearest[nearest == torch.iinfo(torch.int64).max] = -1
        away[here] = nearest[episodes.goal[here]]
    return away
