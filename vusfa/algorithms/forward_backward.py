r"""Forward-backward representations (Touati and Ollivier 2021, https://arxiv.org/abs/2103.07945).

Universal successor features whose embedding is learned with them: for every task z, a vector of d numbers,
the discounted visits of the policy of z have the density F(s, a, z) . B(s'), and that policy takes the action
with the largest F(s, a, z) . z. A goal g is the task z = B(g).

F and B learn from the Bellman equation of that density (:func:`~vusfa.objectives.goal_critics.measure_loss`),
for tasks of which some are goals and the others random directions; B is kept orthonormal
(:func:`~vusfa.objectives.goal_critics.orthonormality_loss`). No reward is read.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from vusfa.algorithms.goal_learning import GoalLearning, GoalLearningSettings, SceneSample, Scores, slow_copy
from vusfa.algorithms.registry import register_algorithm
from vusfa.errors import ConfigError
from vusfa.modules import Agent
from vusfa.modules.goal_critics import ForwardBackwardCritic
from vusfa.objectives.goal_critics import implied_reward, measure_loss, orthonormality_loss
from vusfa.scenes import SceneSet

__all__ = ["ForwardBackward", "ForwardBackwardSettings"]


@dataclass
class ForwardBackwardSettings(GoalLearningSettings):
    """Numbers of ``algorithm=forward_backward``.

    Attributes:
        goal_share: share of the tasks that are goals; the others are random directions.
        orthonormality: coefficient of that term.
        value_coeff: coefficient of the squared error of F . z / d in the Bellman equation of its own reward.
        target_rate: share of the new weights in the slow copy's, per step.
        softness: temperature of the policy that the targets follow, in units of F . z; 0: the best action.
    """

    batch_size: int = 2048
    goal_share: float = 0.5
    orthonormality: float = 1.0
    value_coeff: float = 1.0
    target_rate: float = 0.05
    softness: float = 0.0


@register_algorithm("forward_backward")
class ForwardBackward(GoalLearning):
    """Forward and backward representations; see :mod:`vusfa.algorithms.forward_backward`."""

    Settings = ForwardBackwardSettings

    def __init__(self, agent: Agent, scenes: SceneSet, settings: Mapping[str, Any]) -> None:
        super().__init__(agent, scenes, settings)
        if not 0 < self.numbers["target_rate"] < 1 or not 0 <= self.numbers["goal_share"] <= 1:
            raise ConfigError(
                f"algorithm.target_rate is {self.numbers['target_rate']} and goal_share"
                f" {self.numbers['goal_share']}; give numbers between 0 and 1"
            )
        self.slow = slow_copy(self.critic, self.numbers["target_rate"])

    def make_critic(self, feature_size: int, num_actions: int) -> ForwardBackwardCritic:
        """F and B."""
        return ForwardBackwardCritic(
            feature_size, num_actions, self.numbers["hidden_size"], self.numbers["embedding_size"]
        )

    def critic_terms(self, sample: SceneSample, features: Tensor) -> tuple[dict[str, Tensor], Scores]:
        """Bellman error of the measure, from the scene's transitions to all its seen states."""
        critic: Any = self.critic
        slow: Any = self.slow.module
        numbers = self.numbers
        sample = sample.of_a_few_sizes()
        back, rows = critic.backward_of(features), len(sample.state)
        density = sample.following.bincount(minlength=len(features)) / rows
        with torch.no_grad():
            task = critic.unit(torch.randn(rows, critic.size, device=features.device))
            aimed = torch.rand(rows, 1, device=features.device) < numbers["goal_share"]
            task = torch.where(aimed, back[sample.goal], task)
            ahead = slow(features, task, sample.following)
            chosen = _policy(ahead, task, numbers["softness"])
            followed = (chosen.unsqueeze(-1) * ahead).sum(1)
            slow_measure = followed @ slow.backward_of(features).mT
            reward = implied_reward(back, density, task, sample.following)
            target = reward + numbers["discount"] * (followed * task).sum(-1)
        forward = critic(features, task, sample.state)
        taken = forward[torch.arange(rows), sample.action]
        with torch.autocast(features.device.type, enabled=False):
            measured = measure_loss(
                taken @ back.mT, slow_measure, sample.following, density, numbers["discount"]
            )
            ordered = numbers["orthonormality"] * orthonormality_loss(back, density)
            error = ((taken * task).sum(-1) - target) / critic.size
            valued = numbers["value_coeff"] * error.square().mean()

        def scores(state: Tensor, goal: Tensor) -> Tensor:
            with torch.no_grad():
                task = back.detach()[goal]
                return (critic(features, task, state) * task.unsqueeze(1)).sum(-1)

        terms = {"loss_measure": measured, "loss_orthonormality": ordered, "loss_task_value": valued}
        return terms, scores

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


def _policy(forward: Tensor, task: Tensor, softness: float) -> Tensor:
    """Probabilities (n, A) of the policy of each task, from F (n, A, d)."""
    values = (forward * task.unsqueeze(1)).sum(-1)
    if softness > 0:
        return (values / softness).softmax(-1)
    return torch.nn.functional.one_hot(values.argmax(-1), values.shape[-1]).to(values.dtype)
