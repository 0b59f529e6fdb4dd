r"""Contrastive reinforcement learning (Eysenbach et al. 2022, https://arxiv.org/abs/2206.07568).

A critic learns to tell the states that follow a state and an action from states that follow others:

.. math:: f(s, a, g) = \psi(s, a) \cdot \omega(g) / \sqrt E

The positive goals of a transition are states that its own episode reached k steps later, k drawn
geometrically; the negatives are the goals of the sample's other transitions in the scene
(:func:`~vusfa.objectives.goal_critics.info_nce_loss`). The best critic is f = log p(g | s, a) - log p(g) but
for a constant, with p the discounted distribution of the states to come under the policy that collected.
There is no bootstrapping and no reward. The policy learns the softmax of f over the actions.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from vusfa.algorithms.goal_learning import GoalLearning, GoalLearningSettings, SceneSample, Scores, scores_of
from vusfa.algorithms.registry import register_algorithm
from vusfa.modules.goal_critics import BilinearCritic
from vusfa.objectives.goal_critics import info_nce_loss

__all__ = ["Contrastive", "ContrastiveSettings"]


@dataclass
class ContrastiveSettings(GoalLearningSettings):
    """Numbers of ``algorithm=contrastive``, and ``penalty``, c of
    :func:`~vusfa.objectives.goal_critics.info_nce_loss`."""

    penalty: float = 0.01


@register_algorithm("contrastive")
class Contrastive(GoalLearning):
    """Contrastive critic and the policy of its softmax; see :mod:`vusfa.algorithms.contrastive`."""

    Settings = ContrastiveSettings

    def make_critic(self, feature_size: int, num_actions: int) -> BilinearCritic:
        """psi and omega."""
        return BilinearCritic(
            feature_size, num_actions, self.numbers["hidden_size"], self.numbers["embedding_size"]
        )

    def critic_terms(self, sample: SceneSample, features: Tensor) -> tuple[dict[str, Tensor], Scores]:
        """InfoNCE of the scene's transitions."""
        scores = self.critic(features, features)
        count = sample.counts(self.scenes.num_actions)
        loss = info_nce_loss(scores.flatten(0, 1), count, self.numbers["penalty"])
        return {"loss_contrastive": loss}, scores_of(scores)
