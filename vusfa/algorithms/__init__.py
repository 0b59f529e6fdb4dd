"""Algorithms: the losses of a batch, of replay, and what follows a step; a registry of them.

>>> ", ".join(sorted(ALGORITHMS))
'autoencoder, contrastive, forward_backward, hindsight, imitation, implicit_q, replay_search, usf'
"""

from vusfa.algorithms.autoencoder import Autoencoder
from vusfa.algorithms.base import Algorithm, AlgorithmSettings
from vusfa.algorithms.contrastive import Contrastive
from vusfa.algorithms.experience import ExperienceGraph
from vusfa.algorithms.forward_backward import ForwardBackward
from vusfa.algorithms.goal_learning import GoalLearning, GoalLearningSettings
from vusfa.algorithms.hindsight import Hindsight
from vusfa.algorithms.hindsight_goals import HindsightSampler
from vusfa.algorithms.imitation import Imitation
from vusfa.algorithms.implicit_q import ImplicitQ
from vusfa.algorithms.registry import (
    ALGORITHMS,
    LOSS_TERMS,
    make_algorithm,
    make_loss_terms,
    register_algorithm,
    register_loss_term,
)
from vusfa.algorithms.replay import HindsightReplay
from vusfa.algorithms.replay_search import ReplaySearch
from vusfa.algorithms.schedule import annealed, threads_per_step
from vusfa.algorithms.usf import USF, make_usf_loss

__all__ = [
    "ALGORITHMS",
    "LOSS_TERMS",
    "USF",
    "Algorithm",
    "AlgorithmSettings",
    "Autoencoder",
    "Contrastive",
    "ExperienceGraph",
    "ForwardBackward",
    "GoalLearning",
    "GoalLearningSettings",
    "Hindsight",
    "HindsightReplay",
    "HindsightSampler",
    "Imitation",
    "ImplicitQ",
    "ReplaySearch",
    "annealed",
    "make_algorithm",
    "make_loss_terms",
    "make_usf_loss",
    "register_algorithm",
    "register_loss_term",
    "threads_per_step",
]
