r"""Off-policy learning from an agent's own walks, towards goals named in hindsight.

A transition tells something about every goal g: whether it arrived at g, and, through V(s', g), how far g
still is. Its reward is known without asking the environment: ``goal_reward`` for the step that arrives,
``step_reward`` for any other. So V = psi . omega is learned for all goals that the agent can name
(Andrychowicz et al., 2017, https://arxiv.org/abs/1707.01495), by an expectile, which leans towards the better
of the actions in the data (Kostrikov et al., 2021, https://arxiv.org/abs/2110.06169), and the policy imitates
these actions, weighted by their advantage (Peng et al., 2019, https://arxiv.org/abs/1910.00177).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor

from vusfa.objectives.distribution import action_log_prob
from vusfa.objectives.functional import assert_same_shape
from vusfa.objectives.goal_loss import GoalLoss, weighted_mean
from vusfa.objectives.networks import entry, run_actor_critic, run_critic, select_inputs

__all__ = ["HindsightKeys", "HindsightLoss", "expectile_loss", "relabelled_target", "walked_return"]


def relabelled_target(
    next_value: Tensor, arrived: Tensor, gamma: float, goal_reward: float = 1.0, step_reward: float = -0.01
) -> Tensor:
    r"""The one-step target of V(s, g) for a goal named in hindsight.

    .. math::
        y = r_g \text{ where } s' = g, \text{ else } r + \gamma \min(V(s', g), r_g)

    No state is worth more than arriving; without that bound early errors drive each other up.

    Args:
        next_value: V(s', g), any shape.
        arrived: bool, of that shape: s' is g.
        gamma: discount per step.
        goal_reward, step_reward: of the environment.

    >>> relabelled_target(torch.tensor([0.5, 0.5, 3.0]), torch.tensor([False, True, False]), gamma=0.9)
    tensor([0.4400, 1.0000, 0.8900])
    """
    return torch.where(arrived, goal_reward, step_reward + gamma * next_value.clamp(max=goal_reward))


def walked_return(
    steps: Tensor, gamma: float, goal_reward: float = 1.0, step_reward: float = -0.01
) -> Tensor:
    r"""The return of the agent's own way to g, k steps long: a lower bound of the best.

    .. math::
        \gamma^{k-1} r_g + r \, \frac{1 - \gamma^{k-1}}{1 - \gamma}

    Args:
        steps: k, int64, any shape; 0 where the agent did not go there: minus infinity.
        gamma: discount per step, below 1.
        goal_reward, step_reward: of the environment.

    >>> walked_return(torch.tensor([1, 2, 3, 0]), gamma=0.9)
    tensor([1.0000, 0.8900, 0.7910,   -inf])
    """
    power = gamma ** (steps - 1).clamp(min=0).float()
    value = power * goal_reward + step_reward * (1 - power) / (1 - gamma)
    return torch.where(steps > 0, value, -torch.inf)


def expectile_loss(value: Tensor, target: Tensor, expectile: float) -> Tensor:
    r"""Squared error, with weight ``expectile`` where the value is too low and one minus it elsewhere.

    ``2 |tau - 1[target < V]| (target - V)^2``: twice the usual half, so that tau = 0.5 is the square.

    Args:
        value: V, any shape.
        target: of that shape; a constant.
        expectile: tau, in (0, 1).

    >>> expectile_loss(torch.tensor([0.0, 2.0]), torch.tensor([1.0, 1.0]), 0.75)
    tensor([1.5000, 0.5000])
    """
    error = target.detach() - value
    weight = torch.where(error > 0, expectile, 1 - expectile)
    return 2 * weight * error.square()


@dataclass
class HindsightKeys:
    """Entries of :class:`HindsightLoss`, beside the inputs of its networks.

    Attributes:
        state: ids of the last H frames, ``(*batch, H)``, now and under ``"next"``.
        goal: its id, ``(*batch,)``.
        action: the action taken, or a list of keys for a composite action.
        steps_to_goal: length of the agent's own way to the goal, ``(*batch,)``; 0 where there is none.
        value: V, which the critic writes.
    """

    state: NestedKey = "state_id"
    goal: NestedKey = "goal_id"
    action: NestedKey | list[NestedKey] = "action"
    steps_to_goal: NestedKey = "steps_to_goal"
    value: NestedKey = "state_value"


class HindsightLoss(GoalLoss):
    r"""Value and policy for goals named in hindsight, from single transitions of any policy.

    .. math::
        c_V \, L_\tau\big(V(s, g), \max(y, R)\big)
        - c_\pi \frac{\sum w \log \pi(a|s, g)}{\sum w},
        \qquad w = \min\big(e^{(y - V(s, g)) / T}, w_{max}\big)

    y is :func:`relabelled_target`, R :func:`walked_return`, L :func:`expectile_loss`; targets and weights are
    constants. Rows whose state is the goal, and rows that a mask hides, count for nothing. Modules that actor
    and critic both hold run once. There is no importance weight: expectile and advantage pick among the
    data's actions, whoever chose them.

    Args:
        actor_network: the policy, with ``get_dist``.
        critic_network: writes ``state_value``; of its inputs the state alone differs in the next step.
        critic_coeff: c_V, a buffer; None leaves the term out.
        objective_coeff: c_pi, a buffer; None leaves the term out.
        gamma: discount per step, in (0, 1).
        expectile, temperature, max_weight: tau, T (in units of value) and w_max.
        goal_reward, step_reward: of the environment.
        reduction: ``"mean"``, ``"sum"`` or ``"none"`` over rows. The policy's mean is weighted by w, as
            above; its sum is that of w log pi.
        functional: whether the loss holds the networks' parameters as tensordicts apart from the modules.

    Returns (of ``forward``): ``loss_hindsight_critic`` and ``loss_hindsight_objective``, and for logging
    ``hindsight_value`` and ``hindsight_advantage``, means.

    Raises:
        TypeError: an argument is no actor or critic, such as an agent itself.
        ValueError: an argument is out of its range; in ``forward``, the critic lacks an entry.

    >>> from vusfa.modules import make_agent
    >>> from vusfa.scenes import SceneSet
    >>> scenes = SceneSet.bundled(["bathroom"])
    >>> agent = make_agent("usfa", scenes=scenes, history=1, hidden_size=8, embedding_size=8)
    >>> loss = HindsightLoss(agent.get_policy_operator(), agent.get_value_operator())
    >>> state, zeros = torch.arange(5), torch.zeros(5, dtype=torch.int64)
    >>> steps = TensorDict({
    ...     "state_id": state.view(5, 1), "next": {"state_id": state.view(5, 1) + 1},
    ...     "goal_id": state.flip(0), "scene_id": zeros, "action": zeros, "steps_to_goal": zeros,
    ... }, [5])
    >>> sorted(loss(steps).keys())
    ['hindsight_advantage', 'hindsight_value', 'loss_hindsight_critic', 'loss_hindsight_objective']
    """

    _AcceptedKeys = HindsightKeys
    default_keys = HindsightKeys
    tensor_keys: HindsightKeys
    terms = ("loss_hindsight_critic", "loss_hindsight_objective")
    logged = ("hindsight_value", "hindsight_advantage")

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        critic_network: TensorDictModuleBase,
        *,
        critic_coeff: float | None = 100.0,
        objective_coeff: float | None = 1.0,
        gamma: float = 0.95,
        expectile: float = 0.7,
        temperature: float = 0.02,
        max_weight: float = 10.0,
        goal_reward: float = 1.0,
        step_reward: float = -0.01,
        reduction: Literal["none", "mean", "sum"] | None = "mean",
        functional: bool = True,
    ) -> None:
        if not 0 < expectile < 1:
            raise ValueError(f"HindsightLoss: expectile is {expectile}; give a number between 0 and 1")
        for name, value in (("temperature", temperature), ("max_weight", max_weight)):
            if not value > 0:
                raise ValueError(f"HindsightLoss: {name} is {value}; give a number above 0")
        super().__init__(
            actor_network,
            critic_network,
            critic_coeff=critic_coeff,
            objective_coeff=objective_coeff,
            gamma=gamma,
            goal_reward=goal_reward,
            step_reward=step_reward,
            reduction=reduction,
            functional=functional,
        )
        self.expectile, self.temperature, self.max_weight = expectile, temperature, max_weight
        self._set_action_keys()

    def check(self) -> None:
        """Raise where the critic lacks an entry; ``forward`` does so, too."""
        super().check()
        read, state = [unravel_key(key) for key in self.critic_network.in_keys], self.tensor_keys.state
        if unravel_key(state) not in read:
            raise ValueError(
                f"HindsightLoss: the critic does not read {state!r}, but {read}; name the state's ids by"
                " loss.set_keys(state=...)"
            )

    def _default_in_keys(self) -> list[NestedKey]:
        keys = self.tensor_keys
        own = [keys.state, keys.goal, *self._action_keys(), keys.steps_to_goal, ("next", keys.state)]
        return [*own, *self.actor_network.in_keys, *self.critic_network.in_keys]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The terms of the loss, scalars, or ``(*batch,)`` with ``reduction="none"``.

        Args:
            tensordict: transitions, any batch shape. Not written.

        Raises:
            KeyError: an entry is missing.
            ValueError: goals or steps to them are not one number per row.
        """
        self.check()
        keys, actor, critic = self.tensor_keys, self.actor_network, self.critic_network
        for key in self._action_keys():
            entry(self, tensordict, key)
        state, goal = entry(self, tensordict, keys.state), entry(self, tensordict, keys.goal)
        following = entry(self, tensordict, ("next", keys.state), "collect with compact_obs=False")
        hint = "HindsightReplay.sample() writes it; give 0 where the agent did not go to the goal"
        steps = entry(self, tensordict, keys.steps_to_goal, hint)
        assert_same_shape("HindsightLoss", state=state[..., -1], goal=goal, steps_to_goal=steps)
        inputs = select_inputs(tensordict, *actor.in_keys, *critic.in_keys)
        with self._params_in_place():
            distribution, written = run_actor_critic(actor, critic, inputs)
            value = self._value(written)
            with torch.no_grad():
                after = tensordict.select(*critic.in_keys).set(keys.state, following)
                next_value = self._value(run_critic(critic, after))
        rewards = {"goal_reward": self.goal_reward, "step_reward": self.step_reward}
        with torch.no_grad():
            target = relabelled_target(next_value, following[..., -1] == goal, self.gamma, **rewards)
            walked = walked_return(steps, self.gamma, **rewards)
            counts = self._counted(tensordict, state[..., -1] != goal)
            advantage = target - value
            weight = (advantage / self.temperature).exp().clamp(max=self.max_weight)
            weight = torch.where(counts, weight, 0.0)
            counts = counts.to(value.dtype)
        out = TensorDict({}, batch_size=[])
        if self.critic_coeff is not None:
            error = expectile_loss(value, torch.maximum(target, walked), self.expectile)
            out.set("loss_hindsight_critic", self._weighted(self.critic_coeff, error, counts))
        if self.objective_coeff is not None:
            log_prob = action_log_prob(distribution, tensordict, keys.action)
            out.set("loss_hindsight_objective", self._weighted(self.objective_coeff, -log_prob, weight))
        out.set("hindsight_value", weighted_mean(1.0, value.detach(), counts))
        out.set("hindsight_advantage", weighted_mean(1.0, advantage, counts))
        self._clear_weakrefs(tensordict, out, "actor_network_params", "critic_network_params")
        return out
