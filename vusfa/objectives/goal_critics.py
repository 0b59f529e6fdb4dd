r"""Losses of critics that score every seen state as a goal, as functions of matrices of scores.

Rows are pairs of a state and an action, columns goals, both distinct: what a sample asks several times is
computed once, and a matrix of counts says how often it was asked.
"""

from __future__ import annotations

import torch
from torch import Tensor

from vusfa.objectives.hindsight import expectile_loss

__all__ = ["implicit_q_loss", "implied_reward", "info_nce_loss", "measure_loss", "orthonormality_loss"]


def info_nce_loss(scores: Tensor, count: Tensor, penalty: float = 0.0) -> Tensor:
    r"""Symmetric InfoNCE of a sample of N positive pairs, each the others' negatives, per pair.

    .. math::
        \frac{1}{N} \sum_i \Big[ \log \sum_j e^{f(x_i, g_j)} + \log \sum_j e^{f(x_j, g_i)}
        - 2 f(x_i, g_i) + c \big(\log \sum_j e^{f(x_i, g_j)}\big)^2 \Big]

    The two terms are the losses of classifying the goal of a row and the row of a goal (van den Oord et al.
    2018, https://arxiv.org/abs/1807.03748; in contrastive RL, Eysenbach et al. 2022,
    https://arxiv.org/abs/2206.07568); the penalty keeps the scores of a row from drifting together
    (Bortkiewicz et al. 2024, https://arxiv.org/abs/2408.11052). The best scores are
    f = log p(g | x) - log p(g) and a constant.

    Args:
        scores: f, (R, G), of all distinct rows and goals.
        count: (R, G), how often each occurs as a positive pair; N is their sum.
        penalty: c.

    >>> import torch
    >>> scores = torch.tensor([[2.0, 0.0], [0.0, 2.0]])
    >>> info_nce_loss(scores, torch.eye(2))  # 2 log(e^2 + 1) - 4
    tensor(0.2539)
    """
    of_row, of_goal = count.sum(1), count.sum(0)
    by_row = (scores + of_goal.log()).logsumexp(1)
    by_goal = (scores + of_row.log().unsqueeze(1)).logsumexp(0)
    matched = -2 * (count * scores).sum()
    total = matched + (of_row * (by_row + penalty * by_row.square())).sum() + (of_goal * by_goal).sum()
    return total / count.sum()


def implicit_q_loss(
    action_value: Tensor, value: Tensor, target: Tensor, slow: Tensor, expectile: float, weight: Tensor
) -> Tensor:
    r"""The two losses of implicit Q-learning, for matrices of rows and goals.

    .. math::
        \frac{1}{\sum w} \sum w \Big[ \big(Q(s, a, g) - y\big)^2
        + L_\tau\big(V(s, g), \bar Q(s, a, g)\big) \Big]

    Q learns the target of one step, V the expectile of a slow copy of Q over the actions in the data, which
    leans towards the best of them (Kostrikov et al. 2021, https://arxiv.org/abs/2110.06169); L is
    :func:`~vusfa.objectives.expectile_loss`.

    Args:
        action_value: Q, (R, G).
        value: V of the rows' states, (R, G).
        target: y, (R, G); a constant.
        slow: Q of the slow copy, (R, G); a constant.
        expectile: tau, in (0, 1).
        weight: w, (R, G), 0 or more.

    >>> import torch
    >>> one = torch.ones(1, 1)
    >>> implicit_q_loss(0.5 * one, 0 * one, one, one, 0.75, one)  # 0.5^2 + 2 * 0.75 * 1^2
    tensor(1.7500)
    """
    error = (action_value - target.detach()).square() + expectile_loss(value, slow, expectile)
    return (weight * error).sum() / weight.sum().clamp(min=1e-12)


def measure_loss(measure: Tensor, slow: Tensor, following: Tensor, density: Tensor, gamma: float) -> Tensor:
    r"""Squared error of a successor measure in its Bellman equation, but for a constant, per row.

    .. math::
        \frac{1}{N} \sum_i \Big[ \sum_j \rho_j \big(m_{ij} - \gamma \bar m_{ij}\big)^2 - 2 m_{i, s'_i} \Big]

    m_ij is the density, with respect to rho, of the discounted visits to state j after row i: those from the
    next state on, and the visit to the next state itself, whose density is infinite where rho has none, and
    of which only the product with m remains (Touati and Ollivier 2021, https://arxiv.org/abs/2103.07945).

    Args:
        measure: m, (N, S).
        slow: m of the slow copy at the next state under its policy, (N, S); a constant.
        following: s', (N,) int64.
        density: rho, (S,), which sums to 1.
        gamma: discount per step.

    >>> import torch
    >>> measure_loss(torch.tensor([[2.0, 0.0]]), torch.ones(1, 2), torch.tensor([0]), torch.ones(2) / 2, 0.5)
    tensor(-2.7500)
    """
    error = (density * (measure - gamma * slow.detach()).square()).sum(-1)
    return (error - 2 * measure.gather(-1, following.unsqueeze(-1)).squeeze(-1)).mean()


def orthonormality_loss(backward: Tensor, density: Tensor) -> Tensor:
    r"""Squared distance of the second moment of B from the identity, but for a constant.

    .. math::
        \lVert \mathbb{E}[B B^T] - I \rVert^2 - d = \sum_{ij} \rho_i \rho_j (B_i \cdot B_j)^2
        - 2 \sum_i \rho_i \lVert B_i \rVert^2

    Args:
        backward: B, (S, d).
        density: rho, (S,), which sums to 1.

    >>> import torch
    >>> orthonormality_loss(2**0.5 * torch.eye(2), torch.tensor([0.5, 0.5]))  # B B^T is 1 on average
    tensor(-2.)
    """
    moment = (backward * density.unsqueeze(-1)).mT @ backward
    return moment.square().sum() - 2 * (density * backward.square().sum(-1)).sum()


def implied_reward(backward: Tensor, density: Tensor, task: Tensor, state: Tensor) -> Tensor:
    r"""The reward of a task in states, B(s) . (E[B B^T] + 0.001 I)^-1 z, (n,): of the directions of B, the
    combination that z is the expectation of.

    Args:
        backward: B, (S, d).
        density: rho, (S,), which sums to 1.
        task: z, (n, d).
        state: (n,) int64.

    >>> import torch
    >>> back = 2**0.5 * torch.eye(2)
    >>> implied_reward(back, torch.ones(2) / 2, back, torch.tensor([0, 1]))
    tensor([1.9980, 1.9980])
    """
    moment = (backward * density.unsqueeze(-1)).mT @ backward
    moment = moment + 1e-3 * torch.eye(len(moment), device=moment.device)
    return (torch.linalg.solve(moment, task.mT).mT * backward[state]).sum(-1)
