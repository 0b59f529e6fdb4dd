"""Advantage actor-critic from one pass through two networks that may share modules; the base of USFLoss."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, NamedTuple, Self

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from torch.distributions import Distribution
from torchrl.objectives.utils import ValueEstimators, dispatch_value_estimator, distance_loss
from torchrl.objectives.value import ValueEstimatorBase

from vusfa.limits import brief
from vusfa.modules.unique import gather
from vusfa.objectives.distribution import action_entropy, action_log_prob
from vusfa.objectives.functional import explained_variance, policy_gradient_loss
from vusfa.objectives.keys import LossKeys
from vusfa.objectives.network_loss import NetworkLoss
from vusfa.objectives.networks import (
    ends_in_distribution,
    entry,
    run_actor_critic,
    run_critic,
    select_inputs,
    unique_inputs,
)
from vusfa.objectives.returns import USFEstimator

__all__ = ["ActorCriticLoss", "Results"]

# value types of TorchRL that USFEstimator computes, by the weight of the longer return
LAMBDAS: dict[ValueEstimators, float] = {
    ValueEstimators.TD0: 0.0,
    ValueEstimators.TD1: 1.0,
    ValueEstimators.TDLambda: 0.95,
    ValueEstimators.GAE: 0.95,
}


class Results(NamedTuple):
    """What one pass through both networks gives. Where they ran on distinct rows, ``rows`` is what they wrote
    there, ``which`` (\\*batch) each step's row, and ``written`` holds only what the terms read."""

    distribution: Distribution
    written: TensorDictBase
    rows: TensorDictBase | None = None
    which: Tensor | None = None


