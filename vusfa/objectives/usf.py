r"""The loss of universal successor features approximators, with or without a variational bottleneck."""

from __future__ import annotations

from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor

from vusfa.modules.bottleneck import gaussian_kl
from vusfa.objectives.actor_critic import ActorCriticLoss, Results
from vusfa.objectives.functional import information_bottleneck, successor_loss
from vusfa.objectives.keys import LossKeys

__all__ = ["USFLoss"]

COEFFICIENTS = ("objective_coeff", "critic_coeff", "successor_coeff", "entropy_coeff", "bottleneck_coeff")


class USFLoss(ActorCriticLoss):
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
    >>> from torchrl.objectives import ValueEstimators
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
    _schedulable_buffers = frozenset({*COEFFICIENTS, "information_target"})

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
        if bottleneck_on not in ("both", "goal", "state"):
            raise ValueError(
                f"USFLoss: bottleneck_on is {bottleneck_on!r}; give one of ('both', 'goal', 'state')"
            )
        super().__init__(
            actor_network,
            critic_network,
            reduction=reduction,
            functional=functional,
            separate_losses=separate_losses,
            distinct=distinct,
        )
        self.bottleneck_on = bottleneck_on
        device, dtype = self._default_device, torch.get_default_dtype()
        values = (objective_coeff, critic_coeff, successor_coeff, entropy_coeff, bottleneck_coeff)
        for name, value in zip(COEFFICIENTS, values, strict=True):
            self.register_coeff_buffer(name, value, device=device, dtype=dtype)
        self.register_coeff_buffer("information_target", information_target, device=device, dtype=dtype)
        # the constraint's last measurement, for DualAscent; at first on target, so that nothing moves
        self.register_buffer("last_kl", self.information_target.clone())

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

    def _terms(self) -> dict[str, bool]:
        return {
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
        tensordict, results = self._with_targets(tensordict)
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

    def _read(self) -> list[NestedKey]:
        """What the terms read of what the critic writes."""
        keys = self.tensor_keys
        names: list[NestedKey] = [keys.value]
        if self.has_successor:
            names.append(keys.successor_features)
        for loc, scale, known in self._branches():
            names += [known] if self._writes(known) else [loc, scale]
        return list(dict.fromkeys(unravel_key(key) for key in names))

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
        features = (written if results.rows is None else results.rows).get(loc).shape[-1]
        if self._writes(known):
            return written.get(known).squeeze(-1) / features
        return gaussian_kl(written.get(loc), written.get(scale)).sum(-1) / features
