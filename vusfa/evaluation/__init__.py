"""Evaluation: rollouts, metrics, the long table of results, reference baselines, statistics.

>>> from vusfa.evaluation import evaluate, summary
"""

from vusfa.evaluation.baselines import random_walk, shortest_paths
from vusfa.evaluation.comparison import Comparison, check_comparison, compare
from vusfa.evaluation.episodes import Episodes
from vusfa.evaluation.metrics import METRICS, Metric, get_metric, register_metric
from vusfa.evaluation.navigation import evaluate, trails, walk
from vusfa.evaluation.searchers import evaluate_searchers
from vusfa.evaluation.starts import episode_starts
from vusfa.evaluation.summary import print_summary, random_walk_summary, summary

__all__ = [
    "METRICS",
    "Comparison",
    "Episodes",
    "Metric",
    "check_comparison",
    "compare",
    "episode_starts",
    "evaluate",
    "evaluate_searchers",
    "get_metric",
    "print_summary",
    "random_walk",
    "random_walk_summary",
    "register_metric",
    "shortest_paths",
    "summary",
    "trails",
    "walk",
]
