"""Shortest paths of a scene: one table for a small scene, otherwise cached searches per goal."""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from vusfa.errors import SceneError
from vusfa.limits import MAX_DISTANCE_STATES, MAX_PATH_BYTES
from vusfa.scenes.graph import BackwardSearch, narrow_distances, shortest_path_distances

if TYPE_CHECKING:
    from vusfa.scenes.scene import Scene

__all__ = ["DistanceField", "ShortestPaths"]


class DistanceField:
    """The field ``Scene.distance``: the given table, until it is checked; then a table made on request."""

    def __get__(self, scene: Scene | None, owner: type) -> Any:
        return None if scene is None else scene._paths.table

    def __set__(self, scene: Scene, value: Any) -> None:
        vars(scene)["_distance"] = value


class ShortestPaths:
    """Shortest paths of one graph, in actions; -1 where there is none.

    Args:
        graph: (N, A) int64, -1 = blocked; not copied.
        table: (N, N), ``[s, g]`` from s to g, if known. Without one, the paths to a goal are
            searched on first request, and the latest :data:`vusfa.limits.MAX_PATH_BYTES` are kept.

    >>> paths = ShortestPaths(np.array([[1, -1], [2, 0], [-1, 1]]))
    >>> paths.to_goals(torch.tensor([2])).tolist(), paths.between(torch.tensor([0, 1]), torch.tensor([1, 1]))
    ([[2, 1, 0]], tensor([1, 0]))
    """

    def __init__(self, graph: np.ndarray, table: np.ndarray | None = None) -> None:
        self.graph = graph
        self._table = None if table is None else narrow_distances(table)
        self._kept: OrderedDict[int, np.ndarray] = OrderedDict()
        self._search: BackwardSearch | None = None

    @property
    def table(self) -> Tensor:
        """(N, N) int16, or int32 where a path is too long for it; computed once.

        Raises:
            SceneError: more than :data:`vusfa.limits.MAX_DISTANCE_STATES` states.
        """
        if self._table is None:
            if len(self.graph) > MAX_DISTANCE_STATES:
                raise SceneError(
                    f"a table of all shortest paths of {len(self.graph)} states is too large (at most"
                    f" {MAX_DISTANCE_STATES}); ask for the paths to some goals, scene.distances_to(goals)"
                )
            self._table = shortest_path_distances(self.graph)
        return self._table

    def to_goals(self, goals: Tensor) -> Tensor:
        """Paths (G, N) from every state to goals (G,), int16 or int32."""
        if self._table is not None:
            return self._table[:, goals].T
        columns = [self._column(goal) for goal in goals.tolist()]
        return torch.from_numpy(np.stack(columns) if columns else np.empty((0, len(self.graph)), np.int16))

    def between(self, state: Tensor, goal: Tensor) -> Tensor:
        """Paths (n,) int64 from states (n,) to goals (n,)."""
        if self._table is not None:
            return self._table[state, goal].to(torch.int64)
        found = torch.empty_like(state)
        goals, index = goal.unique(return_inverse=True)
        for place, one in enumerate(goals.tolist()):
            rows = index == place
            found[rows] = torch.from_numpy(self._column(one))[state[rows]].to(torch.int64)
        return found

    def _column(self, goal: int) -> np.ndarray:
        """Paths (N,) to one goal."""
        if goal in self._kept:
            self._kept.move_to_end(goal)
            return self._kept[goal]
        if self._search is None:
            self._search = BackwardSearch(self.graph)
        found = self._kept[goal] = self._search(goal)
        while len(self._kept) > 1 and len(self._kept) * found.nbytes > MAX_PATH_BYTES:
            self._kept.popitem(last=False)
        return found

    def __getstate__(self) -> dict[str, object]:
        return {**vars(self), "_kept": OrderedDict(), "_search": None}
