"""Construction of an optimizer by name, and one optimization step."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from vusfa.errors import ConfigError, VusfaError
from vusfa.objectives import A3CRMSprop, TFRMSprop

__all__ = ["OPTIMIZERS", "check_finite", "descend", "make_optimizer", "total_loss"]

OPTIMIZERS = ("adam", "rmsprop", "tf_rmsprop", "a3c_rmsprop")


def total_loss(terms: Mapping[str, Tensor]) -> Tensor:
    """Sum of the entries whose name begins with ``loss_``; each holds its coefficient.

    >>> half, quarter = torch.tensor(0.5), torch.tensor(0.25)
    >>> total_loss({"loss_critic": half, "loss_entropy": quarter, "kl": half})
    tensor(0.7500)
    """
    return torch.stack([value for name, value in terms.items() if name.startswith("loss_")]).sum()


def descend(
    optimizer: torch.optim.Optimizer,
    total: Tensor,
    lr: float,
    max_grad_norm: float | None,
    average: Callable[[list[nn.Parameter]], None] | None = None,
) -> Tensor:
    """Make one optimization step against the gradient of ``total``.

    Args:
        optimizer: holds the parameters.
        total: scalar.
        lr: learning rate of this step.
        max_grad_norm: all gradients as one vector are clipped to this norm; None leaves them, as does
            :class:`~vusfa.objectives.TFRMSprop`, which clips every tensor on its own.
        average: replaces the gradients of these parameters by their means over all ranks, before clipping.

    Returns:
        the gradient's norm before clipping, a scalar.
    """
    params = [param for group in optimizer.param_groups for param in group["params"]]
    for group in optimizer.param_groups:
        group["lr"] = lr
    optimizer.zero_grad()
    total.backward()
    if average is not None:
        average(params)
    if isinstance(optimizer, TFRMSprop) or max_grad_norm is None:
        norm = nn.utils.get_total_norm([param.grad for param in params if param.grad is not None])
    else:
        norm = nn.utils.clip_grad_norm_(params, max_grad_norm)
    optimizer.step()
    return norm


@torch.no_grad()
def check_finite(params: Iterable[Tensor], module: nn.Module, frames: int) -> None:
    """Refuse parameters that are not finite.

    Args:
        params: all that are trained.
        module: has those that the message names.
        frames: trained on.

    Raises:
        VusfaError: naming them.
    """
    # one number for all weights: a short batch is logged at every update
    if nn.utils.get_total_norm(params).isfinite():
        return
    wrong = [name for name, param in module.named_parameters() if not param.isfinite().all()]
    if wrong:
        raise VusfaError(
            f"after {frames:,} frames the weights {', '.join(wrong)} are not finite any more; choose"
            " a smaller optim.lr or optim.max_grad_norm, and resume an earlier checkpoint or begin anew"
        )


def make_optimizer(
    params: Iterable[nn.Parameter],
    kind: str,
    lr: float,
    max_grad_norm: float | None = None,
    *,
    threads: int | None = None,
    **options: Any,
) -> torch.optim.Optimizer:
    """Make an optimizer by name.

    Args:
        params: of the agent.
        kind: ``"adam"``, ``"rmsprop"`` (torch's), ``"tf_rmsprop"`` (:class:`~vusfa.objectives.TFRMSprop`) or
            ``"a3c_rmsprop"`` (:class:`~vusfa.objectives.A3CRMSprop`).
        lr: learning rate at the start.
        max_grad_norm: norm that the latter two clip every tensor to; with the others the caller clips all
            tensors as one vector.
        threads: of ``a3c_rmsprop``, see :func:`~vusfa.algorithms.threads_per_step`.
        options: further arguments of the optimizer; ``threads_per_update`` is ignored, because ``threads``
            accounts for it.

    Raises:
        ConfigError: unknown kind or argument.
    """
    if kind not in OPTIMIZERS:
        raise ConfigError(f"optim.kind is {kind!r}; it must be one of {', '.join(OPTIMIZERS)}")
    try:
        if kind == "a3c_rmsprop":
            options.pop("threads_per_update", None)
            return A3CRMSprop(params, lr=lr, max_grad_norm=max_grad_norm, threads=threads or 1, **options)
        if kind == "tf_rmsprop":
            return TFRMSprop(params, lr=lr, max_grad_norm=max_grad_norm, **options)
        return {"adam": torch.optim.Adam, "rmsprop": torch.optim.RMSprop}[kind](params, lr=lr, **options)
    except (TypeError, ValueError) as error:
        raise ConfigError(
            f"optim.kind={kind} does not take optim.lr={lr}, optim.options={options}: {error}"
        ) from error
