"""The table of ``vusfa robustness``: agents in changed renderings of their rooms."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from vusfa.errors import ResultError
from vusfa.evaluation.baselines import RANDOM_WALK, SHORTEST_PATH, shortest_paths
from vusfa.evaluation.long_table import episode_rows
from vusfa.evaluation.statistics import Estimate, bootstrap_mean
from vusfa.experiments.runs import Run
from vusfa.report.markdown import markdown
from vusfa.report.result_tables import COMPARED
from vusfa.report.unseen import policy_sums

__all__ = ["robustness_table"]

_GREEDY = ("greedy, in 500", "greedy, SPL")


def robustness_table(runs: Sequence[Run]) -> str:
    """Markdown: per agent and change success within 500 and within 100 actions and SPL, actions sampled; then
    success and SPL of the likeliest actions. With 95 % bootstrap intervals over seeds and goals, goals drawn
    within their rooms. The random walk and the shortest path come last.

    Args:
        runs: of ``vusfa robustness``, one per agent and seed, on the same episodes.

    Raises:
        ResultError: there are no runs, or the seeds of an agent have other changes or goals.
    """
    if not runs or any(run.exact is None or not run.episodes for run in runs):
        raise ResultError("there are no results of vusfa robustness; run it first")
    agents: dict[str, list[Run]] = {}
    for run in runs:
        agents.setdefault(run.label, []).append(run)
    rows = []
    for label, seeds in agents.items():
        changes = [tuple(run.episodes) for run in seeds]
        if len(set(changes)) > 1:
            raise ResultError(
                f"the seeds of {label} were tested in different changes; run them again in the same"
            )
        tables = [run.rows() for run in seeds]
        for change in [mode for mode in changes[0] if not mode.endswith("-greedy")]:
            row = {"agent": label, "change": change, "seeds": len(seeds), **_means(tables, change)}
            if f"{change}-greedy" in changes[0]:
                greedy = _means(tables, f"{change}-greedy")
                row |= dict(zip(_GREEDY, (greedy["success_500"], greedy["spl"]), strict=True))
            rows.append(row)
    first = runs[0]
    head = {"change": None, "seeds": None}
    rows.append({"agent": RANDOM_WALK, **head, **_means([first.rows()], "exact")})
    best = episode_rows(shortest_paths(next(iter(first.episodes.values()))), SHORTEST_PATH)
    rows.append({"agent": SHORTEST_PATH, **head, **_means([best], "sampled")})
    return markdown(rows, ["agent", "change", "seeds", *COMPARED, *_GREEDY])


def _means(tables: Sequence[pd.DataFrame], mode: str) -> dict[str, Estimate]:
    sums, scene = policy_sums(tables, mode)
    return {name: bootstrap_mean(sums[name], scene) for name in COMPARED}
