r"""Extraction of a policy from a critic's scores of all actions.

A critic of state, action and goal, whatever it was learned by, ranks the actions. The policy learns the
softmax of these scores, by cross-entropy, and the value the best score: the agent then acts, is evaluated and
drawn like any other, without its critic.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torch.distributions import Distribution

from vusfa.objectives.functional import assert_same_shape
from vusfa.objectives.goal_loss import GoalLoss, weighted_mean
from vusfa.objectives.networks import entry, run_actor_critic, select_inputs

__all__ = ["ScoreKeys", "ScoreLoss", "finite_logits"]


def finite_logits(loss: str, distribution: Distribution) -> Tensor:
    """Logits (\\*batch, A) of a policy over finitely many actions, float32 or more; else a ``TypeError`` that
    names the loss.

    >>> finite_logits("SearchLoss", torch.distributions.Categorical(logits=torch.zeros(3, 2))).shape
    torch.Size([3, 2])
    """
    logits = getattr(distribution, "logits", None)
    if logits is None:
        raise TypeError(
            f"{loss}: the policy's distribution is {type(distribution).__name__}, which has no logits;"
            " give a policy over a finite set of actions"
        )
    return logits.to(torch.promote_types(logits.dtype, torch.float32))


@dataclass
class ScoreKeys:
    """Entries of :class:`ScoreLoss`, beside the inputs of its networks.

    Attributes:
        action_scores: a critic's scores of all actions, ``(*batch, A)``, constants.
        value: V, which the critic network writes.
    """

    action_scores: NestedKey = "action_scores"
    value: NestedKey = "state_value"


class ScoreLoss(GoalLoss):
    r"""Policy and value of a critic's scores of all actions.

    .. math::
        c_V \, \big(V(s, g) - \max_a f(s, a, g)\big)^2
        - c_\pi \sum_a p(a) \log \pi(a | s, g), \qquad p = \mathrm{softmax}(f(s, \cdot, g) / T)

    Scores are constants. Rows that a mask hides count for nothing. Modules that actor and critic both hold
    run once. The policy's term is the divergence from p to pi but for p's entropy: as T goes to 0, pi learns
    the critic's argmax.

    Args:
        actor_network: the policy, with ``get_dist``; its distribution is categorical (has ``logits``).
        critic_network: writes ``state_value``.
        temperature: T, in the units of the scores.
        **arguments: the others of :class:`~vusfa.objectives.SearchLoss`.

    Returns (of ``forward``): ``loss_score_critic`` and ``loss_score_objective``, and for logging
    ``score_agreement``, the share of rows whose most probable action has the best score.

    Raises:
        TypeError: an argument is no actor or critic; in ``forward``, a distribution without logits.
        ValueError: an argument is out of its range; in ``forward``, the critic lacks an entry.

    >>> from vusfa.modules import make_agent
    >>> from vusfa.scenes import SceneSet
    >>> scenes = SceneSet.bundled(["bathroom"])
    >>> agent = make_agent("gvf", scenes=scenes, history=1, hidden_size=8, embedding_size=8)
    >>> loss = ScoreLoss(agent.get_policy_operator(), agent.get_value_operator(), temperature=0.5)
    >>> pairs = TensorDict({
    ...     "state_id": torch.tensor([[0], [1]]), "goal_id": torch.tensor([4, 4]),
    ...     "scene_id": torch.tensor([0, 0]), "action_scores": torch.rand(2, 4),
    ... }, [2])
    >>> sorted(loss(pairs).keys())
    ['loss_score_critic', 'loss_score_objective', 'score_agreement']
    """

    _AcceptedKeys = ScoreKeys
    default_keys = ScoreKeys
    tensor_keys: ScoreKeys
    terms = ("loss_score_critic", "loss_score_objective")
    logged = ("score_agreement",)

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        critic_network: TensorDictModuleBase,
        *,
        temperature: float = 1.0,
        **arguments: Any,
    ) -> None:
        if not temperature > 0:
            raise ValueError(f"ScoreLoss: temperature is {temperature}; give a number above 0")
        super().__init__(actor_network, critic_network, **arguments)
        self.temperature = temperature

    def _default_in_keys(self) -> list[NestedKey]:
        return [self.tensor_keys.action_scores, *self.actor_network.in_keys, *self.critic_network.in_keys]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The terms of the loss, scalars, or ``(*batch,)`` with ``reduction="none"``.

        Args:
            tensordict: pairs of states and goals, any batch shape. Not written.

        Raises:
            KeyError: an entry is missing.
            ValueError: scores are not one number per action and row.
        """
        self.check()
        actor, critic = self.actor_network, self.critic_network
        scores = entry(self, tensordict, self.tensor_keys.action_scores)
        with self._params_in_place():
            inputs = select_inputs(tensordict, *actor.in_keys, *critic.in_keys)
            distribution, written = run_actor_critic(actor, critic, inputs)
        logits, value = finite_logits("ScoreLoss", distribution), self._value(written)
        assert_same_shape("ScoreLoss", action_scores=scores, logits=logits)
        with torch.no_grad():
            scores = scores.to(value.dtype)
            best, target = scores.max(-1).values, (scores / self.temperature).softmax(-1)
            counts = self._counted(tensordict, torch.ones_like(best, dtype=torch.bool)).to(value.dtype)
            hit = scores.gather(-1, logits.argmax(-1, keepdim=True)).squeeze(-1) == best
        out = TensorDict({}, batch_size=[])
        if self.critic_coeff is not None:
            out.set("loss_score_critic", self._weighted(self.critic_coeff, (value - best).square(), counts))
        if self.objective_coeff is not None:
            entropy = -(target * logits.log_softmax(-1)).sum(-1)
            out.set("loss_score_objective", self._weighted(self.objective_coeff, entropy, counts))
        out.set("score_agreement", weighted_mean(1.0, hit.to(value.dtype), counts))
        self._clear_weakrefs(tensordict, out, "actor_network_params", "critic_network_params")
        return out
