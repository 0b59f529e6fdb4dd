"""Advantage actor-critic from one pass through two networks that may share modules; the base of USFLoss."""

from __future__ import annotations

import contextlib
from dataclasses import fields
from typing import Any, NamedTuple, Self

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torch.distributions import Distribution
from torchrl.objectives.common import LossModule
from torchrl.objectives.utils import ValueEstimators, distance_loss

from vusfa.modules.unique import gather
from vusfa.objectives.distribution import action_entropy, action_log_prob
from vusfa.objectives.functional import explained_variance, policy_gradient_loss
from vusfa.objectives.keys import LossKeys
from vusfa.objectives.networks import (
    ends_in_distribution,
    run_actor_critic,
    run_critic,
    select_inputs,
    unique_inputs,
)
from vusfa.objectives.returns import USFEstimator

__all__ = ["ActorCriticLoss", "Results"]

# value types of TorchRL, as the weight of the longer return that each one stands for
LAMBDAS: dict[ValueEstimators, float] = {
    ValueEstimators.TD0: 0.0,
    ValueEstimators.TD1: 1.0,
    ValueEstimators.TDLambda: 0.95,
    ValueEstimators.GAE: 0.95,
}


class Results(NamedTuple):
    """What one pass through both networks gave.

    Where the networks ran on distinct rows, ``rows`` is what they wrote there and ``which`` (\\*batch) tells
    each step's row; ``written`` then holds what the terms read.
    """

    distribution: Distribution
    written: TensorDictBase
    rows: TensorDictBase | None = None
    which: Tensor | None = None


