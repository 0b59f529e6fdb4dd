r"""The loss of universal successor features approximators, with or without a variational bottleneck."""

from __future__ import annotations

import contextlib
from dataclasses import fields
from typing import Any, Literal, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    dispatch,
)
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torch.distributions import Distribution
from torchrl.objectives.common import LossModule
from torchrl.objectives.utils import ValueEstimators, distance_loss

from vusfa.modules.bottleneck import gaussian_kl
from vusfa.modules.unique import gather
from vusfa.objectives.distribution import action_entropy, action_log_prob
from vusfa.objectives.functional import (
    explained_variance,
    information_bottleneck,
    policy_gradient_loss,
    successor_loss,
)
from vusfa.objectives.keys import LossKeys
from vusfa.objectives.networks import (
    ends_in_distribution,
    run_actor_critic,
    run_critic,
    select_inputs,
    unique_inputs,
)
from vusfa.objectives.returns import USFEstimator

__all__ = ["USFLoss"]

# value types of TorchRL, as the weight of the longer return that each one stands for
LAMBDAS: dict[ValueEstimators, float] = {
    ValueEstimators.TD0: 0.0,
    ValueEstimators.TD1: 1.0,
    ValueEstimators.TDLambda: 0.95,
    ValueEstimators.GAE: 0.95,
}
COEFFICIENTS = ("objective_coeff", "critic_coeff", "successor_coeff", "entropy_coeff", "bottleneck_coeff")


class Results(NamedTuple):
    """What one pass through both networks gave.

    ``latent_size`` is the number of features of the latent whose divergence ``written`` tells without it.
    Where the networks ran on distinct rows, ``rows`` is what they wrote there and ``which`` (\\*batch) tells
    each step's row; ``written`` then holds what the terms read.
    """

    distribution: Distribution
    written: TensorDictBase
    latent_size: int = 0
    rows: TensorDictBase | None = None
    which: Tensor | None = None


