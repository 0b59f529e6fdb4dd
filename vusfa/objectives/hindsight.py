r"""Learning off-policy from an agent's own walks, towards goals that it names in hindsight.

A transition that the agent has made says something about every goal g, not only about the one it walked to:
whether it arrived at g, and, through V(s', g), how far g still is. What it earned is known without asking the
environment, because every step costs the same: ``goal_reward`` for the step that arrives, ``step_reward`` for
any other. So V = psi . omega is learned for all goals that the agent can name (Andrychowicz et al., 2017,
https://arxiv.org/abs/1707.01495), by an expectile, which leans towards the better of the actions in the data
(Kostrikov et al., 2021, https://arxiv.org/abs/2110.06169), and the policy imitates the actions that turned
out well, weighted by their advantage (Peng et al., 2019, https://arxiv.org/abs/1910.00177).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import LossModule

from vusfa.objectives.distribution import action_log_prob
from vusfa.objectives.networks import run_actor_critic, run_critic, select_inputs

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
        goal_reward, step_reward: what the environment gives.

    >>> relabelled_target(torch.tensor([0.5, 0.5, 3.0]), torch.tensor([False, True, False]), gamma=0.9)
    tensor([0.4400, 1.0000, 0.8900])
    """
    return torch.where(arrived, goal_reward, step_reward + gamma * next_value.clamp(max=goal_reward))


def walked_return(
    steps: Tensor, gamma: float, goal_reward: float = 1.0, step_reward: float = -0.01
) -> Tensor:
    r"""What the agent's own way to g earned, a lower bound of the best: it took ``steps`` steps.

    .. math::
        \gamma^{k-1} r_g + r \, \frac{1 - \gamma^{k-1}}{1 - \gamma}

    Args:
        steps: k, int64, any shape; 0 where the agent did not go there: minus infinity.
        gamma: discount per step, below 1.
        goal_reward, step_reward: what the environment gives.

    >>> walked_return(torch.tensor([1, 2, 3, 0]), gamma=0.9)
    tensor([1.0000, 0.8900, 0.7910,   -inf])
    """
    power = gamma ** (steps - 1).clamp(min=0).float()
    value = power * goal_reward + step_reward * (1 - power) / (1 - gamma)
    return torch.where(steps > 0, value, -torch.inf)


