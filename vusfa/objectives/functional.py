r"""What universal successor features are trained towards, as pure functions of tensors."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd.function import FunctionCtx

from vusfa.modules.bottleneck import gaussian_kl
from vusfa.objectives.functional_returns import lambda_return, successor_return

__all__ = [
    "dual_ascent",
    "explained_variance",
    "gaussian_kl",
    "information_bottleneck",
    "lambda_return",
    "policy_gradient_loss",
    "successor_loss",
    "successor_return",
]


def successor_loss(successor: Tensor, target: Tensor) -> Tensor:
    r"""Squared error of the successor features, one number a step: the mean over the E features.

    Args:
        successor: psi, ``(*batch, E)``.
        target: ``(*batch, E)``; taken as a constant.

    Returns:
        ``(*batch)``.

    Raises:
        ValueError: when the shapes differ.

    >>> successor_loss(torch.tensor([[1.0, 2.0]]), torch.tensor([[0.0, 4.0]]))
    tensor([2.5000])
    """
    _assert_same_shape(successor_loss, successor=successor, target=target)
    return _MeanSquare.apply(successor - target.detach())


class _MeanSquare(torch.autograd.Function):
    """x (\\*B, E) to the mean of x^2 over E. Its gradient is one product, where that of the mean of a square
    is written down and filled in three times; a batch's errors do not fit a processor's cache."""

    generate_vmap_rule = True

    @staticmethod
    def forward(x: Tensor) -> Tensor:
        return x.square().mean(-1)

    @staticmethod
    def setup_context(ctx: FunctionCtx, inputs: tuple[Tensor], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)

    @staticmethod
    def backward(ctx: FunctionCtx, *grads: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors  # type: ignore[attr-defined]
        return x * (2 * (grads[0] / x.shape[-1])).unsqueeze(-1)


def policy_gradient_loss(log_prob: Tensor, advantage: Tensor) -> Tensor:
    r"""The policy gradient's surrogate, :math:`-\log \pi(a_t | s_t, g) A_t`, one number a step.

    Args:
        log_prob: ``(*batch)``, of the actions taken.
        advantage: ``(*batch)``; taken as a constant.

    Returns:
        ``(*batch)``.

    Raises:
        ValueError: when the shapes differ.

    >>> policy_gradient_loss(torch.tensor([-0.5]), torch.tensor([3.0]))
    tensor([1.5000])
    """
    _assert_same_shape(policy_gradient_loss, log_prob=log_prob, advantage=advantage)
    return -log_prob * advantage.detach()


def information_bottleneck(kl: Tensor, beta: float | Tensor, information_target: float | Tensor) -> Tensor:
    r"""The Lagrangian term of the information constraint, :math:`\beta (KL - I_c)`.

    The variational discriminator bottleneck (Peng et al., 2018, https://arxiv.org/abs/1810.00821, Eq. 5).

    Args:
        kl: information of the latent, any shape, nats.
        beta: the multiplier; taken as a constant, as :func:`dual_ascent` adapts it.
        information_target: I_c, nats, in the reduction in which ``kl`` is given.

    Returns:
        the shape of ``kl``.

    >>> information_bottleneck(torch.tensor([0.5]), 2.0, 0.2)
    tensor([0.6000])
    """
    return beta * (kl - information_target)


def dual_ascent(multiplier: Tensor, violation: Tensor, step_size: float | Tensor) -> Tensor:
    r"""One step of a constraint's multiplier, :math:`\beta \leftarrow \max(0, \beta + \alpha (KL - I_c))`.

    Args:
        multiplier: beta, any shape.
        violation: by how much the constraint is broken, ``KL - I_c``; negative where it holds.
        step_size: alpha.

    Returns:
        the new multiplier, not differentiable.

    >>> dual_ascent(torch.tensor(0.1), torch.tensor(-3.0), 0.01)
    tensor(0.0700)
    >>> dual_ascent(torch.tensor(0.1), torch.tensor(-30.0), 0.01)
    tensor(0.)
    """
    multiplier, violation = multiplier.detach(), violation.detach()
    return (multiplier + step_size * violation).clamp(min=0.0)


def explained_variance(target: Tensor, prediction: Tensor, mask: Tensor | None = None) -> Tensor:
    r"""How much of the targets' variance a prediction accounts for, :math:`1 - Var(y - \hat y) / Var(y)`.

    1 is perfect, 0 no better than a constant, below 0 worse than that. Constant targets give 0.

    Args:
        target: any shape.
        prediction: the same shape.
        mask: bool, the same shape: which entries count. All, when ``None``.

    Returns:
        a scalar, not differentiable.

    Raises:
        ValueError: when the shapes differ.

    >>> explained_variance(torch.tensor([1.0, 2.0, 3.0]), torch.tensor([2.0, 3.0, 4.0]))
    tensor(1.)
    >>> explained_variance(torch.tensor([1.0, 2.0, 3.0]), torch.zeros(3))
    tensor(0.)
    """
    _assert_same_shape(explained_variance, target=target, prediction=prediction)
    target, prediction = target.detach(), prediction.detach()
    weight = torch.ones_like(target) if mask is None else mask.to(target.dtype)
    count = weight.sum().clamp_min(1.0)

    def variance(x: Tensor) -> Tensor:
        # select, not multiply: what the mask hides may be infinite
        x = torch.where(weight > 0, x, 0.0)
        return (weight * (x - x.sum() / count).square()).sum() / count

    total = variance(target)
    return torch.where(total > 0, 1.0 - variance(target - prediction) / total, 0.0)


def _assert_same_shape(function: object, **tensors: Tensor) -> None:
    shapes = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
    if len(set(shapes.values())) > 1:
        raise ValueError(
            f"{getattr(function, '__name__', function)}: shapes differ: {shapes}; give equal ones"
        )
