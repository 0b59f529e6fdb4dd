"""A new metric, from one function: python examples/extending/metric.py evaluate runs/.../checkpoint.pt

The share of episodes on a shortest path. It appears in the table of vusfa evaluate and its CSV, in
vusfa tables, and on the page of vusfa report wherever this module is imported first.
"""

from __future__ import annotations

from torch import Tensor

from vusfa.cli.functions import run_functions
from vusfa.evaluation import Episodes, register_metric
from vusfa.experiments.zero_shot import zero_shot
from vusfa.report.command import report_runs
from vusfa.report.print_tables import print_tables


@register_metric("perfect", label="perfect", title="Episodes on a shortest path", unit="%", exact=True)
def perfect(episodes: Episodes) -> tuple[Tensor, Tensor]:
    """Numerator and denominator per episode: whether the goal was reached on a shortest path; 1."""
    on_shortest_path = episodes.success & (episodes.length == episodes.shortest)
    return on_shortest_path, on_shortest_path | True


if __name__ == "__main__":
    run_functions(evaluate=zero_shot, tables=print_tables, report=report_runs)