def expectile_loss(value: Tensor, target: Tensor, expectile: float) -> Tensor:
    r"""Squared error, weighted by ``expectile`` where the value is too low and by one minus it where not.

    Twice the usual half, so that an expectile of 0.5 is the square:
    ``2 |tau - 1[target < V]| (target - V)^2``.

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
    """Entries of :class:`HindsightLoss`.

    Attributes:
        state: ids of the last frames, ``(*batch, H)``, now and under ``"next"``.
        goal: the goal's id, ``(*batch,)``.
        action: what was done.
        steps_to_goal: steps that the agent's own way from here to the goal took, ``(*batch,)``; 0: it did not
            go there.
        value: V, which the critic writes.

    >>> HindsightKeys(value="v").value
    'v'
    """

    state: NestedKey = "state_id"
    goal: NestedKey = "goal_id"
    action: NestedKey = "action"
    steps_to_goal: NestedKey = "steps_to_goal"
    value: NestedKey = "state_value"


class HindsightLoss(LossModule):
    r"""Value and policy for goals named in hindsight, from single transitions of any policy.

    .. math::
        c_V \, L_\tau\big(V(s, g), \max(y, R)\big)
        - c_\pi \frac{\sum w \log \pi(a|s, g)}{\sum w},
        \qquad w = \min\big(e^{(y - V(s, g)) / T}, w_{max}\big)

    y is :func:`relabelled_target`, R :func:`walked_return`, L :func:`expectile_loss`; targets and weights are
    constants. Rows that stand on their goal already count for nothing. Modules that actor and critic both
    hold run once. There is no importance weight: the expectile and the advantage pick among the data's
    actions, whoever chose them.

    Args:
        actor_network: the policy, with ``get_dist``.
        critic_network: writes ``state_value``; of its inputs the state differs in the next step, no other.
        critic_coeff: c_V.
        objective_coeff: c_pi.
        gamma: discount per step, in (0, 1).
        expectile: tau.
        temperature: T, in units of value.
        max_weight: w_max.
        goal_reward, step_reward: what the environment gives.

    Returns (of ``forward``): ``loss_hindsight_critic`` and ``loss_hindsight_objective``, each with its
    coefficient, and for the eye ``hindsight_value`` and ``hindsight_advantage``, means.

    >>> from vusfa.modules import make_agent
    >>> from vusfa.scenes import SceneSet
    >>> scenes = SceneSet.bundled(["bathroom"])
    >>> agent = make_agent("usfa", scenes=scenes, history=1, hidden_size=8, embedding_size=8)
    >>> loss = HindsightLoss(agent.get_policy_operator(), agent.get_value_operator())
    >>> state = torch.randint(scenes.num_states, (5, 1))
    >>> steps = TensorDict({
    ...     "state_id": state, "goal_id": torch.randint(scenes.num_states, (5,)),
    ...     "scene_id": torch.zeros(5, dtype=torch.int64), "action": torch.randint(4, (5,)),
    ...     "steps_to_goal": torch.zeros(5, dtype=torch.int64),
    ...     "next": {"state_id": (state + 1) % scenes.num_states},
    ... }, [5])
    >>> sorted(loss(steps).keys())
    ['hindsight_advantage', 'hindsight_value', 'loss_hindsight_critic', 'loss_hindsight_objective']
    """

    _AcceptedKeys = HindsightKeys
    default_keys = HindsightKeys
    tensor_keys: HindsightKeys
    out_keys = (
        "loss_hindsight_critic",
        "loss_hindsight_objective",
        "hindsight_value",
        "hindsight_advantage",
    )

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        critic_network: TensorDictModuleBase,
        *,
        critic_coeff: float = 100.0,
        objective_coeff: float = 1.0,
        gamma: float = 0.95,
        expectile: float = 0.7,
        temperature: float = 0.02,
        max_weight: float = 10.0,
        goal_reward: float = 1.0,
        step_reward: float = -0.01,
    ) -> None:
        for name, value in (("gamma", gamma), ("expectile", expectile)):
            if not 0 < value < 1:
                raise ValueError(f"HindsightLoss: {name} is {value}; give a number between 0 and 1")
        for name, value in (("temperature", temperature), ("max_weight", max_weight)):
            if value <= 0:
                raise ValueError(f"HindsightLoss: {name} is {value}; give a number above 0")
        super().__init__()
        self.actor_network, self.critic_network = actor_network, critic_network
        self.actor_network_params = self.critic_network_params = None
        self.target_actor_network_params = self.target_critic_network_params = None
        self.critic_coeff, self.objective_coeff = critic_coeff, objective_coeff
        self.gamma, self.expectile = gamma, expectile
        self.temperature, self.max_weight = temperature, max_weight
        self.goal_reward, self.step_reward = goal_reward, step_reward

    @property
    def in_keys(self) -> list[NestedKey]:
        """Everything that ``forward`` reads."""
        keys = self.tensor_keys
        networks = [*self.actor_network.in_keys, *self.critic_network.in_keys]
        own = [keys.state, keys.goal, keys.action, keys.steps_to_goal, ("next", keys.state)]
        return list(dict.fromkeys([*own, *networks]))

    def _forward_value_estimator_keys(self, **_: Any) -> None:
        """There is no estimator."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The terms of the loss.

        Args:
            tensordict: transitions, any batch shape. Not written.

        Returns:
            scalars, see the class.
        """
        keys = self.tensor_keys
        actor, critic = self.actor_network, self.critic_network
        inputs = select_inputs(tensordict, *actor.in_keys, *critic.in_keys)
        distribution, written = run_actor_critic(actor, critic, inputs)
        value = self._value(written)
        following, goal = tensordict.get(("next", keys.state)), tensordict.get(keys.goal)
        with torch.no_grad():
            after = tensordict.select(*critic.in_keys).set(keys.state, following)
            next_value = self._value(run_critic(critic, after))
            rewards = {"goal_reward": self.goal_reward, "step_reward": self.step_reward}
            target = relabelled_target(next_value, following[..., -1] == goal, self.gamma, **rewards)
            walked = walked_return(tensordict.get(keys.steps_to_goal), self.gamma, **rewards)
            counts = (tensordict.get(keys.state)[..., -1] != goal).float()
            advantage = target - value
            weight = counts * (advantage / self.temperature).exp().clamp(max=self.max_weight)
        number = counts.sum().clamp(min=1)
        errors = counts * expectile_loss(value, torch.maximum(target, walked), self.expectile)
        log_prob = action_log_prob(distribution, tensordict, keys.action)
        return TensorDict(
            {
                "loss_hindsight_critic": self.critic_coeff * errors.sum() / number,
                "loss_hindsight_objective": -self.objective_coeff
                * (weight * log_prob).sum()
                / weight.sum().clamp(min=torch.finfo(weight.dtype).tiny),
                "hindsight_value": (counts * value.detach()).sum() / number,
                "hindsight_advantage": (counts * advantage).sum() / number,
            },
            batch_size=[],
        )

    def _value(self, written: TensorDictBase) -> Tensor:
        """V, (*batch,), float32."""
        return written.get(self.tensor_keys.value).squeeze(-1).float()
