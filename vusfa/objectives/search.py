r"""Distillation of known shortest paths into a policy and its value.

Eysenbach et al. (2019, https://arxiv.org/abs/1906.05253) search a graph of replayed states while they act.
Here the search ends in training: a graph of the agent's own transitions gives all the first steps of
shortest paths between a state and a goal, which the policy learns at once, and the length of these paths. The
return of a path of known length is known (:func:`~vusfa.objectives.walked_return`): V needs no bootstrapping.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torch import Tensor

from vusfa.objectives.functional import assert_same_shape
from vusfa.objectives.goal_loss import GoalLoss, weighted_mean
from vusfa.objectives.hindsight import walked_return
from vusfa.objectives.networks import entry, run_actor_critic, select_inputs
from vusfa.objectives.scores import finite_logits

__all__ = ["SearchKeys", "SearchLoss", "best_action_log_prob"]


def best_action_log_prob(logits: Tensor, best_action: Tensor) -> Tensor:
    r"""Log-probability that a policy takes any of the best actions.

    .. math::
        \log \sum_{a \in A^*(s, g)} \pi(a | s, g)

    Args:
        logits: (\*B, A), need not be normalized.
        best_action: (\*B, A), bool; a row without any gives minus infinity.

    Returns:
        (\*B,), in nats.

    >>> logits = torch.tensor([[0.5, 0.25, 0.25]]).log()
    >>> best_action_log_prob(logits, torch.tensor([[True, False, True]])).exp()
    tensor([0.7500])
    """
    return logits.log_softmax(-1).masked_fill(~best_action, -torch.inf).logsumexp(-1)


@dataclass
class SearchKeys:
    """Entries of :class:`SearchLoss`, beside the inputs of its networks.

    Attributes:
        best_action: first steps of the shortest known paths to the goal, ``(*batch, A)`` bool.
        steps_to_goal: length of these paths, ``(*batch,)``; 0 where there is none.
        value: V, which the critic writes.
    """

    best_action: NestedKey = "best_action"
    steps_to_goal: NestedKey = "steps_to_goal"
    value: NestedKey = "state_value"


class SearchLoss(GoalLoss):
    r"""Value and policy of shortest paths that are known.

    .. math::
        c_V \, \big(V(s, g) - R(k)\big)^2 - c_\pi \log \sum_{a \in A^*(s, g)} \pi(a | s, g)

    k is the length of the shortest known path from s to g, R its return
    (:func:`~vusfa.objectives.walked_return`), A* the actions that begin such a path
    (:func:`best_action_log_prob`). Rows without a path, and rows that a mask hides, count for nothing.
    Modules that actor and critic both hold run once.

    Args:
        actor_network: the policy, with ``get_dist``; its distribution is categorical (has ``logits``).
        critic_network: writes ``state_value``.
        critic_coeff: c_V, a buffer; None leaves the term out.
        objective_coeff: c_pi, a buffer; None leaves the term out.
        gamma: discount per step, in (0, 1).
        goal_reward, step_reward: of the environment.
        reduction: ``"mean"``, ``"sum"`` or ``"none"`` over rows.
        functional: whether the loss holds the networks' parameters as tensordicts apart from the modules.

    Returns (of ``forward``): ``loss_search_critic`` and ``loss_search_objective``, and for logging
    ``search_accuracy``, the share of rows whose most probable action is among the best.

    Raises:
        TypeError: an argument is no actor or critic, such as an agent itself; in ``forward``, a distribution
            without logits.
        ValueError: an argument is out of its range; in ``forward``, the critic lacks an entry.

    >>> from vusfa.modules import make_agent
    >>> from vusfa.scenes import SceneSet
    >>> scenes = SceneSet.bundled(["bathroom"])
    >>> agent = make_agent("usfa", scenes=scenes, history=1, hidden_size=8, embedding_size=8)
    >>> loss = SearchLoss(agent.get_policy_operator(), agent.get_value_operator())
    >>> pairs = TensorDict({
    ...     "state_id": torch.tensor([[0], [1]]), "goal_id": torch.tensor([4, 4]),
    ...     "scene_id": torch.tensor([0, 0]), "steps_to_goal": torch.tensor([3, 0]),
    ...     "best_action": torch.tensor([[True, False, False, True], [False] * 4]),
    ... }, [2])
    >>> sorted(loss(pairs).keys())
    ['loss_search_critic', 'loss_search_objective', 'search_accuracy']
    """

    _AcceptedKeys = SearchKeys
    default_keys = SearchKeys
    tensor_keys: SearchKeys
    terms = ("loss_search_critic", "loss_search_objective")
    logged = ("search_accuracy",)

    def _default_in_keys(self) -> list[NestedKey]:
        keys = self.tensor_keys
        own: list[NestedKey] = [keys.best_action, keys.steps_to_goal]
        return [*own, *self.actor_network.in_keys, *self.critic_network.in_keys]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The terms of the loss, scalars, or ``(*batch,)`` with ``reduction="none"``.

        Args:
            tensordict: pairs of states and goals, any batch shape. Not written.

        Raises:
            KeyError: an entry is missing.
            ValueError: best actions are not one mark per action and row, or steps not one number per row.
        """
        self.check()
        keys, actor, critic = self.tensor_keys, self.actor_network, self.critic_network
        best, steps = entry(self, tensordict, keys.best_action), entry(self, tensordict, keys.steps_to_goal)
        with self._params_in_place():
            inputs = select_inputs(tensordict, *actor.in_keys, *critic.in_keys)
            distribution, written = run_actor_critic(actor, critic, inputs)
        logits, value = finite_logits("SearchLoss", distribution), self._value(written)
        assert_same_shape("SearchLoss", best_action=best, logits=logits)
        assert_same_shape("SearchLoss", steps_to_goal=steps, state_value=value)
        with torch.no_grad():
            target = walked_return(steps, self.gamma, self.goal_reward, self.step_reward)
            counts = self._counted(tensordict, (steps > 0) & best.any(-1)).to(value.dtype)
            hit = best.gather(-1, logits.argmax(-1, keepdim=True)).squeeze(-1).to(value.dtype)
        out = TensorDict({}, batch_size=[])
        if self.critic_coeff is not None:
            error = (value - torch.where(counts > 0, target, 0.0)).square()
            out.set("loss_search_critic", self._weighted(self.critic_coeff, error, counts))
        if self.objective_coeff is not None:
            marks = best | (counts == 0).unsqueeze(-1)  # rows that do not count would be minus infinity
            log_prob = best_action_log_prob(logits, marks)
            out.set("loss_search_objective", self._weighted(self.objective_coeff, -log_prob, counts))
        out.set("search_accuracy", weighted_mean(1.0, hit, counts))
        self._clear_weakrefs(tensordict, out, "actor_network_params", "critic_network_params")
        return out
