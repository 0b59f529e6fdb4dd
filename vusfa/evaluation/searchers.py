"""Searchers that know the room, but not where the goal is: how far an agent in a room never seen can come.

A searcher from a start s chooses a walk before it knows the goal; it recognizes goal g the first time that
the walk is at a state x from which it can be recognized, and goes there along a shortest path. Its time to g
is

    T(s, g) = min over x on the walk with R(x, g) of  (actions to x) + d(x, g)

with R the identity where a goal is only recognized by standing at it. The walk with the smallest mean of
T(s, g) over g, the minimum latency tour, is NP-hard to find (Blum et al. 1994, The minimum latency problem,
STOC). :func:`search_times` gives those of good walks: what a searcher can do, a lower bound on the best
one's result. :func:`one_new_state_per_action` bounds from above what any searcher can do that recognizes a
goal by standing at it; for one that recognizes it from afar, the bound is the shortest path.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from heapq import heappop, heappush

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from vusfa.errors import SceneError
from vusfa.evaluation.baselines import shortest_paths
from vusfa.evaluation.episodes import Episodes
from vusfa.limits import brief
from vusfa.scenes import Scene, SceneSet
from vusfa.scenes.graph import shortest_path_distances, successor_table
from vusfa.scenes.views import grid_cells, places_in_view

__all__ = ["SEARCHERS", "check_searched", "evaluate_searchers", "one_new_state_per_action", "search_times"]

#: Modes of :func:`evaluate_searchers`, in the order of tables.
SEARCHERS = ("map-goal-unknown", "map-goal-in-view", "new-state-per-action", "shortest-path")
#: Time to a goal that a walk does not find.
NEVER = 1 << 20
#: Largest scene: the computing time grows with the cube of the number of states.
MAX_STATES = 2048


def search_times(
    graph: Tensor | np.ndarray, recognized: Tensor | None = None, walks: int = 8, seed: int = 0
) -> Tensor:
    """Actions to every goal from every start, of a searcher that knows the graph but not the goal.

    From each start several walks are made, and the one with the smallest mean time is kept. Each goes to the
    state where most goals not yet recognized can be per action on the way there (the nearest state not yet
    visited, where a goal is only recognized by standing at it), the first with that number, the others with
    numbers changed at random by up to 30 %. Then, as long as it shortens the mean, the walk of a start is
    replaced by a step to a neighbour and that neighbour's walk.

    Args:
        graph: (N, A) integers, -1 = blocked.
        recognized: (N, N) bool, ``[x, g]`` whether goal g is recognized at x; at itself alone by default.
        walks: number of random ones.
        seed: of these.

    Returns:
        (N, N) int64, ``[s, g]`` from s; :data:`NEVER` where the walk does not find a goal, which needs a
        graph in which some state cannot be left for another.

    >>> search_times(torch.tensor([[1, -1], [2, 0], [-1, 1]])).tolist()  # a corridor
    [[0, 1, 2], [1, 0, 3], [2, 1, 0]]
    """
    successor = successor_table(graph)[0].numpy()
    distance = shortest_path_distances(graph).numpy().astype(np.int64)
    distance[distance < 0] = NEVER
    seen = np.eye(len(distance), dtype=bool) if recognized is None else recognized.cpu().numpy()
    seen = seen & (distance < NEVER) | np.eye(len(distance), dtype=bool)
    generator = np.random.default_rng(seed)
    best = _walk(successor, distance, seen, None)
    for _ in range(walks):
        other = _walk(successor, distance, seen, generator)
        best = np.where((other.sum(1) < best.sum(1))[:, None], other, best)
    return torch.from_numpy(_over_neighbours(successor, distance, seen, best))


def _walk(
    successor: np.ndarray, distance: np.ndarray, seen: np.ndarray, noise: np.random.Generator | None
) -> np.ndarray:
    """Times (N, N) of one walk from each start; all walk at once, action by action."""
    size = len(distance)
    alone = np.array_equal(seen, np.eye(size))
    recognizing = None if alone else sparse.csr_matrix(seen.astype(np.float32))
    nearness = np.where((distance > 0) & (distance < NEVER), 1 / np.maximum(distance, 1), 0)
    nearness = nearness.astype(np.float32)
    worth = np.ones((size, size), np.float32)
    if noise is not None:
        worth += 0.3 * noise.random(worth.shape, np.float32)
    here, target = np.arange(size), np.arange(size)
    times, left = np.full((size, size), NEVER), np.ones((size, size), bool)
    for step in range(NEVER):
        start, goal = np.nonzero(left & seen[here])
        times[start, goal] = step + distance[here[start], goal]
        left[start, goal] = False
        idle = np.flatnonzero(~(left & seen[target]).any(1) & left.any(1))
        if len(idle):
            gain = left[idle] if recognizing is None else (recognizing @ left[idle].T.astype(np.float32)).T
            rate = gain * worth[idle] * nearness[here[idle]]
            target[idle] = rate.argmax(1)
            left[idle[rate.max(1) <= 0]] = False  # what is left cannot be reached any more
        if not left.any():
            break
        ahead = successor[here]
        onward = distance[ahead, target[:, None]].argmin(1)
        here = np.where(left.any(1), ahead[np.arange(size), onward], here)
    return times


def _over_neighbours(
    successor: np.ndarray, distance: np.ndarray, seen: np.ndarray, times: np.ndarray
) -> np.ndarray:
    """Shorter times (N, N): one action, and then the walk of the state that it leads to."""
    changed = True
    while changed:
        changed = False
        for ahead in successor.T:
            other = np.where(seen, distance, np.minimum(1 + times[ahead], NEVER))
            better = other.sum(1) < times.sum(1)
            times[better] = other[better]
            changed |= bool(better.any())
    return times


def one_new_state_per_action(graph: Tensor | np.ndarray) -> Tensor:
    """Times to every goal that no searcher improves on who recognizes a goal by standing at it.

    The k-th new state of a walk cannot be reached before its k-th action, nor state g before action d(s, g).
    Of all assignments of different times to goals that obey both, this is the one with the largest SPL: at
    each time the farthest goal that may have it; exchanging two goals shows that no other has a larger one.
    All of them have the same success within any limit. So the means over all goals, drawn uniformly, are
    bounds, where every state can be reached from every other; the single times are not.

    Args:
        graph: (N, A) integers, -1 = blocked.

    Returns:
        (N, N) int64, ``[s, g]`` from s; :data:`NEVER` where there is no path.

    >>> one_new_state_per_action(torch.tensor([[1, -1], [2, 0], [-1, 1]])).tolist()  # a corridor
    [[0, 1, 2], [1, 0, 2], [2, 1, 0]]
    """
    distance = shortest_path_distances(graph).tolist()
    times = torch.full((len(distance), len(distance)), NEVER)
    for start, row in enumerate(distance):
        waiting = sorted((away, goal) for goal, away in enumerate(row) if away > 0)
        allowed: list[tuple[int, int]] = []
        place = 0
        for time in range(1, len(waiting) + 1):
            while place < len(waiting) and waiting[place][0] <= time:
                away, goal = waiting[place]
                heappush(allowed, (-away, goal))
                place += 1
            times[start, heappop(allowed)[1]] = time
        times[start, start] = 0
    return times


def check_searched(scenes: SceneSet) -> None:
    """Refuse scenes that are not for :func:`evaluate_searchers`.

    Raises:
        SceneError: a scene has more than :data:`MAX_STATES` states, or poses on no grid.
    """
    for scene in scenes.scenes:
        grid_cells(scene)
        if scene.num_states > MAX_STATES:
            raise SceneError(
                f"scene {brief(scene.name)} has {scene.num_states} states; searchers that know the map are"
                f" computed for at most {MAX_STATES}: leave them out, searchers=false"
            )


def evaluate_searchers(
    episodes: Episodes, scenes: SceneSet, progress: Callable[[int, int], None] = lambda done, total: None
) -> dict[str, Episodes]:
    """The same starts and goals for searchers that know the map, and for the shortest path.

    Args:
        episodes: of any policy.
        scenes: the world.
        progress: called with the episodes done and their number.

    Returns:
        by mode, those of :data:`SEARCHERS`: a searcher that recognizes the goal by standing at it, and one
        that recognizes it as soon as its place is in view (:func:`vusfa.scenes.views.places_in_view`), both
        along the walks of :func:`search_times`; the bound of :func:`one_new_state_per_action` on the first;
        the shortest path, which bounds the second.

    Raises:
        SceneError: see :func:`check_searched`.

    >>> graph = torch.tensor([[1, -1], [2, 0], [3, 1], [-1, 2]])  # a corridor that looks one way
    >>> place = torch.tensor([[0.0, 0.0], [0.0, 0.5], [0.0, 1.0], [0.0, 1.5]])
    >>> room = SceneSet([Scene("corridor", graph, torch.rand(4, 1, 2), place)])
    >>> one = torch.tensor([1])
    >>> lost = Episodes(one - 1, one * 3, one, one < 0, one * 50, one * 2, one, one < 0, room.names, 50)
    >>> {mode: table.length.item() for mode, table in evaluate_searchers(lost, room).items()}
    {'map-goal-unknown': 4, 'map-goal-in-view': 2, 'new-state-per-action': 2, 'shortest-path': 2}
    """
    check_searched(scenes)
    times = {mode: torch.zeros_like(episodes.length) for mode in SEARCHERS[:3]}
    done = 0
    for index in episodes.scene.unique().tolist():
        rows = episodes.scene == index
        progress(done, len(episodes))
        for mode, table in zip(times, _tables(scenes.scenes[index]), strict=True):
            times[mode][rows] = table[episodes.start[rows], episodes.goal[rows]]
        done += int(rows.sum())
    progress(done, len(episodes))
    found = {}
    for mode, time in times.items():
        arrived = (time <= episodes.max_steps) & (episodes.shortest > 0)
        length = torch.where(arrived, time, episodes.max_steps)
        none = torch.zeros_like(length)
        found[mode] = replace(episodes, success=arrived, length=length, collisions=none, remaining=None)
    return {**found, SEARCHERS[3]: replace(shortest_paths(episodes), remaining=None)}


def _tables(scene: Scene) -> tuple[Tensor, Tensor, Tensor]:
    in_view = search_times(scene.graph, places_in_view(scene))
    return search_times(scene.graph), in_view, one_new_state_per_action(scene.graph)
