"""The table of ``vusfa generalise``: rooms that the agent has never seen."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pandas as pd
from torch import Tensor

from vusfa.errors import ResultError
from vusfa.evaluation.baselines import RANDOM_WALK
from vusfa.evaluation.long_table import goal_sums
from vusfa.evaluation.searchers import SEARCHERS
from vusfa.evaluation.statistics import Sums, bootstrap_mean, paired_difference
from vusfa.experiments.runs import Run
from vusfa.report.markdown import markdown
from vusfa.report.result_tables import COMPARED

__all__ = ["policy_sums", "run_label", "unseen_table"]

_GAP = "in 100, less the random walk"


def unseen_table(runs: Sequence[Run]) -> str:
    """Markdown: success and SPL of each policy in the rooms of the test, and its success within 100 actions
    minus that of the random walk, in percentage points; with 95 % bootstrap intervals over seeds and goals,
    goals drawn within their rooms.

    Runs of several names (``name=`` of ``vusfa generalise``) are told apart by it; the searchers, which are
    the same for all, stand once. Runs that were tested in different rooms have a table each.

    Args:
        runs: one per name and seed; their exact tables are the random walk's.

    Raises:
        ResultError: there are no runs, or one of them was not tested beside the random walk.
    """
    if not runs or any(run.exact is None for run in runs):
        raise ResultError("there are no results of vusfa generalise; run it first")
    groups: dict[tuple[str, ...], list[Run]] = {}
    for run in runs:
        groups.setdefault(tuple(run.info["tested_in"]), []).append(run)
    if len(groups) == 1:
        return _table(runs)
    parts = []
    for rooms, group in groups.items():
        part = group[0].info.get("part")
        head = f"Tested in {len(rooms)} rooms" + (f" ({part})" if part else "")
        parts.append(f"**{head}**\n\n{_table(group)}")
    return "\n\n".join(parts)


def _table(runs: Sequence[Run]) -> str:
    """Of runs that were tested in the same rooms."""
    named: dict[str, list[Run]] = {}
    for run in runs:
        named.setdefault(run_label(run), []).append(run)
    rows: list[dict[str, Any]] = []
    for name, group in named.items():
        rows += _rows(group, f"{name}: " if len(named) > 1 else "")
    last = [*SEARCHERS, RANDOM_WALK]
    agents = [row for row in rows if row["policy"] not in last]
    others = {row["policy"]: row for row in rows if row["policy"] in last}
    shown = [*agents, *(others[policy] for policy in last if policy in others)]
    return markdown(shown, ["policy", "seeds", *COMPARED, _GAP])


def _rows(runs: Sequence[Run], prefix: str) -> list[dict[str, Any]]:
    """Of runs of one name, of which some may lack the searchers."""
    tables = [run.rows() for run in runs]
    rows: list[dict[str, Any]] = []
    for mode in dict.fromkeys(mode for run in runs for mode in run.episodes):
        walked = [table for run, table in zip(runs, tables, strict=True) if mode in run.episodes]
        baseline, scene = policy_sums(walked, "exact")
        sums, _ = policy_sums(walked, mode)
        means = {name: bootstrap_mean(sums[name], scene) for name in COMPARED}
        gap = paired_difference(sums["success_100"], baseline["success_100"], scene)
        policy = mode if mode in SEARCHERS else prefix + mode
        rows.append({"policy": policy, "seeds": len(walked), **means, _GAP: gap})
    baseline, scene = policy_sums(tables, "exact")
    means = {name: bootstrap_mean(baseline[name], scene) for name in COMPARED}
    return [*rows, {"policy": RANDOM_WALK, "seeds": None, **means}]


def run_label(run: Run) -> str:
    """Name of the agent: that of the run without part and seed."""
    name, part = run.name.rpartition("-")[0], run.info.get("part")
    return name.removesuffix(f"-{part}") if part else name


def policy_sums(tables: Sequence[pd.DataFrame], mode: str) -> tuple[dict[str, Sums], Tensor]:
    """Sums (K, G) of the compared metrics of K runs in one mode, and the scene (G,) of each goal."""
    found = {}
    for name in COMPARED:
        sums = goal_sums([table[table["mode"] == mode] for table in tables], name)
        if sums is None:
            raise ResultError(f"the runs were tested on different goals ({mode}); show those of one set")
        found[name], scene = sums
    return found, scene
