"""Returns, of rewards and of embeddings, as pure functions of tensors.

A value function is the expected discounted sum of rewards to come; successor features are the same sum with a
vector, the embedding of the states to come, in the reward's place (Dayan 1993; Barreto et al., 2017,
https://arxiv.org/abs/1606.05312; Borsa et al., 2018, https://arxiv.org/abs/1812.07626). One backward
recursion therefore serves both: here it is written for a *cumulant* of any number of features, and the
estimator concatenates reward and embedding to run it once.

Time. A transition at step ``t`` goes from ``s_t`` to ``s_{t+1}``. ``cumulant``, ``next_value``, ``done`` and
``terminated`` are all indexed by ``t`` and speak of the transition's end: ``next_value[t]`` is the estimate
at ``s_{t+1}``, *before* any reset. ``done[t]`` says that the episode ended there, ``terminated[t]`` that
nothing follows (the goal is reached) as opposed to a time-out, beyond which the value goes on. The time
dimension is the second from last, ``(*batch, T, features)``, unless ``time_dim`` says otherwise.
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["lambda_return", "successor_return"]


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
        done: ``(*batch, T, 1)`` or ``(*batch, T, F)``, bool: the episode ended with this step.
        terminated: as ``done``: the episode ended and nothing follows.
        time_dim: the dimension of time; counted from the right so that batches of any rank fit.

    Returns:
        ``(*batch, T, F)``.

    Raises:
        ValueError: when shapes do not fit each other.

    Two steps, a time-out in between; then the same steps, but the first one ends at a terminal:

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
    differs by a slip). The bracket is 0 beyond a terminal; psi of the next state stands in for the rest at
    time-outs and at the rollout's end.

    Args:
        next_embedding: ``(*batch, T, E)``, phi of the states that the steps lead to. Not differentiated by
            the caller.
        next_successor: ``(*batch, T, E)``, psi of those states.
        gamma: discount per step.
        done: ``(*batch, T, 1)``, bool: the episode ended with this step.
        terminated: ``(*batch, T, 1)``, bool: it ended and nothing follows.
        lmbda: weight of the longer return; 1 is the n-step target up to the rollout's end.
        time_dim: the dimension of time.

    Returns:
        ``(*batch, T, E)``.

    Raises:
        ValueError: when shapes do not fit each other.

    >>> phi = torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    >>> psi = torch.full((2, 2), 4.0)
    >>> no = torch.zeros(2, 1, dtype=torch.bool)
    >>> successor_return(phi, psi, 0.5, no, no)
    tensor([[2.0000, 1.5000],
            [2.0000, 3.0000]])
    """
    return lambda_return(next_embedding, next_successor, gamma, lmbda, done, terminated, time_dim=time_dim)


def _assert_transitions(
    cumulant: Tensor, next_value: Tensor, done: Tensor, terminated: Tensor, time_dim: int
) -> None:
    shapes = {
        "cumulant": tuple(cumulant.shape),
        "next_value": tuple(next_value.shape),
        "done": tuple(done.shape),
        "terminated": tuple(terminated.shape),
    }
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
