r"""The loss of universal successor features approximators, with or without a variational bottleneck."""

from __future__ import annotations

from typing import Any, Literal

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
# what "auto" stands for
DEFAULTS = {"successor_coeff": 5e-4, "bottleneck_coeff": 0.0}


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
    reaches the policy and what it shares with the critic, the value's flows into successor features, reward
    weights and trunk. KL is :func:`~vusfa.modules.gaussian_kl`, averaged over the latent's features and over
    the branches of ``bottleneck_on``. For a critic that writes a value only, this is a plain advantage
    actor-critic loss.

    Where the input has no advantage, the value estimator computes all targets, from the same pass through the
    critic. Modules that actor and critic both hold run once.

    Args:
        actor_network: the policy, with ``get_dist``.
        critic_network: writes ``state_value``; for the further terms ``successor_features`` and
            ``state_embedding``, and ``goal_loc`` and ``goal_scale``, ``state_loc`` and ``state_scale``.
        objective_coeff: c_pi. As with every coefficient, ``None`` leaves the term out.
        critic_coeff: c_V.
        successor_coeff: c_psi; the paper's code has 5e-4 beside losses SUMMED over its 5 steps. ``"auto"`` is
            5e-4 if the critic writes successor features; a number requires them.
        entropy_coeff: c_H.
        bottleneck_coeff: beta, where it starts; :class:`~vusfa.objectives.DualAscent` adapts it. ``"auto"``
            is 0 if the critic writes a latent; a number requires one.
        information_target: I_c, in nats per feature of the latent.
        bottleneck_on: ``"both"``, ``"goal"`` or ``"state"``: the branches whose information counts, as far as
            the critic writes them.
        reduction: ``"mean"``, ``"sum"`` or ``"none"`` over steps.
        functional: whether the loss holds the networks' parameters as tensordicts apart from the modules.
        separate_losses: whether parameters that both networks hold are trained by the policy's loss alone.
            What only successor features and the bottleneck train must then not be shared. Needs
            ``functional=True``.
        distinct: where the networks read ids alone, run them once per distinct row
            (:func:`~vusfa.modules.unique_rows`). Equal rows then share the noise of a sampled latent; the
            loss's mean is the same. Without effect with ``separate_losses``.

    Each term is a method as well: it takes steps with their targets and returns weighted terms; ``results``
    are those of the networks on these steps, which otherwise it computes.

    Coefficients and ``information_target`` are buffers: saved in the ``state_dict``, moved by ``to``, set by
    assignment.

    Returns (of ``forward``): ``loss_objective``, ``loss_critic``, ``loss_successor``, ``loss_entropy``,
    ``loss_bottleneck``, each with its coefficient, and for logging ``entropy``, ``explained_variance``,
    ``kl`` and ``beta``.

    Raises:
        TypeError: an argument is no actor or critic, such as an agent itself.
        ValueError: an argument is out of its range; in ``forward``, the critic lacks an entry that a term
            needs (entries are renamed by ``set_keys``).

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
    >>> no = torch.zeros(2, 5, 1, dtype=torch.bool)   # two rows of five steps
    >>> following = {"observation": torch.randn(2, 5, 3), "reward": no.float(), "done": no, "terminated": no}
    >>> steps = {"observation": torch.randn(2, 5, 3), "action": torch.randint(4, (2, 5)), "next": following}
    >>> rollout = TensorDict(steps, [2, 5])
    >>> losses = loss(rollout)
    >>> sorted(losses.keys())
    ['entropy', 'explained_variance', 'loss_critic', 'loss_entropy', 'loss_objective', 'loss_successor']
    >>> sum(value for key, value in losses.items() if key.startswith("loss")).backward()
    >>> loss.entropy_coeff = 0.0
    >>> loss = loss.make_value_estimator("gae", gamma=0.99, lmbda=0.95)
    """

    _AcceptedKeys = LossKeys
    default_keys = LossKeys
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
        successor_coeff: float | Literal["auto"] | None = "auto",
        entropy_coeff: float | None = 0.01,
        bottleneck_coeff: float | Literal["auto"] | None = "auto",
        information_target: float = 0.2,
        bottleneck_on: Literal["both", "goal", "state"] = "both",
        reduction: Literal["none", "mean", "sum"] | None = "mean",
        functional: bool = True,
        separate_losses: bool = False,
        distinct: bool = False,
    ) -> None:
        if bottleneck_on not in (choices := ("both", "goal", "state")):
            raise ValueError(f"USFLoss: bottleneck_on is {bottleneck_on!r}; give one of {choices}")
        super().__init__(
            actor_network,
            critic_network,
            reduction=reduction,
            functional=functional,
            separate_losses=separate_losses,
            distinct=distinct,
        )
        self.bottleneck_on = bottleneck_on
        values = (objective_coeff, critic_coeff, successor_coeff, entropy_coeff, bottleneck_coeff)
        coefficients: dict[str, Any] = dict(zip(COEFFICIENTS, values, strict=True))
        self._optional = {name for name in DEFAULTS if coefficients[name] == "auto"}
        coefficients |= {name: DEFAULTS[name] for name in self._optional}
        self._register_coefficients(**coefficients, information_target=information_target)
        # the last KL, which DualAscent reads; at first the target itself, so that nothing moves
        self.register_buffer("last_kl", self.information_target.clone())

    @property
    def has_successor(self) -> bool:
        """Whether there is a term of the successor features."""
        read = self.tensor_keys.successor_features, self.tensor_keys.state_embedding
        return self.successor_coeff is not None and self._critic_writes(*read)

    @property
    def has_bottleneck(self) -> bool:
        """Whether there is a term of the information bottleneck."""
        return self.bottleneck_coeff is not None and len(self._branches()) > 0

    def _default_out_keys(self) -> list[NestedKey]:
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

    def check(self) -> None:
        """Raise where the critic writes no value, lacks what a coefficient given as a number needs, or writes
        a part only of what a further term needs; ``forward`` does so, too."""
        self._check_written("value")
        terms = [("successor_coeff", "successor_features", "state_embedding", self.has_successor)]
        for side in ("goal", "state") if self.bottleneck_on == "both" else (self.bottleneck_on,):
            terms.append(("bottleneck_coeff", f"{side}_loc", f"{side}_scale", self.has_bottleneck))
        for coefficient, first, second, present in terms:
            # an embedding alone is no sign of successor features
            partly = self._critic_writes(getattr(self.tensor_keys, first))
            required = not present and coefficient not in self._optional
            if getattr(self, coefficient) is not None and (partly or required):
                self._check_written(first, second, way_out=f", or leave the term out by {coefficient}=None")

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
            KeyError: an entry is missing, such as the other targets beside an advantage.
        """
        self.check()
        tensordict, results = self._with_targets(tensordict)
        out = TensorDict({}, batch_size=[])
        if self.objective_coeff is not None:
            term = self.loss_objective(tensordict, results)
            out.set("loss_objective", self._reduce_loss(term, tensordict))
        if self.has_critic:
            term, explained = self.loss_critic(tensordict, results)
            out.set("loss_critic", self._reduce_loss(term, tensordict))
            out.set("explained_variance", explained)
        if self.entropy_coeff is not None:
            term, entropy = self.loss_entropy(tensordict, results)
            out.set("entropy", self._mean(entropy, tensordict))
            out.set("loss_entropy", self._reduce_loss(term, tensordict))
        if self.has_successor:
            term = self.loss_successor(tensordict, results)
            out.set("loss_successor", self._reduce_loss(term, tensordict))
        if self.has_bottleneck:
            term, kl = self.loss_bottleneck(tensordict, results)
            out.set("loss_bottleneck", self._reduce_loss(term, tensordict))
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
        keys = self.tensor_keys
        names: list[NestedKey] = [keys.value]
        if self.has_successor:
            names.append(keys.successor_features)
        for loc, scale, known in self._branches():
            names += [known] if self._critic_writes(known) else [loc, scale]
        return list(dict.fromkeys(unravel_key(key) for key in names))

    def _branches(self) -> list[tuple[NestedKey, NestedKey, NestedKey]]:
        """Keys of mean, scale and KL of each latent whose information counts."""
        keys = self.tensor_keys
        branches = {
            "goal": (keys.goal_loc, keys.goal_scale, keys.goal_kl),
            "state": (keys.state_loc, keys.state_scale, keys.state_kl),
        }
        chosen = branches if self.bottleneck_on == "both" else [self.bottleneck_on]
        return [branches[name] for name in chosen if self._critic_writes(*branches[name][:2])]

    def _divergence(self, results: Results, branch: tuple[NestedKey, NestedKey, NestedKey]) -> Tensor:
        """KL of one latent, ``(*batch,)``, the mean over its features."""
        (loc, scale, known), written = branch, results.written
        features = (written if results.rows is None else results.rows).get(loc).shape[-1]
        if self._critic_writes(known):
            return written.get(known).squeeze(-1) / features
        return gaussian_kl(written.get(loc), written.get(scale)).sum(-1) / features
