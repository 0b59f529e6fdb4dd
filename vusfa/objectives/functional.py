"""Returns and terms of the losses, as pure functions of tensors.

A value function is the expected discounted sum of rewards to come; successor features are the same sum of a
vector, the embedding of the states to come (Dayan 1993; Barreto et al., 2017,
https://arxiv.org/abs/1606.05312; Borsa et al., 2018, https://arxiv.org/abs/1812.07626). One backward
recursion serves both, written for a *cumulant* of any number of features.

A transition at step ``t`` goes from ``s_t`` to ``s_{t+1}``. ``cumulant``, ``next_value``, ``done`` and
``terminated`` are all indexed by ``t`` and describe the transition's end: ``next_value[t]`` is the estimate
at ``s_{t+1}``, *before* any reset; ``done[t]`` means that the episode ended there, ``terminated[t]`` that
nothing follows (the goal is reached), as opposed to a time-out, beyond which the value goes on.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd.function import FunctionCtx

from vusfa.deprecated import moved_names
from vusfa.modules.bottleneck import gaussian_kl

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


def lambda_return(
    cumulant: Tensor,
    next_value: Tensor,
    gamma: float | Tensor,
    lmbda: float | Tensor,
    done: Tensor,
    terminated: Tensor,
    *,
    time_dim: int = -2,
) -> Tensor:
    r"""Lambda returns of a scalar or of a vector, cut where episodes end.

    .. math::
        G_t = c_t + \gamma \left[(1 - \lambda) v(s_{t+1}) + \lambda G_{t+1}\right]

    (Sutton and Barto, 2018, Eq. 12.18). The bracket is 0 where the step terminated, and ``v(s_{t+1})`` where
    the episode timed out or the rollout ends. ``lmbda=1`` gives the n-step return up to the rollout's end,
    ``lmbda=0`` the one-step target.

    Args:
        cumulant: ``(*batch, T, F)``, what is summed: the reward (F = 1) or an embedding.
        next_value: ``(*batch, T, F)``, the estimate of the sum at ``s_{t+1}``.
        gamma: discount per step.
        lmbda: weight of the longer return, in [0, 1].
        done, terminated: ``(*batch, T, 1)`` or ``(*batch, T, F)``, bool.
        time_dim: the dimension of time.

    Returns:
        ``(*batch, T, F)``.

    Raises:
        ValueError: shapes or types that do not fit each other.

    Two steps, a time-out in between; then a terminal in its place:

    >>> reward, next_value = torch.tensor([[1.0], [2.0]]), torch.tensor([[10.0], [20.0]])
    >>> done = torch.tensor([[True], [False]])
    >>> lambda_return(reward, next_value, 0.5, 1.0, done, torch.zeros_like(done)).squeeze(-1)
    tensor([ 6., 12.])
    >>> lambda_return(reward, next_value, 0.5, 1.0, done, done).squeeze(-1)
    tensor([ 1., 12.])
    """
    _assert_transitions(cumulant, next_value, done, terminated, time_dim)
    bootstraps = torch.where(terminated, 0.0, next_value).unbind(time_dim)
    cumulants, dones = cumulant.unbind(time_dim), done.unbind(time_dim)
    # the whole return, not mixed with estimates that may not even be finite
    whole = not isinstance(lmbda, Tensor) and lmbda == 1.0
    value: Tensor | None = None
    returns = []
    for time in reversed(range(len(cumulants))):
        bootstrap = bootstraps[time]
        value = bootstrap if value is None else value
        # where the episode ended, the return of the step after it belongs to another episode
        value = torch.where(dones[time], bootstrap, value if whole else bootstrap.lerp(value, lmbda))
        value = cumulants[time] + gamma * value
        returns.append(value)
    return torch.stack(returns[::-1], time_dim)


def successor_return(
    next_embedding: Tensor,
    next_successor: Tensor,
    gamma: float | Tensor,
    done: Tensor,
    terminated: Tensor,
    lmbda: float | Tensor = 1.0,
    *,
    time_dim: int = -2,
) -> Tensor:
    r"""Targets of the successor features psi: the discounted embeddings phi of the states to come.

    .. math::
        \Psi_t = \phi(s_{t+1}) + \gamma \left[(1 - \lambda) \psi(s_{t+1}, g) + \lambda \Psi_{t+1}\right]

    VUSFA (https://arxiv.org/abs/1908.06376) Eq. 4, as its released code has it (its Algorithm 1, line 17,
    differs by a slip).

    Args:
        next_embedding: ``(*batch, T, E)``, phi of the next states.
        next_successor: ``(*batch, T, E)``, psi of the next states.
        gamma, done, terminated, lmbda, time_dim: see :func:`lambda_return`, which this is.

    Returns:
        ``(*batch, T, E)``.

    >>> phi = torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    >>> no = torch.zeros(2, 1, dtype=torch.bool)
    >>> successor_return(phi, torch.full((2, 2), 4.0), 0.5, no, no)
    tensor([[2.0000, 1.5000],
            [2.0000, 3.0000]])
    """
    return lambda_return(next_embedding, next_successor, gamma, lmbda, done, terminated, time_dim=time_dim)


def _assert_transitions(
    cumulant: Tensor, next_value: Tensor, done: Tensor, terminated: Tensor, time_dim: int
) -> None:
    tensors = {"cumulant": cumulant, "next_value": next_value, "done": done, "terminated": terminated}
    shapes = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
    if cumulant.ndim < 2 or not -cumulant.ndim <= time_dim < cumulant.ndim:
        raise ValueError(
            f"returns need a time and a feature dimension, (*batch, T, F); time_dim={time_dim}, got {shapes}"
        )
    flags = (*cumulant.shape[:-1], 1)
    if (
        next_value.shape != cumulant.shape
        or done.shape != terminated.shape
        or tuple(done.shape) not in (flags, tuple(cumulant.shape))
    ):
        raise ValueError(
            "returns need cumulant and next_value of one shape, done and terminated of that shape or with "
            f"1 feature; got {shapes}"
        )
    if done.dtype != torch.bool or terminated.dtype != torch.bool:
        raise ValueError(f"done and terminated must be bool; got {done.dtype} and {terminated.dtype}")
    if cumulant.shape[time_dim] == 0:
        raise ValueError(f"returns need at least one step; got {shapes}")


def successor_loss(successor: Tensor, target: Tensor) -> Tensor:
    """Squared error of the successor features per step, ``(*batch,)``: the mean over the E features.

    Args:
        successor: psi, ``(*batch, E)``.
        target: of the same shape, else a ``ValueError``; a constant.

    >>> successor_loss(torch.tensor([[1.0, 2.0]]), torch.tensor([[0.0, 4.0]]))
    tensor([2.5000])
    """
    assert_same_shape("successor_loss", successor=successor, target=target)
    return _MeanSquare.apply(successor - target.detach())


class _MeanSquare(torch.autograd.Function):
    """Mean of x^2 over the last dimension. Its gradient is one product, in the place of three passes over
    errors that do not fit a processor's cache."""

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
    r"""The policy gradient's surrogate per step, :math:`-\log \pi(a_t | s_t, g) A_t`, ``(*batch,)``.

    Args:
        log_prob: ``(*batch,)``, of the actions taken.
        advantage: of the same shape, else a ``ValueError``; a constant.

    >>> policy_gradient_loss(torch.tensor([-0.5]), torch.tensor([3.0]))
    tensor([1.5000])
    """
    assert_same_shape("policy_gradient_loss", log_prob=log_prob, advantage=advantage)
    return -log_prob * advantage.detach()


