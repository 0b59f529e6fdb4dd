"""Successor table, shortest paths and components of a scene's graph.

A graph is an integer table (N, A), tensor or array: ``graph[s, a]`` is the state that action ``a`` leads to
from state ``s``, or -1 when the move is blocked: the agent then stays in place, and the action counts. All
functions are pure and return tensors on the CPU. :mod:`vusfa.scenes.markov` computes the success of policies.
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
    "BackwardSearch",
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


def as_table(graph: Tensor | np.ndarray) -> np.ndarray:
    """Check a graph and return it as an int64 array (N, A).

    Raises:
        ValueError: the shape or type is wrong, or a successor is not a state.
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
    """Check state ids and return them as an int64 array (K,); messages call them ``role``.

    Raises:
        GoalError: an id that is not a state.
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
    """Adjacency matrix (N, N)."""
    source, action = np.nonzero(table >= 0)
    target = table[source, action]
    ones = np.ones(len(source), dtype=np.float64)
    return sparse.csr_matrix((ones, (source, target)), shape=(len(table),) * 2)


def _breadth_first(edges: sparse.csr_matrix, sources: np.ndarray) -> np.ndarray:
    """Number of edges from each source to each state, (len(sources), N) int16 or int32, -1 without a path."""
    num_states = edges.shape[0]
    result = np.full((len(sources), num_states), -1, np.int16 if num_states <= 1 << 15 else np.int32)
    position = np.empty(num_states, np.int32)
    for row, source in enumerate(sources.tolist()):
        order, predecessor = csgraph.breadth_first_order(edges, source)
        position[order] = np.arange(len(order), dtype=np.int32)
        ancestor = position[np.append(source, predecessor[order[1:]])]
        depth = np.minimum(np.arange(len(order)), 1)
        while ancestor.any():  # each turn doubles the number of generations
            depth += depth[ancestor]
            ancestor = ancestor[ancestor]
        result[row, order] = depth
    return result


def default_actions(num_actions: int) -> tuple[str, ...]:
    """Default names of actions: those of the THOR v1 dumps for four, numbers for any other count.

    >>> default_actions(4)
    ('MoveForward', 'RotateRight', 'RotateLeft', 'MoveBackward')
    >>> default_actions(2)
    ('action_0', 'action_1')
    """
    if num_actions == 4:
        return ("MoveForward", "RotateRight", "RotateLeft", "MoveBackward")
    return tuple(f"action_{index}" for index in range(num_actions))


def successor_table(graph: Tensor | np.ndarray) -> tuple[Tensor, Tensor]:
    """Successor of every state and action, the state itself for blocked moves.

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


def shortest_path_distances(graph: Tensor | np.ndarray, sources: Any = None) -> Tensor:
    """Lengths of all shortest paths, by breadth-first search.

    Args:
        graph: (N, A) integers, -1 = blocked.
        sources: (K,) states to start from; all of them when None.

    Returns:
        (K, N), ``[s, g]`` in actions, 0 where g is s, -1 where g cannot be reached from s; int16, or int32
        where a path is too long for it.

    >>> shortest_path_distances(torch.tensor([[1, -1], [2, -1], [-1, -1]])).tolist()
    [[0, 1, 2], [-1, 0, 1], [-1, -1, 0]]
    """
    table = as_table(graph)
    starts = np.arange(len(table)) if sources is None else as_states(sources, len(table), "source")
    return narrow_distances(_breadth_first(_edges(table), starts))


def narrow_distances(distance: np.ndarray) -> Tensor:
    """Distances as int16, or as int32 where one is too long for it; a copy unless they are that already.

    >>> narrow_distances(np.array([[0, 32767]])).dtype, narrow_distances(np.array([[0, 32768]])).dtype
    (torch.int16, torch.int32)
    """
    fits = not distance.size or distance.max() <= np.iinfo(np.int16).max
    return torch.from_numpy(distance.astype(np.int16 if fits else np.int32, copy=False))


class BackwardSearch:
    """Lengths of the shortest paths from every state to a goal, by breadth-first search.

    Args:
        graph: (N, A) integers, -1 = blocked.

    >>> BackwardSearch(torch.tensor([[1, -1], [2, -1], [-1, -1]]))(2).tolist()
    [2, 1, 0]
    """

    def __init__(self, graph: Tensor | np.ndarray) -> None:
        self._backwards = _edges(as_table(graph)).T.tocsr()

    def __call__(self, goal: int) -> np.ndarray:
        """(N,) int16, or int32 where a path may be too long for it; -1 where there is none."""
        return _breadth_first(self._backwards, np.array([goal]))[0]


def steps_to_goals(graph: Tensor | np.ndarray, goals: Any) -> Tensor:
    """Lengths of the shortest paths from every state to some goals, by breadth-first search backwards.

    Args:
        graph: (N, A) integers, -1 = blocked.
        goals: one state id, or (G,).

    Returns:
        (G, N) int64, -1 where the goal cannot be reached from the state.

    Raises:
        GoalError: a goal that is not a state.

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
    """Weakly connected components as sorted tuples of states, the largest first.

    >>> weak_components(torch.tensor([[1], [-1], [3], [2], [2]]))
    ((2, 3, 4), (0, 1))
    """
    return _components(as_table(graph), "weak")


def strong_components(graph: Tensor | np.ndarray) -> tuple[tuple[int, ...], ...]:
    """Strongly connected components as sorted tuples of states, the largest first.

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
