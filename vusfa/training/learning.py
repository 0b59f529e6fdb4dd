"""From settings to the parts that learn: loss, estimator, multiplier, optimiser, learning rate."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.objectives import A2CLoss, LossModule

from vusfa.errors import ConfigError
from vusfa.objectives import DualAscent, TFRMSprop, USFEstimator, USFLoss

__all__ = [
    "OPTIMISERS",
    "annealed",
    "descend",
    "loss_state",
    "make_loss",
    "make_optimiser",
    "total_loss",
]

OPTIMISERS = ("adam", "rmsprop", "tf_rmsprop")


def make_loss(
    actor: ProbabilisticTensorDictSequential,
    critic: TensorDictModuleBase,
    *,
    objective_coeff: float,
    critic_coeff: float,
    entropy_coeff: float,
    successor_coeff: float,
    bottleneck_coeff: float,
    bottleneck_step_size: float,
    bottleneck_maximum: float | None = None,
    information_target: float = 0.2,
    bottleneck_on: str = "both",
    information_reduction: str = "mean",
    loss_critic_type: str = "l2",
    gamma: float = 0.99,
    lmbda: float = 1.0,
    n_steps: int | None = None,
    normalize_advantage: bool = False,
    min_advantage_std: float = 1e-4,
    bootstrap_at_timeout: bool = True,
    embedding_at: str = "next",
) -> tuple[LossModule, USFEstimator, DualAscent | None]:
    """The loss that fits the critic, the estimator of its targets, which the loss calls where a batch has
    none, and the multiplier's ascent where there is one.

    A critic with successor features gets :class:`~vusfa.objectives.USFLoss`; a plain one, as GVF's, gets
    TorchRL's :class:`~torchrl.objectives.A2CLoss` with the same coefficients and the same targets.

    Args:
        actor, critic: of one agent.
        objective_coeff, critic_coeff, entropy_coeff, successor_coeff, bottleneck_coeff, information_target,
            bottleneck_on, information_reduction, loss_critic_type: of :class:`~vusfa.objectives.USFLoss`.
        bottleneck_step_size, bottleneck_maximum: of :class:`~vusfa.objectives.DualAscent`.
        gamma, lmbda, n_steps, normalize_advantage, min_advantage_std, bootstrap_at_timeout, embedding_at: of
            :class:`~vusfa.objectives.USFEstimator`.
    """
    try:
        estimator = USFEstimator(
            value_network=critic,
            gamma=gamma,
            lmbda=lmbda,
            n_steps=n_steps,
            normalize_advantage=normalize_advantage,
            min_advantage_std=min_advantage_std,
            bootstrap_at_timeout=bootstrap_at_timeout,
            embedding_at=embedding_at,
        )
        if "successor_features" not in critic.out_keys:
            plain = A2CLoss(
                actor,
                critic,
                entropy_coeff=entropy_coeff,
                critic_coeff=critic_coeff,
                loss_critic_type=loss_critic_type,
            )
            plain.register_buffer("objective_coeff", torch.tensor(float(objective_coeff)))
            plain.make_value_estimator(estimator)
            return plain, estimator, None
        loss = USFLoss(
            actor,
            critic,
            objective_coeff=objective_coeff,
            critic_coeff=critic_coeff,
            entropy_coeff=entropy_coeff,
            successor_coeff=successor_coeff,
            bottleneck_coeff=bottleneck_coeff,
            information_target=information_target,
            bottleneck_on=bottleneck_on,  # type: ignore[arg-type]
            information_reduction=information_reduction,  # type: ignore[arg-type]
            loss_critic_type=loss_critic_type,  # type: ignore[arg-type]
            distinct=True,
        )
        loss.make_value_estimator(estimator)
        ascent = DualAscent(loss, bottleneck_step_size, bottleneck_maximum) if loss.has_bottleneck else None
        return loss, estimator, ascent
    except ValueError as error:
        raise ConfigError(f"objective: {error}") from error


def total_loss(loss: LossModule, terms: TensorDictBase) -> Tensor:
    """The sum of the terms, each with its coefficient. A2CLoss has none for the policy's term; it gets its
    here."""
    scale = loss.objective_coeff if isinstance(loss, A2CLoss) else 1.0
    parts = (scale * v if k == "loss_objective" else v for k, v in terms.items() if k.startswith("loss_"))
    return torch.stack(list(parts)).sum()


def descend(
    optimiser: torch.optim.Optimizer, total: Tensor, lr: float, max_grad_norm: float | None
) -> Tensor:
    """One step of the optimiser down the gradient of ``total``.

    Args:
        optimiser: holds the parameters.
        total: scalar.
        lr: learning rate of this step.
        max_grad_norm: all gradients as one vector are clipped to this norm; None leaves them, as does
            :class:`~vusfa.objectives.TFRMSprop`, which clips every tensor on its own.

    Returns:
        the gradient's norm before clipping, a scalar.
    """
    params = [param for group in optimiser.param_groups for param in group["params"]]
    for group in optimiser.param_groups:
        group["lr"] = lr
    optimiser.zero_grad()
    total.backward()
    clips_itself = isinstance(optimiser, TFRMSprop)
    limit = float("inf") if clips_itself or max_grad_norm is None else max_grad_norm
    norm = nn.utils.clip_grad_norm_(params, limit)
    optimiser.step()
    return norm


def loss_state(loss: nn.Module) -> dict[str, Tensor]:
    """The loss's own buffers (coefficients, multiplier, last KL), without the networks, which the agent
    holds."""
    return {
        k: v for k, v in loss.state_dict().items() if not k.startswith(("actor_network", "critic_network"))
    }


def make_optimiser(
    params: Iterable[nn.Parameter], kind: str, lr: float, max_grad_norm: float | None = None, **options: Any
) -> torch.optim.Optimizer:
    """An optimiser by name.

    Args:
        params: of the agent.
        kind: ``"adam"``, ``"rmsprop"`` (torch's) or ``"tf_rmsprop"`` (:class:`~vusfa.objectives.TFRMSprop`).
        lr: learning rate at the start.
        max_grad_norm: only ``tf_rmsprop`` clips by itself, every tensor on its own; the others leave it to
            the caller, who clips all tensors as one.
        options: further arguments of the optimiser.

    Raises:
        ConfigError: unknown kind or argument.
    """
    if kind not in OPTIMISERS:
        raise ConfigError(f"optim.kind is {kind!r}; it must be one of {', '.join(OPTIMISERS)}")
    try:
        if kind == "tf_rmsprop":
            return TFRMSprop(params, lr=lr, max_grad_norm=max_grad_norm, **options)
        return {"adam": torch.optim.Adam, "rmsprop": torch.optim.RMSprop}[kind](params, lr=lr, **options)
    except (TypeError, ValueError) as error:
        raise ConfigError(
            f"optim.kind={kind} does not take optim.lr={lr}, optim.options={options}: {error}"
        ) from error


def annealed(frames: int, start: float, horizon: int | None, end: float = 0.0) -> float:
    """A learning rate or coefficient: linear in the frames from ``start`` to ``end`` at ``horizon``, then
    constant.

    Without a horizon it stays at ``start``. A function of the frames, not of the number of calls: nothing to
    save, nothing that a resumed run could miscount.

    >>> annealed(250, start=4.0, horizon=1000), annealed(250, start=4.0, horizon=None)
    (3.0, 4.0)
    >>> annealed(500, start=4.0, horizon=1000, end=1.0), annealed(2000, start=4.0, horizon=1000, end=1.0)
    (2.5, 1.0)
    """
    return start if horizon is None else start + (end - start) * min(1.0, frames / horizon)
