"""The table of ``vusfa generalise``: rooms that the agent has never seen."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd
from torch import Tensor

from vusfa.errors import ResultError
from vusfa.evaluation.baselines import RANDOM_WALK
from vusfa.evaluation.long_table import goal_sums
from vusfa.evaluation.statistics import Sums, bootstrap_mean, paired_difference
from vusfa.experiments.runs import Run
from vusfa.report.markdown import markdown
from vusfa.report.result_tables import COMPARED

__all__ = ["policy_sums", "unseen_table"]

_GAP = "in 100, less the random walk"


def unseen_table(runs: Sequence[Run]) -> str:
    """Markdown: success and SPL of each policy in the rooms of the test, and its success within 100 actions
    minus that of the random walk, in percentage points; with 95 % bootstrap intervals over seeds and goals,
    goals drawn within their rooms.

    Args:
        runs: one per seed, tested in the same rooms; their exact tables are the random walk's.

    Raises:
        ResultError: there are no runs, or they were tested in different rooms or without the random walk.
    """
    if not runs or any(run.exact is None for run in runs):
        raise ResultError("there are no results of vusfa generalise; run it first")
    if len({tuple(run.info["tested_in"]) for run in runs}) > 1:
        raise ResultError("the runs were tested in different rooms; show those of one set of rooms")
    tables = [run.rows() for run in runs]
    baseline, scene = policy_sums(tables, "exact")
    rows = []
    for mode in runs[0].episodes:
        sums, _ = policy_sums(tables, mode)
        means = {name: bootstrap_mean(sums[name], scene) for name in COMPARED}
        gap = paired_difference(sums["success_100"], baseline["success_100"], scene)
        rows.append({"policy": mode, "seeds": len(runs), **means, _GAP: gap})
    means = {name: bootstrap_mean(baseline[name], scene) for name in COMPARED}
    rows.append({"policy": RANDOM_WALK, "seeds": None, **means})
    return markdown(rows, ["policy", "seeds", *COMPARED, _GAP])


def policy_sums(tables: Sequence[pd.DataFrame], mode: str) -> tuple[dict[str, Sums], Tensor]:
    """Sums (K, G) of the compared metrics of K runs in one mode, and the scene (G,) of each goal."""
    found = {}
    for name in COMPARED:
        sums = goal_sums([table[table["mode"] == mode] for table in tables], name)
        if sums is None:
            raise ResultError(f"the runs were tested on different goals ({mode}); show those of one set")
        found[name], scene = sums
    return found, scene
