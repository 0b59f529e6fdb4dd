"""Structure of a scene's graph: successor table, shortest paths, components.

A graph is an integer table of shape ``(N, A)``: ``graph[s, a]`` is the state that action ``a`` leads to from
state ``s``, or -1 when the move is blocked; the agent then stays where it is, and the action counts as any.
Everything here is a pure function of such a table (a tensor or an array) and returns tensors on the CPU. The
success of walks on it is in :mod:`vusfa.scenes.markov`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy import sparse
from scipy.sparse import csgraph
from torch import Tensor

from vusfa.deprecated import moved_names
from vusfa.errors import GoalError

__all__ = [
    "as_states",
    "as_table",
    "default_actions",
    "narrow_distances",
    "shortest_path_distances",
    "steps_to_goals",
    "strong_components",
    "successor_table",
    "weak_components",
]

# Searches give float64 tables: at most 32 MiB of them at a time.
_SEARCH_ELEMENTS = 1 << 22


def as_table(graph: Tensor | np.ndarray) -> np.ndarray:
    """A graph as an int64 array (N, A), checked.

    Raises:
        ValueError: it has another shape or type, or names states that it does not have.
    """
    table = graph.detach().cpu().numpy() if isinstance(graph, Tensor) else np.asarray(graph)
    if table.ndim != 2 or table.dtype.kind not in "iu":
        raise ValueError(f"graph must be an integer table (N, A), not {table.dtype} {table.shape}")
    if table.size and (table.min() < -1 or table.max() >= len(table)):
        raise ValueError(
            f"graph holds {table.min()}..{table.max()}; states are 0..{len(table) - 1}, blocked is -1"
        )
    return table.astype(np.int64, copy=False)


def as_states(states: Any, num_states: int, role: str) -> np.ndarray:
    """State ids as an int64 array (K,), checked; ``role`` says what they are in the message.

    Raises:
        GoalError: one is not a state of the graph.
    """
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
    """Default names of actions: those of the THOR v1 dumps when there are four, numbers for any other count.

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
    table = as_table(graph)
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
    table = as_table(graph)
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
    table = as_table(graph)
    backwards = _edges(table).T.tocsr()
    return torch.from_numpy(_breadth_first(backwards, as_states(goals, len(table), "goal")).astype(np.int64))


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
    return _components(as_table(graph), "weak")


def strong_components(graph: Tensor | np.ndarray) -> tuple[tuple[int, ...], ...]:
    """States that can all reach one another, as sorted tuples, the largest component first.

    >>> strong_components(torch.tensor([[1], [-1], [3], [2], [2]]))
    ((2, 3), (0,), (1,), (4,))
    """
    return _components(as_table(graph), "strong")


__getattr__ = moved_names(
    __name__,
    {
        name: f"vusfa.scenes.markov.{name}"
        for name in ("arrival_probability", "policy_success", "random_walk_success", "success_over_starts")
    },
)
