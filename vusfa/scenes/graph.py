"""What can be known exactly about a room's graph: shortest paths, components, success of a walk.

A graph is an integer table of shape ``(N, A)``: ``graph[s, a]`` is the state that action ``a`` leads to from
state ``s``, or -1 when the move is blocked; the agent then stays where it is, and the action counts as any.
Everything here is a pure function of such a table (a tensor or an array) and answers with tensors on the CPU.

Success within ``steps`` actions needs no sampling. Make the goal absorbing; then the probability ``h_k(s)``
of having met it after at most ``k`` actions from ``s`` obeys

    h_0(s) = [s = g],    h_k(g) = 1,    h_k(s) = sum_a pi(a | s, g) h_{k-1}(next(s, a))

(the backward equation of an absorbing Markov chain: Kemeny and Snell, Finite Markov Chains, 1960, chapter 3).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy import sparse
from scipy.sparse import csgraph
from torch import Tensor

from vusfa.errors import GoalError

__all__ = [
    "arrival_probability",
    "default_actions",
    "narrow_distances",
    "policy_success",
    "random_walk_success",
    "shortest_path_distances",
    "steps_to_goals",
    "strong_components",
    "success_over_starts",
    "successor_table",
    "weak_components",
]

# Searches give float64 tables: at most 32 MiB of them at a time.
_SEARCH_ELEMENTS = 1 << 22
# Elements of H that are propagated together: they stay in the cache, which is 3 to 5 times faster than all
# goals at once. Where every goal has its own policy the transition matrix takes A more entries for each.
_WALK_ELEMENTS = {2: 1 << 17, 3: 1 << 15}


def _as_table(graph: Tensor | np.ndarray) -> np.ndarray:
    table = graph.detach().cpu().numpy() if isinstance(graph, Tensor) else np.asarray(graph)
    if table.ndim != 2 or table.dtype.kind not in "iu":
        raise ValueError(f"graph must be an integer table (N, A), not {table.dtype} {table.shape}")
    if table.size and (table.min() < -1 or table.max() >= len(table)):
        raise ValueError(
            f"graph holds {table.min()}..{table.max()}; states are 0..{len(table) - 1}, blocked is -1"
        )
    return table.astype(np.int64, copy=False)


def _as_states(states: Any, num_states: int, role: str) -> np.ndarray:
    """One-dimensional int64 array of state ids, each of them checked."""
    array = states.detach().cpu().numpy() if isinstance(states, Tensor) else np.asarray(states)
    ids = np.atleast_1d(array)
    if ids.ndim != 1 or (ids.size and ids.dtype.kind not in "iu"):
        raise GoalError(f"{role} must be one or a list of integer state ids, not {array.dtype} {array.shape}")
    wrong = ids[(ids < 0) | (ids >= num_states)]
    if wrong.size:
        raise GoalError(f"{role} {wrong[0]} is not a state; this graph has the states 0..{num_states - 1}")
    return ids.astype(np.int64)


def _edges(table: np.ndarray) -> sparse.csr_matrix:
    """Adjacency (N, N): entry (s, t) is set where some action leads from s to t."""
    source, action = np.nonzero(table >= 0)
    target = table[source, action]
    ones = np.ones(len(source), dtype=np.float64)
    return sparse.csr_matrix((ones, (source, target)), shape=(len(table),) * 2)


def _breadth_first(edges: sparse.csr_matrix, sources: np.ndarray) -> np.ndarray:
    """Number of edges from each source to each state, (len(sources), N) int32, -1 where there is no path."""
    num_states = edges.shape[0]
    result = np.empty((len(sources), num_states), dtype=np.int32)
    block = max(1, _SEARCH_ELEMENTS // max(num_states, 1))
    for first in range(0, len(sources), block):
        rows = slice(first, first + block)
        found = csgraph.dijkstra(edges, indices=sources[rows], unweighted=True)
        result[rows] = np.where(np.isinf(found), -1, found)
    return result


def default_actions(num_actions: int) -> tuple[str, ...]:
    """Names for actions that have none: the THOR v1 dumps' four in their order, numbers for any other count.

    >>> default_actions(4)
    ('MoveForward', 'RotateRight', 'RotateLeft', 'MoveBackward')
    >>> default_actions(2)
    ('action_0', 'action_1')
    """
    if num_actions == 4:
        return ("MoveForward", "RotateRight", "RotateLeft", "MoveBackward")
    return tuple(f"action_{index}" for index in range(num_actions))


def successor_table(graph: Tensor | np.ndarray) -> tuple[Tensor, Tensor]:
    """Where each action leads, blocked moves staying in place, and which moves are blocked.

    Args:
        graph: (N, A) integers, -1 = blocked.

    Returns:
        successor (N, A) int64 and blocked (N, A) bool.

    >>> successor, blocked = successor_table(torch.tensor([[1, -1], [-1, 0]]))
    >>> successor.tolist(), blocked.tolist()
    ([[1, 0], [1, 0]], [[False, True], [True, False]])
    """
    table = _as_table(graph)
    blocked = table < 0
    successor = np.where(blocked, np.arange(len(table))[:, None], table)
    return torch.from_numpy(successor), torch.from_numpy(blocked)


def shortest_path_distances(graph: Tensor | np.ndarray) -> Tensor:
    """Fewest actions from every state to every other, by breadth-first search.

    Args:
        graph: (N, A) integers, -1 = blocked.

    Returns:
        (N, N), ``[s, g]`` in actions, 0 on the diagonal and -1 where g cannot be reached from s; int16, or
        int32 where a path is longer than that holds.

    >>> shortest_path_distances(torch.tensor([[1, -1], [2, -1], [-1, -1]])).tolist()
    [[0, 1, 2], [-1, 0, 1], [-1, -1, 0]]
    """
    table = _as_table(graph)
    return narrow_distances(_breadth_first(_edges(table), np.arange(len(table))))


def narrow_distances(distance: np.ndarray) -> Tensor:
    """A table of distances as int16, or as int32 where one is longer than that holds; always a copy.

    >>> narrow_distances(np.array([[0, 32767]])).dtype, narrow_distances(np.array([[0, 32768]])).dtype
    (torch.int16, torch.int32)
    """
    fits = not distance.size or distance.max() <= np.iinfo(np.int16).max
    return torch.from_numpy(distance.astype(np.int16 if fits else np.int32))


def steps_to_goals(graph: Tensor | np.ndarray, goals: Any) -> Tensor:
    """Fewest actions from every state to some goals: a search backwards, cheap when the goals are few.

    Args:
        graph: (N, A) integers, -1 = blocked.
        goals: one state id, or (G,) of them.

    Returns:
        (G, N) int64, -1 where the goal cannot be reached from the state.

    Raises:
        GoalError: a goal is not a state.

    >>> steps_to_goals(torch.tensor([[1, -1], [2, -1], [-1, -1]]), [2, 0]).tolist()
    [[2, 1, 0], [0, -1, -1]]
    """
    table = _as_table(graph)
    backwards = _edges(table).T.tocsr()
    return torch.from_numpy(_breadth_first(backwards, _as_states(goals, len(table), "goal")).astype(np.int64))


def _components(table: np.ndarray, connection: str) -> tuple[tuple[int, ...], ...]:
    if not len(table):
        return ()
    _, label = csgraph.connected_components(_edges(table), directed=True, connection=connection)
    groups: dict[int, list[int]] = {}
    for state, component in enumerate(label.tolist()):
        groups.setdefault(component, []).append(state)
    return tuple(sorted((tuple(g) for g in groups.values()), key=lambda g: (-len(g), g)))


def weak_components(graph: Tensor | np.ndarray) -> tuple[tuple[int, ...], ...]:
    """States joined by moves in either direction, as sorted tuples, the largest component first.

    >>> weak_components(torch.tensor([[1], [-1], [3], [2], [2]]))
    ((2, 3, 4), (0, 1))
    """
    return _components(_as_table(graph), "weak")


def strong_components(graph: Tensor | np.ndarray) -> tuple[tuple[int, ...], ...]:
    """States that can all reach one another, as sorted tuples, the largest component first.

    >>> strong_components(torch.tensor([[1], [-1], [3], [2], [2]]))
    ((2, 3), (0,), (1,), (4,))
    """
    return _components(_as_table(graph), "strong")


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


def _walk_same_policy(successor: np.ndarray, policy: np.ndarray, goals: np.ndarray, steps: int) -> np.ndarray:
    """One policy (N, A) for all goals: the columns of H share one transition matrix."""
    num_states, num_actions = successor.shape
    rows = np.repeat(np.arange(num_states), num_actions)
    transition = sparse.csr_matrix((policy.ravel(), (rows, successor.ravel())), shape=(num_states,) * 2)
    column = np.arange(len(goals))
    arrived = np.zeros((num_states, len(goals)))
    arrived[goals, column] = 1.0
    for _ in range(steps):
        arrived = transition @ arrived
        arrived[goals, column] = 1.0
    return arrived.T


def _walk_policy_per_goal(
    successor: np.ndarray, policy: np.ndarray, goals: np.ndarray, steps: int
) -> np.ndarray:
    """A policy for each goal, (G, N, A): the goals' transition matrices as one block-diagonal matrix."""
    num_states, num_actions = successor.shape
    count = len(goals)
    first_row = np.arange(count)[:, None, None] * num_states
    columns = (first_row + successor).ravel()
    rows = np.repeat(np.arange(count * num_states), num_actions)
    transition = sparse.csr_matrix((policy.ravel(), (rows, columns)), shape=(count * num_states,) * 2)
    goal_rows = np.arange(count) * num_states + goals
    arrived = np.zeros(count * num_states)
    arrived[goal_rows] = 1.0
    for _ in range(steps):
        arrived = transition @ arrived
        arrived[goal_rows] = 1.0
    return arrived.reshape(count, num_states)