class ActorCriticLoss(LossModule):
    """Holds an actor and a critic, runs both once, computes targets, and has the three terms of A2C.

    Args: as those of :class:`~vusfa.objectives.USFLoss`, which registers the coefficients.
    """

    tensor_keys: LossKeys
    default_value_estimator = ValueEstimators.TD1
    SUPPORTED_VALUE_ESTIMATORS = tuple(LAMBDAS)

    actor_network: TensorDictModule
    critic_network: TensorDictModule
    actor_network_params: TensorDictParams | None
    critic_network_params: TensorDictParams | None
    target_actor_network_params: TensorDictParams | None
    target_critic_network_params: TensorDictParams | None

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        critic_network: TensorDictModule,
        *,
        reduction: str | None,
        functional: bool,
        separate_losses: bool,
        distinct: bool,
    ) -> None:
        reduction = reduction or "mean"
        name = type(self).__name__
        if reduction not in ("none", "mean", "sum"):
            raise ValueError(f"{name}: reduction is {reduction!r}; give one of ('none', 'mean', 'sum')")
        if separate_losses and not functional:
            raise ValueError(f"{name}: separate_losses=True needs functional=True")
        self._functional = functional
        self._in_keys: list[NestedKey] | None = None
        self._out_keys: list[NestedKey] | None = None
        super().__init__()
        if functional:
            self.convert_to_functional(actor_network, "actor_network")
            policy_params = list(actor_network.parameters()) if separate_losses else None
            self.convert_to_functional(critic_network, "critic_network", compare_against=policy_params)
        else:
            self.actor_network = actor_network
            self.critic_network = critic_network
            self.actor_network_params = None
            self.critic_network_params = None
            self.target_actor_network_params = None
            self.target_critic_network_params = None
        self.separate_losses = separate_losses
        self.distinct = distinct and not separate_losses and ends_in_distribution(actor_network)
        self.reduction = reduction
        actions, log_probs = self.actor_network.dist_sample_keys, self.actor_network.log_prob_keys
        self.set_keys(
            action=actions if len(actions) > 1 else actions[0],
            sample_log_prob=log_probs if len(log_probs) > 1 else log_probs[0],
        )

    @property
    def functional(self) -> bool:
        """Whether parameters are held apart from the modules."""
        return self._functional

    @property
    def has_critic(self) -> bool:
        """Whether there is a value term."""
        return self.critic_coeff is not None

    @property
    def in_keys(self) -> list[NestedKey]:
        """Everything that ``forward`` may read."""
        if self._in_keys is not None:
            return self._in_keys
        keys = self.tensor_keys
        networks = [*self.actor_network.in_keys, *self.critic_network.in_keys]
        actions = keys.action if isinstance(keys.action, list) else [keys.action]
        following = [keys.reward, keys.done, keys.terminated, *self.critic_network.in_keys]
        everything = [*actions, *networks, *(("next", key) for key in following)]
        return list(dict.fromkeys(unravel_key(key) for key in everything))

    @in_keys.setter
    def in_keys(self, value: list[NestedKey] | None) -> None:
        self._in_keys = value

    @property
    def out_keys(self) -> list[NestedKey]:
        """What ``forward`` returns, in this order when called without a tensordict."""
        if self._out_keys is not None:
            return self._out_keys
        return [key for key, is_present in self._terms().items() if is_present]

    @out_keys.setter
    def out_keys(self, value: list[NestedKey] | None) -> None:
        self._out_keys = value

    def _terms(self) -> dict[str, bool]:
        """Everything that ``forward`` may return, and whether it does."""
        raise NotImplementedError

    def _read(self) -> list[NestedKey]:
        """What the terms read of what the critic writes."""
        raise NotImplementedError

    def loss_objective(self, tensordict: TensorDictBase, results: Results | None = None) -> Tensor:
        """The policy's term, ``-c_pi log pi(a) A``, ``(*batch,)``; reads action and advantage."""
        dist = (results or self._evaluate(tensordict)).distribution
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
        return self.critic_coeff * distance, explained_variance(
            target, value, self._valid(tensordict, target)
        )

    def loss_entropy(
        self, tensordict: TensorDictBase, results: Results | None = None
    ) -> tuple[Tensor, Tensor]:
        """The entropy bonus, ``-c_H H``, and the entropy H, both ``(*batch,)``."""
        entropy = action_entropy((results or self._evaluate(tensordict)).distribution)
        return -self.entropy_coeff * entropy, entropy.detach()

    def make_value_estimator(self, value_type: Any = None, **hyperparams: Any) -> Self:
        """Choose how targets are computed.

        Args:
            value_type: TD0, TD1, TDLambda or GAE of :class:`~torchrl.objectives.ValueEstimators`, which stand
                for a ``lmbda`` of 0, 1, 0.95 and 0.95 (TDLambda and GAE are the same here: the advantage is
                target minus value); an estimator, or a class of one. TD1 when ``None``.
            **hyperparams: of :class:`~vusfa.objectives.USFEstimator`, such as ``gamma`` and ``lmbda``, or of
                the class given.

        Returns:
            the loss itself.

        Raises:
            NotImplementedError: for another value type.
        """
        value_type = self.default_value_estimator if value_type is None else value_type
        if isinstance(value_type, ValueEstimators):
            if value_type not in LAMBDAS:
                supported = [supported.name for supported in LAMBDAS]
                raise NotImplementedError(
                    f"{type(self).__name__} computes no {value_type.name} targets; choose one of {supported}"
                )
            hyperparams = {"lmbda": LAMBDAS[value_type], "value_network": self.critic_network, **hyperparams}
            self._value_estimator = USFEstimator(**hyperparams)
            self.value_type = value_type
        else:
            super().make_value_estimator(value_type, **hyperparams)
        self._forward_value_estimator_keys()
        return self

    def _forward_value_estimator_keys(self, **_: Any) -> None:
        estimator = self._value_estimator
        if estimator is not None:
            accepted = {field.name for field in fields(estimator._AcceptedKeys)}
            mine = {field.name: getattr(self.tensor_keys, field.name) for field in fields(self.tensor_keys)}
            estimator.set_keys(**{name: key for name, key in mine.items() if name in accepted})

    def _with_targets(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, Results]:
        """A shallow copy of a batch, with targets where it has no advantage, and the networks' results."""
        tensordict = tensordict.clone(False)
        results = self._evaluate(tensordict)
        if tensordict.get(self.tensor_keys.advantage, None) is None:
            params, estimator = self.critic_network_params, self.value_estimator
            # the estimator needs the critic at the same states
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
            with self._params_of("actor_network"):
                distribution = actor.get_dist(inputs.select(*actor.in_keys, strict=False))
            with self._params_of("critic_network"):
                written = run_critic(critic, inputs)
        else:
            with self._params_of("actor_network"), self._params_of("critic_network"):
                distribution, written = run_actor_critic(actor, critic, inputs, index)
        if index is not None:
            each = {key: gather(written.get(key), index) for key in self._read()}
            return Results(distribution, TensorDict(each, index.shape), written, index)
        return Results(distribution, written)

    def _params_of(self, name: str) -> contextlib.AbstractContextManager:
        if not self.functional:
            return contextlib.nullcontext()
        return getattr(self, name + "_params").to_module(getattr(self, name), preserve_module_state=False)

    def _writes(self, *keys: NestedKey) -> bool:
        written = {unravel_key(key) for key in self.critic_network.out_keys}
        return all(unravel_key(key) in written for key in keys)

    def _target(self, tensordict: TensorDictBase, name: str) -> Tensor:
        key = getattr(self.tensor_keys, name)
        target = tensordict.get(key, None)
        if target is None:
            raise KeyError(
                f"the input has no {key!r}. All targets are computed where the advantage "
                f"({self.tensor_keys.advantage!r}) is absent; else, compute them with loss.value_estimator"
            )
        return target

    def _set_term(self, out: TensorDict, name: str, term: Tensor, tensordict: TensorDictBase) -> None:
        out.set(name, self._reduce_loss(term, tensordict))

    def _mean(self, values: Tensor, tensordict: TensorDictBase) -> Tensor:
        return self._reduce_loss(values.detach(), tensordict, reduction="mean")

    def _valid(self, tensordict: TensorDictBase, like: Tensor) -> Tensor | None:
        masks = [tensordict.get(key, None) for key in self._loss_mask_keys()]
        expanded = [self._expand_loss_mask(mask, like) for mask in masks if mask is not None]
        return torch.stack(expanded).all(0) if expanded else None
