"""Poses and moves in a room: the free places of its grid, the moves between them, the graph of states.

State = headings * place + heading, places sorted by column and row; actions MoveForward, RotateRight,
RotateLeft, MoveBackward. Only the largest connected set of places is kept, so that every state reaches every
other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from vusfa.errors import SceneError
from vusfa.sources.render.outline import Rect
from vusfa.sources.render.plan import Grid, Plan

__all__ = ["Poses", "free_cells", "is_free", "poses"]

Cell = tuple[int, int]
# Shares of the way between two places where the body must be free, too.
_ON_THE_WAY = (0.25, 0.5, 0.75)


@dataclass(frozen=True, eq=False)
class Poses:
    """All states of a room.

    Args:
        cells: (column, row) of each place.
        graph: (N, 4) int64, next state, -1 = blocked.
        location: (N, 2) float32, metres.
        rotation: (N,) float32, degrees.
        cut_off: free places that were dropped because the largest free region does not reach them.
    """

    cells: tuple[Cell, ...]
    graph: np.ndarray
    location: np.ndarray
    rotation: np.ndarray
    cut_off: int

    @property
    def num_states(self) -> int:
        """N."""
        return len(self.graph)


def is_free(
    x: np.ndarray, z: np.ndarray, size: Sequence[float], obstacles: Sequence[Rect], radius: float
) -> np.ndarray:
    """Whether a round body clears the walls of a rectangle and all obstacles, for many places.

    Args:
        x: metres, any shape.
        z: the same shape.
        size: (width, depth, ...) of the room.
        obstacles: rectangles.
        radius: metres.

    Returns:
        bool of that shape.

    >>> is_free(np.array([0.2, 1.0, 1.9]), np.array([1.0, 1.0, 1.0]), (4.0, 2.0), [(2.0, 0, 3, 2)], 0.25)
    array([False,  True, False])
    """
    inside = (radius <= x) & (x <= size[0] - radius) & (radius <= z) & (z <= size[1] - radius)
    if len(obstacles):
        rects = np.array(obstacles, dtype=np.float64)
        dx = np.maximum(np.maximum(rects[:, 0] - x[..., None], x[..., None] - rects[:, 2]), 0)
        dz = np.maximum(np.maximum(rects[:, 1] - z[..., None], z[..., None] - rects[:, 3]), 0)
        inside &= np.all(dx * dx + dz * dz >= radius**2 - 1e-9, axis=-1)
    return inside


def _steps(headings: int) -> list[Cell]:
    """The step forward of each heading, in places; heading 0 along +Z, then clockwise."""
    turns = [2 * math.pi * k / headings for k in range(headings)]
    # 1.2 rounds the sine of 45 degrees up to 1
    return [(round(1.2 * math.sin(turn)), round(1.2 * math.cos(turn))) for turn in turns]


def free_cells(
    shape: Cell, size: Sequence[float], obstacles: Sequence[Rect], grid: Grid
) -> tuple[list[Cell], set[tuple[Cell, Cell]], int]:
    """Find the largest connected set of free places.

    Args:
        shape: places along X and Z, free or not.
        size: (width, depth, ...) of the room.
        obstacles: what blocks.
        grid: the grid.

    Returns:
        Its places, sorted; the moves between them, as pairs of places, both ways; and how many free places
        it does not reach.
    """
    i, j = (axis.ravel() for axis in np.meshgrid(np.arange(shape[0]), np.arange(shape[1]), indexing="ij"))

    def free_at(columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
        x, z = (grid.origin[0] + grid.step * columns, grid.origin[1] + grid.step * rows)
        return is_free(x, z, size, obstacles, grid.radius)

    ok = free_at(i, j).reshape(shape)
    ends: list[tuple[np.ndarray, np.ndarray]] = []
    number = np.arange(shape[0] * shape[1]).reshape(shape)
    for di, dj in _steps(grid.headings)[: grid.headings // 2]:
        inside = (i + di >= 0) & (i + di < shape[0]) & (j + dj >= 0) & (j + dj < shape[1])
        a, b = number[i[inside], j[inside]], number[i[inside] + di, j[inside] + dj]
        joined = ok.ravel()[a] & ok.ravel()[b]
        a, b = a[joined], b[joined]
        clear = np.ones(len(a), bool)
        for share in _ON_THE_WAY:
            clear &= free_at(i[a] + di * share, j[a] + dj * share)
        ends.append((a[clear], b[clear]))
    a, b = (np.concatenate(side) for side in zip(*ends, strict=True))
    num_free = int(ok.sum())
    if not num_free:
        return [], set(), 0
    edges = sparse.coo_matrix((np.ones(len(a)), (a, b)), shape=(number.size, number.size))
    _, label = connected_components(edges, directed=False)
    label = np.where(ok.ravel(), label, -1)
    kept_label = np.bincount(label[label >= 0]).argmax()
    cells = [(int(i[k]), int(j[k])) for k in np.flatnonzero(label == kept_label)]
    moves = set()
    for p, q in zip(a.tolist(), b.tolist(), strict=True):
        if label[p] == kept_label:
            start, end = (int(i[p]), int(j[p])), (int(i[q]), int(j[q]))
            moves |= {(start, end), (end, start)}
    return cells, moves, num_free - len(cells)


def poses(plan: Plan) -> Poses:
    """Make all states of a plan whose furniture has sizes (:meth:`Plan.completed`).

    Raises:
        SceneError: no place is free.

    >>> room = poses(Plan("cell", size=(1.6, 1.1, 2.6)))
    >>> room.num_states, room.location[4].tolist(), room.graph[0].tolist()
    (24, [0.30000001192092896, 0.800000011920929], [4, 1, 3, -1])
    """
    grid = plan.grid
    cells, moves, cut_off = free_cells(plan.num_places, plan.size, plan.obstacles, grid)
    if not cells:
        raise SceneError(
            f"plan {plan.name!r}: no place of the grid is free; make the room larger, move furniture, or"
            f" change grid.origin, grid.step or grid.radius"
        )
    index = {cell: k for k, cell in enumerate(cells)}
    turns = grid.headings
    graph = np.full((turns * len(cells), 4), -1, np.int64)
    for cell, k in index.items():
        for heading, (di, dj) in enumerate(_steps(turns)):
            state = turns * k + heading
            ahead, behind = (cell[0] + di, cell[1] + dj), (cell[0] - di, cell[1] - dj)
            if (cell, ahead) in moves:
                graph[state, 0] = turns * index[ahead] + heading
            graph[state, 1] = turns * k + (heading + 1) % turns
            graph[state, 2] = turns * k + (heading - 1) % turns
            if (cell, behind) in moves:
                graph[state, 3] = turns * index[behind] + heading
    places = np.array(cells) * grid.step + np.array(grid.origin)
    return Poses(
        cells=tuple(cells),
        graph=graph,
        location=np.repeat(places, turns, axis=0).astype(np.float32),
        rotation=np.tile(np.arange(turns) * (360 / turns), len(cells)).astype(np.float32),
        cut_off=cut_off,
    )