def arrival_probability(
    graph: Tensor | np.ndarray, action_probabilities: Any, goals: Any, steps: int
) -> Tensor:
    """Probability of having met each goal after at most ``steps`` actions, from every state; exact.

    Args:
        graph: (N, A) integers, -1 = blocked (the agent stays, the action counts).
        action_probabilities: (N, A), one policy for all goals, or (G, N, A), one for each. It must depend on
            the present state alone: a policy that sees a history of frames has no exact success.
        goals: one state id, or (G,) of them.
        steps: actions allowed, 0 or more.

    Returns:
        (G, N) float64; 1 at the goal itself.

    Raises:
        GoalError: a goal is not a state.
        ValueError: the probabilities have another shape or are not distributions.

    >>> line = torch.tensor([[1, -1], [2, 0], [-1, 1]])  # right, left
    >>> arrival_probability(line, torch.full((3, 2), 0.5), goals=2, steps=2).tolist()
    [[0.25, 0.5, 1.0]]
    """
    if steps < 0:
        raise ValueError(f"steps is {steps}; it must be 0 or more")
    table = _as_table(graph)
    goal_ids = _as_states(goals, len(table), "goal")
    policy = _as_probabilities(action_probabilities, len(goal_ids), *table.shape)
    successor = successor_table(table)[0].numpy()
    walk = _walk_same_policy if policy.ndim == 2 else _walk_policy_per_goal
    block = max(1, _WALK_ELEMENTS[policy.ndim] // max(len(table), 1))
    parts = []
    for first in range(0, len(goal_ids), block):
        rows = slice(first, first + block)
        parts.append(walk(successor, policy if policy.ndim == 2 else policy[rows], goal_ids[rows], steps))
    return torch.from_numpy(np.concatenate(parts) if parts else np.zeros((0, len(table))))


def success_over_starts(
    graph: Tensor | np.ndarray, arrived: Tensor, goals: Any, starts: Any = None
) -> Tensor:
    """Mean of ``arrived`` (G, N) over the starts that count, one number for each goal.

    A start counts when it is not the goal itself and the goal can be reached from it in the graph; all those
    that count weigh the same. Pairs that no policy could solve are thereby left out, not counted as failures.

    Args:
        graph: (N, A) integers, -1 = blocked.
        arrived: (G, N), as :func:`arrival_probability` gives it.
        goals: one state id, or (G,) of them.
        starts: the set of state ids to choose from (repeats count once); None for all states.

    Returns:
        (G,) float64, NaN for a goal that no start can reach.
    """
    table = _as_table(graph)
    counts = steps_to_goals(table, goals) > 0
    if starts is not None:
        chosen = torch.zeros(len(table), dtype=torch.bool)
        chosen[torch.from_numpy(_as_states(starts, len(table), "start"))] = True
        counts = counts & chosen
    total = torch.where(counts, arrived.to(torch.float64), 0.0).sum(1)
    return total / counts.sum(1)


def policy_success(
    graph: Tensor | np.ndarray, action_probabilities: Any, goals: Any, steps: int, starts: Any = None
) -> Tensor:
    """Exact success of a policy within ``steps`` actions, one number for each goal.

    The start is uniform over the states (of ``starts``) other than the goal from which the goal can be
    reached in the graph; unreachable pairs are excluded (see :func:`success_over_starts`).

    Args:
        graph: (N, A) integers, -1 = blocked.
        action_probabilities: (N, A) or (G, N, A), see :func:`arrival_probability`.
        goals: one state id, or (G,) of them.
        steps: actions allowed.
        starts: the set of state ids to start from; None for all states.

    Returns:
        (G,) float64 in [0, 1], NaN for a goal that no start can reach.

    >>> line = torch.tensor([[1, -1], [2, 0], [-1, 1]])  # right, left
    >>> always_right = torch.tensor([[1.0, 0.0]] * 3)
    >>> policy_success(line, always_right, goals=[2, 0], steps=2).tolist()
    [1.0, 0.0]
    """
    arrived = arrival_probability(graph, action_probabilities, goals, steps)
    return success_over_starts(graph, arrived, goals, starts)


def random_walk_success(graph: Tensor | np.ndarray, goals: Any, steps: int, starts: Any = None) -> Tensor:
    """Exact success of the uniformly random policy within ``steps`` actions, one number for each goal.

    The floor under every result. Starts are counted as in :func:`policy_success`.

    Args:
        graph: (N, A) integers, -1 = blocked.
        goals: one state id, or (G,) of them.
        steps: actions allowed.
        starts: the set of state ids to start from; None for all states.

    Returns:
        (G,) float64 in [0, 1], NaN for a goal that no start can reach.

    >>> random_walk_success(torch.tensor([[1, -1], [2, 0], [-1, 1]]), goals=[2], steps=2).tolist()
    [0.375]
    """
    table = _as_table(graph)
    uniform = np.full(table.shape, 1.0 / table.shape[1])
    return policy_success(table, uniform, goals, steps, starts)