def information_bottleneck(kl: Tensor, beta: float | Tensor, information_target: float | Tensor) -> Tensor:
    r"""The Lagrangian term of the information constraint, :math:`\beta (KL - I_c)`.

    The variational discriminator bottleneck (Peng et al., 2018, https://arxiv.org/abs/1810.00821, Eq. 5).

    Args:
        kl: information of the latent in nats, any shape.
        beta: the multiplier, a constant; :func:`dual_ascent` adapts it.
        information_target: I_c, in nats, reduced as ``kl`` is.

    >>> information_bottleneck(torch.tensor([0.5]), 2.0, 0.2)
    tensor([0.6000])
    """
    return beta * (kl - information_target)


def dual_ascent(multiplier: Tensor, violation: Tensor, step_size: float | Tensor) -> Tensor:
    r"""One step of a constraint's multiplier, :math:`\beta \leftarrow \max(0, \beta + \alpha (KL - I_c))`.

    Args:
        multiplier: beta, any shape; a constant, as is the new one.
        violation: ``KL - I_c``; negative where the constraint holds.
        step_size: alpha.

    >>> dual_ascent(torch.tensor(0.1), torch.tensor(-3.0), 0.01)
    tensor(0.0700)
    >>> dual_ascent(torch.tensor(0.1), torch.tensor(-30.0), 0.01)
    tensor(0.)
    """
    multiplier, violation = multiplier.detach(), violation.detach()
    return (multiplier + step_size * violation).clamp(min=0.0)


def explained_variance(target: Tensor, prediction: Tensor, mask: Tensor | None = None) -> Tensor:
    r"""Share of the targets' variance that a prediction explains, :math:`1 - Var(y - \hat y) / Var(y)`.

    1 is perfect, 0 no better than a constant, below 0 worse than that. Constant targets give 0.

    Args:
        target, prediction: of one shape, else a ``ValueError``; constants.
        mask: bool, of that shape: which entries count; all when ``None``.

    Returns:
        a scalar.

    >>> explained_variance(torch.tensor([1.0, 2.0, 3.0]), torch.tensor([2.0, 3.0, 4.0]))
    tensor(1.)
    >>> explained_variance(torch.tensor([1.0, 2.0, 3.0]), torch.zeros(3))
    tensor(0.)
    """
    assert_same_shape("explained_variance", target=target, prediction=prediction)
    target, prediction = target.detach(), prediction.detach()
    weight = torch.ones_like(target) if mask is None else mask.to(target.dtype)
    count = weight.sum().clamp_min(1.0)

    def variance(x: Tensor) -> Tensor:
        # select, not multiply: what the mask hides may be infinite
        x = torch.where(weight > 0, x, 0.0)
        return (weight * (x - x.sum() / count).square()).sum() / count

    total = variance(target)
    return torch.where(total > 0, 1.0 - variance(target - prediction) / total, 0.0)


def assert_same_shape(function: str, **tensors: Tensor) -> None:
    """Raise a ``ValueError`` where shapes differ: they would be broadcast without a word."""
    shapes = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
    if len(set(shapes.values())) > 1:
        raise ValueError(f"{function}: shapes differ: {shapes}; give equal ones")


__getattr__ = moved_names(__name__, {})
