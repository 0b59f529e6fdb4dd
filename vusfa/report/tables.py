"""Tables of the page: plain rows, made from the runs' episodes and pooled over seeds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import torch

from vusfa.evaluation import Episodes, random_walk_summary, shortest_paths, summary
from vusfa.evaluation.baselines import SHORTEST_PATH
from vusfa.evaluation.long_table import WITHIN, join_tables, select_goals
from vusfa.evaluation.summary import metric_columns
from vusfa.report.intervals import intervals
from vusfa.report.runs import LoggedRun
from vusfa.scenes import SceneSet

__all__ = [
    "baseline_rows",
    "long_table",
    "over_seeds",
    "reference_rows",
    "run_rows",
    "seed_rows",
    "summary_rows",
]

Row = dict[str, Any]


def long_table(runs: Sequence[LoggedRun], within: Sequence[int] = WITHIN) -> pd.DataFrame | None:
    """The long table of all evaluated runs; None without any."""
    tables = [run.rows(within) for run in runs if run.episodes is not None]
    return join_tables(tables) if tables else None


def over_seeds(rows: Sequence[Mapping[str, Any]], names: Sequence[str]) -> Row:
    """Mean, minimum and maximum of several rows: ``name``, ``name_low`` and ``name_high`` for each name.

    NaN and missing numbers are left out; without any number the three are NaN.

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


def seed_rows(runs: Sequence[LoggedRun], within: Sequence[int] = WITHIN) -> list[Row]:
    """One row per run, subset of goals and scene: :func:`vusfa.evaluation.summary` with the seed.

    Args:
        runs: those without an evaluation are left out.
        within: limits of actions to report success for.
    """
    return [
        {"model": run.label, "seed": run.seed} | {key: row[key] for key in row if key != "policy"}
        for run in runs
        if run.episodes is not None
        for row in summary(run.episodes, run.label, within)
    ]


def summary_rows(
    runs: Sequence[LoggedRun],
    within: Sequence[int] = WITHIN,
    beside: Sequence[Mapping[str, Any]] = (),
    seeds: Sequence[Row] | None = None,
) -> list[Row]:
    """One row per model, subset of goals and scene; then those of the baselines.

    Args:
        runs: those without an evaluation are left out.
        within: limits of actions to report success for.
        beside: rows of baselines; those of the runs' own evaluations are added.
        seeds: rows of :func:`seed_rows`, if they are known.

    Returns:
        rows with model, kind ("model" or "reference"), goals, scene, seeds, num_goals and num_episodes (of
        one seed), and of every metric the mean, ``_low`` and ``_high`` over the seeds, and the ends ``_from``
        and ``_to`` of its 95 % interval, see :mod:`vusfa.report.intervals`.
    """
    single = seed_rows(runs, within) if seeds is None else seeds
    names = metric_columns(single)
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in single:
        groups.setdefault((row["model"], row["goals"], row["scene"]), []).append(row)
    tables = {(run.label, run.seed): run.rows(within) for run in runs if run.episodes}
    tables = {key: table[table["mode"] != "exact"] for key, table in tables.items()}

    def of(label: str, goals: str) -> list[pd.DataFrame]:
        return [select_goals(table, goals) for (model, _), table in tables.items() if model == label]

    rows = [
        {"model": label, "kind": "model", "goals": goals, "scene": scene, "seeds": len(group)}
        | {key: group[0][key] for key in ("num_goals", "num_episodes")}
        | over_seeds(group, names)
        | intervals(of(label, goals), scene, names)
        for (label, goals, scene), group in groups.items()
    ]
    others: dict[tuple[str, str, str], Row] = {}
    for reference in [*beside, *(row for run in runs for row in run.references)]:
        others.setdefault((reference["policy"], reference["goals"], reference["scene"]), dict(reference))
    for (policy, goals, scene), row in others.items():
        head = {"model": policy, "kind": "reference", "goals": goals, "scene": scene, "seeds": math.nan}
        counts = {key: row.get(key, math.nan) for key in ("num_goals", "num_episodes")}
        rows.append(head | counts | over_seeds([row], names))
    return rows


def baseline_rows(runs: Sequence[LoggedRun], scenes: SceneSet, within: Sequence[int] = WITHIN) -> list[Row]:
    """:func:`reference_rows` of the first run with each set of goals, scene by scene.

    Args:
        runs: those without an evaluation are left out.
        scenes, within: see :func:`reference_rows`.
    """
    rows: list[Row] = []
    covered: set[tuple[str, bool]] = set()
    for run in runs:
        if run.episodes is None:
            continue
        names = run.episodes.scene_names
        kinds = {(name, bool(kind)) for name in names for kind in run.episodes.trained.unique()}
        if not kinds <= covered:
            covered |= kinds
            rows += reference_rows(run, scenes, within)
    return rows


def reference_rows(run: LoggedRun, scenes: SceneSet, within: Sequence[int] = WITHIN) -> list[Row]:
    """Reference baselines on a run's own goals: the random walk, computed exactly, and the shortest path.

    Args:
        run: one with an evaluation.
        scenes: the scenes that it names, and perhaps more.
        within: limits of actions to report success for.

    Raises:
        ValueError: the run has no evaluation.
    """
    table = run.episodes
    if table is None:
        raise ValueError(f"{run.name} has no evaluation")
    world = SceneSet(scenes.scenes[scenes.scene_index(name)] for name in table.scene_names)
    goals = world.offsets[table.scene] + table.goal
    trained = goals[table.trained].unique()
    exact = random_walk_summary(world, goals.unique(), trained, table.max_steps, within)
    return [*exact, *summary(shortest_paths(table), SHORTEST_PATH, within)]


def run_rows(runs: Sequence[LoggedRun]) -> list[Row]:
    """One row per run: model, seed, length, device, scenes, goals and success of the training.

    >>> from pathlib import Path
    >>> run_rows([LoggedRun("gvf", 3, Path("runs/a"), {"scenes": "bathroom"})])[0]["seed"]
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
                "scenes": ", ".join(Path(scene).stem for scene in run.scenes),
                "goals": _goals(run),
                "history": run.settings.get("agent", {}).get("history", math.nan),
                "trained_success": _success(episodes, True),
                "unseen_success": _success(episodes, False),
                "evaluated": "no" if episodes is None else run.variant,
            }
        )
    return rows


def _goals(run: LoggedRun) -> str:
    """Setting of the goals: ids, a rule, or the name of a manifest."""
    goals = run.settings.get("env", {}).get("goals", "")
    return Path(goals).name if isinstance(goals, str) else str(goals)


def _success(episodes: Episodes | None, trained: bool) -> float:
    if episodes is None:
        return math.nan
    return episodes.success[episodes.trained == trained].to(torch.float64).mean().item()