class USFLoss(LossModule):
    r"""Advantage actor-critic with successor features and an information bottleneck.

    VUSFA: Variational Universal Successor Features Approximator (https://arxiv.org/abs/1908.06376), Algorithm
    1. Per step,

    .. math::
        -c_\pi \log \pi(a|s, g) A
        + c_V (G - V(s, g))^2
        + c_\psi \tfrac1E \lVert \Psi - \psi(s, g) \rVert^2
        - c_H H[\pi]
        + \beta (KL - I_c)

    with the targets of :class:`~vusfa.objectives.USFEstimator`, which are constants: the policy's gradient
    enters nothing but the policy (and whatever of the critic's modules the actor holds), the value's flows
    into successor features, reward weights and trunk. KL is :func:`~vusfa.modules.gaussian_kl`,
    averaged over the latent's features and over the branches named by ``bottleneck_on``. A term whose
    coefficient is ``None``, or whose entries the critic does not write, is left out; so this is a plain
    advantage actor-critic loss for a critic that writes a value only.

    If the input has no advantage, the estimator computes it, from the same pass through the critic. Modules
    that actor and critic both hold run once.

    Args:
        actor_network: the policy, with ``get_dist``.
        critic_network: writes ``state_value`` and, if it has them, ``successor_features`` and
            ``state_embedding``, and ``goal_loc`` and ``goal_scale``, ``state_loc`` and ``state_scale``.
        objective_coeff: c_pi.
        critic_coeff: c_V.
        successor_coeff: c_psi; the paper's code has 5e-4 beside losses SUMMED over its 5 steps.
        entropy_coeff: c_H.
        bottleneck_coeff: beta, where it starts; :class:`~vusfa.objectives.DualAscent` adapts it.
        information_target: I_c, in nats per feature of the latent.
        bottleneck_on: ``"both"``, ``"goal"`` or ``"state"``: the branches whose information counts, as far as
            the critic writes them.
        reduction: ``"mean"``, ``"sum"`` or ``"none"`` over steps.
        functional: whether the networks' parameters are held as tensordicts apart from the modules.
        separate_losses: whether parameters that both networks hold are trained by the policy's loss alone.
            What only successor features and the bottleneck train must then not be shared. Needs
            ``functional=True``.
        distinct: where the networks read ids alone, rows that read the same go through them once
            (:func:`~vusfa.modules.unique_rows`). Equal rows then share the noise of a latent
            that is sampled: the mean of the loss is the same. Without effect with ``separate_losses``.

    Each term is a method as well. It takes steps with their targets and returns their weighted terms;
    ``results`` are those of the networks on these steps, which it runs when there are none.

    Coefficients and ``information_target`` are buffers: saved in the ``state_dict``, moved by ``to``, set by
    assignment.

    Returns (of ``forward``): ``loss_objective``, ``loss_critic``, ``loss_successor``, ``loss_entropy``,
    ``loss_bottleneck``, each with its coefficient, and for the eye ``entropy``, ``explained_variance``,
    ``kl`` and ``beta``.

    >>> from tensordict.nn import TensorDictModule as Mod, TensorDictSequential as Seq
    >>> from torchrl.modules import ProbabilisticActor
    >>> _ = torch.manual_seed(0)
    >>> trunk = Mod(torch.nn.Linear(3, 8), in_keys=["observation"], out_keys=["state_embedding"])
    >>> psi = Mod(torch.nn.Linear(8, 8), in_keys=["state_embedding"], out_keys=["successor_features"])
    >>> value = Mod(torch.nn.Linear(8, 1), in_keys=["successor_features"], out_keys=["state_value"])
    >>> policy = Mod(torch.nn.Linear(8, 4), in_keys=["state_embedding"], out_keys=["logits"])
    >>> actor = ProbabilisticActor(
    ...     Seq(trunk, policy), in_keys=["logits"], distribution_class=torch.distributions.Categorical
    ... )
    >>> loss = USFLoss(actor, Seq(trunk, psi, value))
    >>> batch = [2, 5]   # two rows of five steps
    >>> rollout = TensorDict({
    ...     "observation": torch.randn(*batch, 3),
    ...     "action": torch.randint(4, batch),
    ...     "next": {
    ...         "observation": torch.randn(*batch, 3),
    ...         "reward": torch.randn(*batch, 1),
    ...         "done": torch.zeros(*batch, 1, dtype=torch.bool),
    ...         "terminated": torch.zeros(*batch, 1, dtype=torch.bool),
    ...     },
    ... }, batch)
    >>> losses = loss(rollout)
    >>> sorted(losses.keys())
    ['entropy', 'explained_variance', 'loss_critic', 'loss_entropy', 'loss_objective', 'loss_successor']
    >>> sum(value for key, value in losses.items() if key.startswith("loss")).backward()
    >>> loss.entropy_coeff = 0.0
    >>> loss = loss.make_value_estimator(ValueEstimators.GAE, gamma=0.99, lmbda=0.95)
    """

    _AcceptedKeys = LossKeys
    default_keys = LossKeys
    tensor_keys: LossKeys
    default_value_estimator = ValueEstimators.TD1
    SUPPORTED_VALUE_ESTIMATORS = tuple(LAMBDAS)
    _schedulable_buffers = frozenset({*COEFFICIENTS, "information_target"})

    actor_network: TensorDictModule
    critic_network: TensorDictModule
    actor_network_params: TensorDictParams | None
    critic_network_params: TensorDictParams | None
    target_actor_network_params: TensorDictParams | None
    target_critic_network_params: TensorDictParams | None
    information_target: Tensor
    last_kl: Tensor

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        critic_network: TensorDictModule,
        *,
        objective_coeff: float | None = 1.0,
        critic_coeff: float | None = 0.5,
        successor_coeff: float | None = 5e-4,
        entropy_coeff: float | None = 0.01,
        bottleneck_coeff: float | None = 0.0,
        information_target: float = 0.2,
        bottleneck_on: Literal["both", "goal", "state"] = "both",
        reduction: Literal["none", "mean", "sum"] | None = "mean",
        functional: bool = True,
        separate_losses: bool = False,
        distinct: bool = False,
    ) -> None:
        reduction = reduction or "mean"
        _check_choice("bottleneck_on", bottleneck_on, ("both", "goal", "state"))
        _check_choice("reduction", reduction, ("none", "mean", "sum"))
        if separate_losses and not functional:
            raise ValueError("USFLoss: separate_losses=True needs functional=True")
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
        self.bottleneck_on = bottleneck_on
        self.reduction = reduction
        device, dtype = self._default_device, torch.get_default_dtype()
        values = (objective_coeff, critic_coeff, successor_coeff, entropy_coeff, bottleneck_coeff)
        for name, value in zip(COEFFICIENTS, values, strict=True):
            self.register_coeff_buffer(name, value, device=device, dtype=dtype)
        self.register_coeff_buffer("information_target", information_target, device=device, dtype=dtype)
        # the constraint's last measurement, for DualAscent; at first on target, so that nothing moves
        self.register_buffer("last_kl", self.information_target.clone())
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
    def has_successor(self) -> bool:
        """Whether there is a term of the successor features."""
        keys = self.tensor_keys
        return self.successor_coeff is not None and self._writes(
            keys.successor_features, keys.state_embedding
        )

    @property
    def has_bottleneck(self) -> bool:
        """Whether there is a term of the information bottleneck."""
        return self.bottleneck_coeff is not None and len(self._branches()) > 0

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
        present = {
            "loss_objective": self.objective_coeff is not None,
            "loss_critic": self.has_critic,
            "loss_entropy": self.entropy_coeff is not None,
            "loss_successor": self.has_successor,
            "loss_bottleneck": self.has_bottleneck,
            "entropy": self.entropy_coeff is not None,
            "explained_variance": self.has_critic,
            "kl": self.has_bottleneck,
            "beta": self.has_bottleneck,
        }
        return [key for key, is_present in present.items() if is_present]

    @out_keys.setter
    def out_keys(self, value: list[NestedKey] | None) -> None:
        self._out_keys = value

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The terms of the loss.

        Args:
            tensordict: a rollout ``(*batch, T)``, or any batch of steps that already has its targets. Not
                written.

        Returns:
            a tensordict without batch dimensions; terms are scalars, or ``(*batch, T)`` with
            ``reduction="none"``.

        Raises:
            KeyError: when there is an advantage but not the other targets that the terms need.
        """
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
        out = TensorDict({}, batch_size=[])
        if self.objective_coeff is not None:
            self._set_term(out, "loss_objective", self.loss_objective(tensordict, results), tensordict)
        if self.has_critic:
            term, explained = self.loss_critic(tensordict, results)
            self._set_term(out, "loss_critic", term, tensordict)
            out.set("explained_variance", explained)
        if self.entropy_coeff is not None:
            term, entropy = self.loss_entropy(tensordict, results)
            out.set("entropy", self._mean(entropy, tensordict))
            self._set_term(out, "loss_entropy", term, tensordict)
        if self.has_successor:
            self._set_term(out, "loss_successor", self.loss_successor(tensordict, results), tensordict)
        if self.has_bottleneck:
            term, kl = self.loss_bottleneck(tensordict, results)
            self._set_term(out, "loss_bottleneck", term, tensordict)
            out.set("kl", self._mean(kl, tensordict))
            out.set("beta", self.bottleneck_coeff.detach().clone())
            self.last_kl.copy_(out.get("kl"))
        self._clear_weakrefs(tensordict, out, "actor_network_params", "critic_network_params")
        return out

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

    def loss_successor(self, tensordict: TensorDictBase, results: Results | None = None) -> Tensor:
        """The successor features' term, ``c_psi`` times the mean over features of (target - psi)^2."""
        target = self._target(tensordict, "successor_target")
        written = (results or self._evaluate(tensordict)).written
        successor = written.get(self.tensor_keys.successor_features).to(target.dtype)
        return self.successor_coeff * successor_loss(successor, target)

    def loss_bottleneck(
        self, tensordict: TensorDictBase, results: Results | None = None
    ) -> tuple[Tensor, Tensor]:
        """The information constraint's term, ``beta (KL - I_c)``, and KL, both ``(*batch,)``."""
        results = results or self._evaluate(tensordict)
        kl = torch.stack([self._divergence(results, branch) for branch in self._branches()]).mean(0)
        # a copy: the multiplier may move before this graph is differentiated
        beta = self.bottleneck_coeff.detach().clone()
        return information_bottleneck(kl, beta, self.information_target), kl.detach()

    def make_value_estimator(self, value_type: Any = None, **hyperparams: Any) -> USFLoss:
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
                    f"USFLoss computes no {value_type.name} targets; choose one of {supported}"
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
            sizes = [written.get(loc).shape[-1] for loc, *_ in self._branches()]
            latent_size = sizes[0] if sizes else 0
            return Results(distribution, TensorDict(each, index.shape), latent_size, written, index)
        return Results(distribution, written)

    def _read(self) -> list[NestedKey]:
        """What the terms read of what the critic writes."""
        keys = self.tensor_keys
        names: list[NestedKey] = [keys.value]
        if self.has_successor:
            names.append(keys.successor_features)
        for loc, scale, known in self._branches():
            names += [known] if self._writes(known) else [loc, scale]
        return list(dict.fromkeys(unravel_key(key) for key in names))

    def _params_of(self, name: str) -> contextlib.AbstractContextManager:
        if not self.functional:
            return contextlib.nullcontext()
        return getattr(self, name + "_params").to_module(getattr(self, name), preserve_module_state=False)

    def _writes(self, *keys: NestedKey) -> bool:
        written = {unravel_key(key) for key in self.critic_network.out_keys}
        return all(unravel_key(key) in written for key in keys)

    def _branches(self) -> list[tuple[NestedKey, NestedKey, NestedKey]]:
        """Keys of mean, scale and divergence of the latents whose information counts."""
        keys = self.tensor_keys
        branches = {
            "goal": (keys.goal_loc, keys.goal_scale, keys.goal_kl),
            "state": (keys.state_loc, keys.state_scale, keys.state_kl),
        }
        chosen = branches if self.bottleneck_on == "both" else [self.bottleneck_on]
        return [branches[name] for name in chosen if self._writes(*branches[name][:2])]

    def _divergence(self, results: Results, branch: tuple[NestedKey, NestedKey, NestedKey]) -> Tensor:
        """KL of one latent, ``(*batch,)``, the mean over its features."""
        (loc, scale, known), written = branch, results.written
        features = results.latent_size or written.get(loc).shape[-1]
        if self._writes(known):
            return written.get(known).squeeze(-1) / features
        return gaussian_kl(written.get(loc), written.get(scale)).sum(-1) / features

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


def _check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise ValueError(f"USFLoss: {name} is {value!r}; give one of {choices}")
