r"""Hindsight implicit Q-learning: goal-conditioned IQL, the method that OGBench calls GCIQL.

Kostrikov et al. 2021 (https://arxiv.org/abs/2110.06169) with goals named in hindsight, as in Park et al. 2024
(https://arxiv.org/abs/2410.20092):

.. math::
    Q(s, a, g) \to y = 0 \text{ where } s' = g, \text{ else } -c + \gamma \min(V(s', g), 0), \qquad
    V(s, g) \to \text{expectile}_\tau \text{ over } a \text{ of } \bar Q(s, a, g)

Every step but the one that arrives costs c, as in OGBench, so that Q is minus a discounted number of steps.
Q = psi(s, a) . omega(g) and V = psi(s) . omega(g) are products, so every transition of a sample learns
towards all seen states of its scene at once, where OGBench draws one goal per transition. For a goal that the
episode itself reached in k steps, y is no less than the return of these. The slow copy of Q is a moving
average of its weights. The policy learns the softmax of Q over the actions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from vusfa.algorithms.goal_learning import (
    GoalLearning,
    GoalLearningSettings,
    SceneSample,
    Scores,
    scores_of,
    slow_copy,
)
from vusfa.algorithms.registry import register_algorithm
from vusfa.errors import ConfigError
from vusfa.modules import Agent
from vusfa.modules.goal_critics import BilinearCritic
from vusfa.objectives.goal_critics import implicit_q_loss
from vusfa.objectives.hindsight import relabelled_target, walked_return
from vusfa.scenes import SceneSet

__all__ = ["ImplicitQ", "ImplicitQSettings"]


@dataclass
class ImplicitQSettings(GoalLearningSettings):
    """Numbers of ``algorithm=implicit_q``.

    Attributes:
        step_cost: c.
        expectile: tau; above 0.5: V leans towards the better of the actions in the data.
        target_rate: share of the new weights in the slow copy's, per step.
        own_weight: weight of the goal of a transition's own episode, beside 1 of every seen state; its target
            is no less than the return of the episode on its way there.
    """

    step_cost: float = 0.2
    expectile: float = 0.9
    target_rate: float = 0.9
    own_weight: float = 1.0
    discount: float = 0.95
    temperature: float = 0.02


@register_algorithm("implicit_q")
class ImplicitQ(GoalLearning):
    """Implicit Q-learning of all seen goals; see :mod:`vusfa.algorithms.implicit_q`."""

    Settings = ImplicitQSettings

    def __init__(self, agent: Agent, scenes: SceneSet, settings: Mapping[str, Any]) -> None:
        super().__init__(agent, scenes, settings)
        for name in ("expectile", "target_rate"):
            if not 0 < self.numbers[name] < 1:
                raise ConfigError(f"algorithm.{name} is {self.numbers[name]}; give a number between 0 and 1")
        if not self.numbers["step_cost"] > 0:
            raise ConfigError(f"algorithm.step_cost is {self.numbers['step_cost']}; give a number above 0")
        self.rewards = {"goal_reward": 0.0, "step_reward": -self.numbers["step_cost"]}
        self.slow = slow_copy(self.critic, self.numbers["target_rate"])

    def make_critic(self, feature_size: int, num_actions: int) -> BilinearCritic:
        """psi and omega; behind those of the actions stands the state's own psi, which V is made of."""
        return BilinearCritic(
            feature_size, num_actions + 1, self.numbers["hidden_size"], self.numbers["embedding_size"]
        )

    def critic_terms(self, sample: SceneSample, features: Tensor) -> tuple[dict[str, Tensor], Scores]:
        """TD of Q and expectile of V, from the scene's transitions to all its seen states."""
        numbers, actions = self.numbers, self.scenes.num_actions
        scores = self.critic(features, features)
        with torch.no_grad():
            slow = self.slow(features, features)
            goals = torch.arange(len(sample.states), device=features.device)
            row, place = (sample.state * actions + sample.action).unique(return_inverse=True)
            often = place.bincount()
            following = torch.empty_like(row).scatter_(0, place, sample.following)
            arrived = following.unsqueeze(1) == goals
            target = relabelled_target(scores[following, -1], arrived, numbers["discount"], **self.rewards)
            walked = walked_return(sample.steps, numbers["discount"], **self.rewards)
            entry = place * len(goals) + sample.goal
            target.view(-1).scatter_reduce_(0, entry, walked, "amax")
            weight = often.unsqueeze(1).expand_as(target).clone() / len(goals)
            weight.view(-1).index_add_(0, entry, torch.full_like(walked, numbers["own_weight"]))
            state, action = row // actions, row % actions
            weight[state.unsqueeze(1) == goals] = 0.0
        loss = implicit_q_loss(
            scores[state, action],
            scores[state, -1],
            target,
            slow[state, action],
            numbers["expectile"],
            weight,
        )
        return {"loss_implicit_q": loss}, scores_of(scores[:, :-1])

    def replay_losses(self) -> dict[str, Tensor]:
        """Terms of a sample; the slow copy has followed the step before."""
        self.slow.update_parameters(self.critic)
        return super().replay_losses()

    def state_dict(self) -> dict[str, Any]:
        """With the slow copy."""
        return {**super().state_dict(), "slow": self.slow.state_dict()}

    def warm_start(self, state: Mapping[str, Any]) -> None:
        """Take critic and slow copy."""
        super().warm_start(state)
        self.slow.load_state_dict(state["slow"])
