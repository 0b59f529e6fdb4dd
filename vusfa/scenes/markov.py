"""Exact success of policies on a scene's graph, without sampling episodes.

Make the goal g absorbing; then the probability ``h_k(s)`` of having reached it after at most ``k`` actions
from ``s`` obeys

    h_0(s) = [s = g],    h_k(g) = 1,    h_k(s) = sum_a pi(a | s, g) h_{k-1}(next(s, a))

(the backward equation of an absorbing Markov chain: Kemeny and Snell, Finite Markov Chains, 1960, chapter 3).
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from typing import Any

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from vusfa.scenes.graph import as_states, as_table, steps_to_goals, successor_table

__all__ = [
    "arrival_by_step",
    "arrival_probability",
    "goals_at_once",
    "policy_success",
    "random_walk_success",
    "success_over_starts",
]


def _as_probabilities(
    action_probabilities: Any, num_goals: int, num_states: int, num_actions: int
) -> np.ndarray:
    tensor = torch.as_tensor(action_probabilities).detach().cpu().to(torch.float64)
    table = (num_states, num_actions)
    if tuple(tensor.shape) not in (table, (num_goals, *table)):
        raise ValueError(
            f"action_probabilities has shape {tuple(tensor.shape)}; give {table} for one policy,"
            f" or {(num_goals, *table)} for one per goal"
        )
    probabilities = tensor.numpy()
    off = ~(np.abs(probabilities.sum(-1) - 1) <= 1e-4) | ~(probabilities >= 0).all(-1)
    if off.any():
        where = tuple(int(i) for i in np.argwhere(off)[0])
        raise ValueError(
            f"action_probabilities at {where} is {probabilities[where].tolist()}, not a distribution"
            f" (each >= 0, sum 1)"
        )
    # Softmax in float32 sums to 1 within 1e-7; over 500 steps that would show in the sixth digit.
    return probabilities / probabilities.sum(-1, keepdims=True)


def arrival_by_step(graph: Tensor | np.ndarray, action_probabilities: Any, goals: Any) -> Iterator[Tensor]:
    """h_0, h_1, h_2, ... without end: the probability of having reached each goal after so many actions.

    Args:
        graph, action_probabilities, goals: see :func:`arrival_probability`. All goals are propagated
            together: give :func:`goals_at_once` of them.

    Yields:
        (G, N) float64; a new tensor each time.
    """
    table = as_table(graph)
    goal_ids = as_states(goals, len(table), "goal")
    policy = _as_probabilities(action_probabilities, len(goal_ids), *table.shape)
    return _steps(successor_table(table)[0].numpy(), policy, goal_ids)


def _steps(successor: np.ndarray, policy: np.ndarray, goals: np.ndarray) -> Iterator[Tensor]:
    """One policy (N, A) for all goals: columns that share a transition matrix. One policy per goal,
    (G, N, A): the goals' transition matrices as one block-diagonal matrix."""
    (num_states, num_actions), count = successor.shape, len(goals)
    blocks = 1 if policy.ndim == 2 else count
    first_row = np.arange(blocks)[:, None, None] * num_states
    rows = np.repeat(np.arange(blocks * num_states), num_actions)
    entries = policy.ravel(), (rows, (first_row + successor).ravel())
    transition = sparse.csr_matrix(entries, shape=(blocks * num_states,) * 2)
    if policy.ndim == 2:
        arrived, at_goal = np.zeros((num_states, count)), (goals, np.arange(count))
    else:
        arrived, at_goal = np.zeros(count * num_states), np.arange(count) * num_states + goals
    while True:
        arrived[at_goal] = 1.0
        yield torch.from_numpy(arrived.T if policy.ndim == 2 else arrived.reshape(count, num_states))
        arrived = transition @ arrived


def goals_at_once(num_states: int, policy_per_goal: bool = True) -> int:
    """Number of goals to propagate together: as many as fit the processor's cache, 3 to 5 times faster."""
    return max(1, (1 << (15 if policy_per_goal else 17)) // max(num_states, 1))


def arrival_probability(
    graph: Tensor | np.ndarray, action_probabilities: Any, goals: Any, steps: int
) -> Tensor:
    """Exact probability of having reached each goal after at most ``steps`` actions, from every state.

    Args:
        graph: (N, A) integers, -1 = blocked (the agent stays, the action counts).
        action_probabilities: (N, A), one policy for all goals, or (G, N, A), one per goal; of the current
            state alone: a policy that sees a history of frames has no exact success.
        goals: one state id, or (G,).
        steps: actions allowed, 0 or more.

    Returns:
        (G, N) float64; 1 at the goal itself.

    Raises:
        GoalError: a goal that is not a state.
        ValueError: probabilities have the wrong shape, or are not distributions.

    >>> line = torch.tensor([[1, -1], [2, 0], [-1, 1]])  # right, left
    >>> arrival_probability(line, torch.full((3, 2), 0.5), goals=2, steps=2).tolist()
    [[0.25, 0.5, 1.0]]
    """
    if steps < 0:
        raise ValueError(f"steps is {steps}; it must be 0 or more")
    table = as_table(graph)
    goal_ids = as_states(goals, len(table), "goal")
    policy = _as_probabilities(action_probabilities, len(goal_ids), *table.shape)
    successor = successor_table(table)[0].numpy()
    block = goals_at_once(len(table), policy.ndim == 3)
    parts = [torch.zeros(0, len(table), dtype=torch.float64)]
    for first in range(0, len(goal_ids), block):
        rows = slice(first, first + block)
        walks = _steps(successor, policy if policy.ndim == 2 else policy[rows], goal_ids[rows])
        parts.append(next(islice(walks, steps, None)).contiguous())
    return torch.cat(parts)


def success_over_starts(graph: Tensor | np.ndarray, arrived: Tensor, goals: Any) -> Tensor:
    """Mean of ``arrived`` (G, N) over the starts that count, (G,) float64; NaN for a goal without any.

    A start counts, each with the same weight, when it is not the goal and can reach it in the graph: pairs
    that no policy could solve are left out, not counted as failures.

    Args:
        graph, goals: see :func:`arrival_probability`.
        arrived: (G, N), as :func:`arrival_probability` returns it.
    """
    counts = steps_to_goals(as_table(graph), goals) > 0
    total = torch.where(counts, arrived.to(torch.float64), 0.0).sum(1)
    return total / counts.sum(1)


def policy_success(graph: Tensor | np.ndarray, action_probabilities: Any, goals: Any, steps: int) -> Tensor:
    """Exact success of a policy within ``steps`` actions, (G,) float64 in [0, 1].

    The mean over :func:`success_over_starts`; arguments as for :func:`arrival_probability`.

    >>> line = torch.tensor([[1, -1], [2, 0], [-1, 1]])  # right, left
    >>> always_right = torch.tensor([[1.0, 0.0]] * 3)
    >>> policy_success(line, always_right, goals=[2, 0], steps=2).tolist()
    [1.0, 0.0]
    """
    arrived = arrival_probability(graph, action_probabilities, goals, steps)
    return success_over_starts(graph, arrived, goals)


def random_walk_success(graph: Tensor | np.ndarray, goals: Any, steps: int) -> Tensor:
    """Exact success of the uniformly random policy, the baseline of every result; see :func:`policy_success`.

    >>> random_walk_success(torch.tensor([[1, -1], [2, 0], [-1, 1]]), goals=[2], steps=2).tolist()
    [0.375]
    """
    table = as_table(graph)
    uniform = np.full(table.shape, 1.0 / table.shape[1])
    return policy_success(table, uniform, goals, steps)
