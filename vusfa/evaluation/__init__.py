"""What an agent is worth: success, SPL and lengths over episodes, between the random walk and the shortest
path.

>>> from vusfa.evaluation import evaluate, summary
"""

from vusfa.evaluation.comparison import Comparison, check_comparison, compare
from vusfa.evaluation.episodes import Episodes
from vusfa.evaluation.floors import random_walk, shortest_paths
from vusfa.evaluation.navigation import episode_starts, evaluate, walk
from vusfa.evaluation.report import print_summary, random_walk_summary, summary

__all__ = [
    "Comparison",
    "Episodes",
    "check_comparison",
    "compare",
    "episode_starts",
    "evaluate",
    "print_summary",
    "random_walk",
    "random_walk_summary",
    "shortest_paths",
    "summary",
    "walk",
]