class ActorCriticLoss(NetworkLoss):
    """Base of USFLoss: one pass through actor and critic, targets, and the three terms of A2C."""

    tensor_keys: LossKeys
    default_value_estimator = ValueEstimators.TD1
    SUPPORTED_VALUE_ESTIMATORS = (*LAMBDAS, ValueEstimators.VTrace)

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        critic_network: TensorDictModule,
        *,
        distinct: bool,
        **options: Any,
    ) -> None:
        super().__init__({"actor_network": actor_network, "critic_network": critic_network}, **options)
        self.distinct = distinct and not self.separate_losses and ends_in_distribution(actor_network)
        self._set_action_keys()

    @property
    def has_critic(self) -> bool:
        """Whether there is a value term."""
        return self.critic_coeff is not None

    @property
    def has_successor(self) -> bool:
        """Whether there is a term of the successor features."""
        raise NotImplementedError

    def _default_in_keys(self) -> list[NestedKey]:
        keys, critic = self.tensor_keys, self.critic_network.in_keys
        following = [("next", key) for key in (keys.reward, keys.done, keys.terminated, *critic)]
        return [*self._action_keys(), *self.actor_network.in_keys, *critic, *following]

    def _read(self) -> list[NestedKey]:
        """Those of the critic's entries that the terms read."""
        raise NotImplementedError

    def loss_objective(self, tensordict: TensorDictBase, results: Results | None = None) -> Tensor:
        """The policy's term, ``-c_pi log pi(a) A``, ``(*batch,)``; reads action and advantage."""
        dist = (results or self._evaluate(tensordict)).distribution
        for key in self._action_keys():
            entry(self, tensordict, key)
        log_prob = action_log_prob(dist, tensordict, self.tensor_keys.action)
        advantage = self._target(tensordict, "advantage")
        if advantage.ndim > log_prob.ndim:
            advantage = advantage.squeeze(-1)
        return self.objective_coeff * policy_gradient_loss(log_prob, advantage)

    def loss_critic(
        self, tensordict: TensorDictBase, results: Results | None = None
    ) -> tuple[Tensor, Tensor]:
        """The value's term, ``c_V (G - V)^2``, ``(*batch,)``, and the variance that V explains."""
        target = self._target(tensordict, "value_target").detach()
        value = (results or self._evaluate(tensordict)).written.get(self.tensor_keys.value).to(target.dtype)
        distance = distance_loss(target, value, loss_function="l2").squeeze(-1)
        explained = explained_variance(target, value, self._valid(tensordict, target))
        return self.critic_coeff * distance, explained

    def loss_entropy(
        self, tensordict: TensorDictBase, results: Results | None = None
    ) -> tuple[Tensor, Tensor]:
        """The entropy bonus, ``-c_H H``, and the entropy H, both ``(*batch,)``."""
        entropy = action_entropy((results or self._evaluate(tensordict)).distribution)
        return -self.entropy_coeff * entropy, entropy.detach()

    def make_value_estimator(self, value_type: Any = None, **hyperparams: Any) -> Self:
        """Choose how targets are computed.

        Args:
            value_type: one of :class:`~torchrl.objectives.ValueEstimators` or its name in any case, an
                estimator, or a class of one; TD1 when ``None``. TD0, TD1, TDLambda and GAE are
                :class:`~vusfa.objectives.USFEstimator` with a ``lmbda`` of 0, 1, 0.95 and 0.95 (the latter
                two are the same, since the advantage is target minus value). VTrace is TorchRL's.
            **hyperparams: of the estimator, such as ``gamma`` and ``lmbda``.

        Returns:
            the loss itself.

        Raises:
            TypeError: no estimator, and no name of one.
            ValueError: an unknown name.
            NotImplementedError: MAGAE, since there is one agent; VTrace beside a term of the successor
                features, of which it computes no targets.
        """
        name = type(self).__name__
        value_type = self.default_value_estimator if value_type is None else value_type
        if isinstance(value_type, str):
            by_name = {member.name.lower(): member for member in ValueEstimators}
            if value_type.lower() not in by_name:
                raise ValueError(f"{name}: value_type is {value_type!r}; give one of {sorted(by_name)}")
            value_type = by_name[value_type.lower()]
        if not isinstance(value_type, ValueEstimators):
            is_class = isinstance(value_type, type) and issubclass(value_type, ValueEstimatorBase)
            if not is_class and not isinstance(value_type, ValueEstimatorBase):
                raise TypeError(
                    f"{name}: value_type is {brief(value_type)}; give a name such as 'gae', one of"
                    " torchrl.objectives.ValueEstimators, or an estimator"
                )
            super().make_value_estimator(value_type, **hyperparams)
        elif value_type in LAMBDAS:
            hyperparams = {"lmbda": LAMBDAS[value_type], "value_network": self.critic_network, **hyperparams}
            self._value_estimator = USFEstimator(**hyperparams)
            self.value_type = value_type
        elif value_type is ValueEstimators.VTrace and not self.has_successor:
            hyperparams = {"device": self._default_device, "differentiable": False, **hyperparams}
            dispatch_value_estimator(self, value_type, supported=[value_type], **hyperparams)
        else:
            supported = [supported.name for supported in LAMBDAS]
            reason = "is for several agents"
            if value_type is ValueEstimators.VTrace:
                reason = "has no targets of successor features (successor_coeff=None leaves their term out)"
            raise NotImplementedError(f"{name}: {value_type.name} {reason}; choose one of {supported}")
        self._forward_value_estimator_keys()
        return self

    def _forward_value_estimator_keys(self, **_: Any) -> None:
        estimator = self._value_estimator
        if estimator is not None:
            accepted = {field.name for field in fields(estimator._AcceptedKeys)}
            mine = {field.name: getattr(self.tensor_keys, field.name) for field in fields(self.tensor_keys)}
            estimator.set_keys(**{name: key for name, key in mine.items() if name in accepted})

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        if self._value_estimator is None and any(
            key.startswith(f"{prefix}_value_estimator.") for key in state_dict
        ):
            self.make_value_estimator()  # the loss that was saved had made its own with its first batch
        super()._load_from_state_dict(state_dict, prefix, *args)

    def _with_targets(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, Results]:
        """A shallow copy of a batch, with targets where it has no advantage, and the networks' results."""
        tensordict = tensordict.clone(False)
        results = self._evaluate(tensordict)
        if tensordict.get(self.tensor_keys.advantage, None) is None:
            params, estimator = self.critic_network_params, self.value_estimator
            # USFEstimator needs the critic at the same states
            known: dict[str, Any] = {}
            if isinstance(estimator, USFEstimator):
                known = {"written": results.written}
                if results.rows is not None:
                    known = {"written": results.rows, "index": results.which}
            estimator(tensordict, params=params, target_params=params, **known)
        return tensordict, results

    def _evaluate(self, tensordict: TensorDictBase) -> Results:
        actor, critic = self.actor_network, self.critic_network
        inputs = select_inputs(tensordict, *actor.in_keys, *critic.in_keys)
        index = None
        found = unique_inputs(inputs) if self.distinct else None
        if found is not None:
            inputs, index = found
        if self.separate_losses:
            # what both hold is a constant to the critic: its modules run again, on detached parameters
            with self._params_in_place("actor_network"):
                distribution = actor.get_dist(inputs.select(*actor.in_keys, strict=False))
            with self._params_in_place("critic_network"):
                written = run_critic(critic, inputs)
        else:
            with self._params_in_place():
                distribution, written = run_actor_critic(actor, critic, inputs, index)
        if index is not None:
            each = {key: gather(written.get(key), index) for key in self._read()}
            return Results(distribution, TensorDict(each, index.shape), written, index)
        return Results(distribution, written)

    def _target(self, tensordict: TensorDictBase, name: str) -> Tensor:
        estimator = self._value_estimator
        if name == "successor_target" and not isinstance(estimator, USFEstimator | None):
            hint = (
                f"the loss's estimator, {type(estimator).__name__}, computes none: give it a USFEstimator"
                " (loss.make_value_estimator('td1')), or leave the term out by successor_coeff=None"
            )
        else:
            hint = (
                f"where {self.tensor_keys.advantage!r} is missing all targets are computed, else none:"
                " compute them with vusfa.objectives.USFEstimator, or leave the advantage out"
            )
        target = entry(self, tensordict, getattr(self.tensor_keys, name), hint)
        valid = self._valid(tensordict, target)
        # what a mask hides may be infinite: 0 times its gradient is no 0
        return target if valid is None else torch.where(valid, target, 0.0)

    def _mean(self, values: Tensor, tensordict: TensorDictBase) -> Tensor:
        return self._reduce_loss(values.detach(), tensordict, reduction="mean")
