"""A report's tables: plain rows, made of the runs' episodes, the seeds of one model put together."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch

from vusfa.evaluation import Episodes, summary
from vusfa.evaluation.metrics import length_ratio, spl, success_rate
from vusfa.report.runs import Run
from vusfa.scenes import SceneSet

__all__ = [
    "MEASURES",
    "distance_rows",
    "goal_rows",
    "measures",
    "over_seeds",
    "run_rows",
    "seed_rows",
    "summary_rows",
]

Row = dict[str, Any]

MEASURES = ("spl", "length", "length_ratio", "collisions")
# Actions from the nearest trained goal: the first number that belongs to each bin.
_BINS = (0, 1, 3, 5, 8, 12, 17, 23)


def measures(rows: Iterable[Mapping[str, Any]]) -> list[str]:
    """The columns of summaries that hold measures, in the order in which tables show them.

    >>> measures([{"policy": "gvf", "success_100": 0.5, "spl": 0.2, "success_500": 0.8}])
    ['success_500', 'success_100', 'spl']
    """
    names = {key for row in rows for key in row}
    limits = sorted(
        (key for key in names if key.removeprefix("success_").isdigit()), key=lambda key: -int(key[8:])
    )
    return [*limits, *(name for name in MEASURES if name in names)]


def over_seeds(rows: Sequence[Mapping[str, Any]], names: Sequence[str]) -> Row:
    """Mean, smallest and largest of several rows: ``name``, ``name_low`` and ``name_high`` for each name.

    A NaN, or a missing number, drops out; without any the three are NaN.

    >>> over_seeds([{"spl": 0.2}, {"spl": 0.4}, {}], ["spl"])
    {'spl': 0.30000000000000004, 'spl_low': 0.2, 'spl_high': 0.4}
    """
    result: Row = {}
    for name in names:
        known = [v for v in (float(row.get(name, math.nan)) for row in rows) if not math.isnan(v)]
        result[name] = sum(known) / len(known) if known else math.nan
        result[f"{name}_low"] = min(known, default=math.nan)
        result[f"{name}_high"] = max(known, default=math.nan)
    return result


def seed_rows(runs: Sequence[Run], within: Sequence[int] = (500, 100)) -> list[Row]:
    """One row for each run, set of goals and scene: :func:`vusfa.evaluation.summary` with the seed beside it.

    Args:
        runs: those without an evaluation are left out.
        within: numbers of actions to give the success for.
    """
    return [
        {"model": run.label, "seed": run.seed} | {key: row[key] for key in row if key != "policy"}
        for run in runs
        if run.episodes is not None
        for row in summary(run.episodes, run.label, within)
    ]


def summary_rows(runs: Sequence[Run], within: Sequence[int] = (500, 100)) -> list[Row]:
    """One row for each model, set of goals and scene; then the policies that the runs stand beside.

    Args:
        runs: those without an evaluation are left out.
        within: numbers of actions to give the success for, see :func:`vusfa.evaluation.summary`.

    Returns:
        rows with model, kind ("model" or "reference"), goals, scene, seeds, num_goals and num_episodes (of
        one seed), and mean, ``_low`` and ``_high`` over the seeds of every measure.
    """
    single = seed_rows(runs, within)
    names = measures(single)
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in single:
        groups.setdefault((row["model"], row["goals"], row["scene"]), []).append(row)
    rows = [
        {"model": label, "kind": "model", "goals": goals, "scene": scene, "seeds": len(group)}
        | {key: group[0][key] for key in ("num_goals", "num_episodes")}
        | over_seeds(group, names)
        for (label, goals, scene), group in groups.items()
    ]
    beside: dict[tuple[str, str, str], Row] = {}
    for reference in (row for run in runs for row in run.references):
        beside.setdefault((reference["policy"], reference["goals"], reference["scene"]), dict(reference))
    for (policy, goals, scene), row in beside.items():
        head = {"model": policy, "kind": "reference", "goals": goals, "scene": scene, "seeds": math.nan}
        counts = {key: row.get(key, math.nan) for key in ("num_goals", "num_episodes")}
        rows.append(head | counts | over_seeds([row], names))
    return rows


def goal_rows(runs: Sequence[Run], within: Sequence[int] = (500, 100)) -> list[Row]:
    """One row for each model and goal: what the floor maps show.

    Args:
        runs: those without an evaluation are left out.
        within: numbers of actions to give the success for.

    Returns:
        rows with model, scene, goal (state id), trained (of any seed), seeds, num_episodes (of all seeds
        together), ``success_k``, spl and length_ratio over all episodes of all seeds.
    """
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
        {"model": label, "scene": scene, "goal": goal} | _goal_row(parts, within)
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


def run_rows(runs: Sequence[Run]) -> list[Row]:
    """One row a run: what was trained, how long, on what.

    >>> run_rows([Run("gvf", 3, __import__("pathlib").Path("runs/a"), {"scenes": "bathroom"})])[0]["seed"]
    3
    """
    rows = []
    for run in runs:
        episodes = run.episodes
        rows.append(
            {
                "model": run.label,
                "seed": run.seed,
                "folder": run.folder.name,
                "frames": run.frames,
                "minutes": run.seconds / 60,
                "device": run.settings.get("device", ""),
                "scenes": ", ".join(run.scenes),
                "goals": str(run.settings.get("env", {}).get("goals", "")),
                "history": run.settings.get("agent", {}).get("history", math.nan),
                "trained_success": _success(episodes, True),
                "unseen_success": _success(episodes, False),
                "evaluated": "no" if episodes is None else run.variant,
            }
        )
    return rows


def _success(episodes: Episodes | None, trained: bool) -> float:
    if episodes is None:
        return math.nan
    return episodes.success[episodes.trained == trained].to(torch.float64).mean().item()
