"""Searchers against the best ones of small graphs, found by dynamic programming."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from itertools import pairwise

import hypothesis.strategies as st
import pytest
import torch
from hypothesis import given, settings
from torch import Tensor

from vusfa.errors import SceneError
from vusfa.evaluation import Episodes, evaluate_searchers
from vusfa.evaluation.searchers import NEVER, SEARCHERS, one_new_state_per_action, search_times
from vusfa.scenes import Scene, SceneSet
from vusfa.scenes.graph import shortest_path_distances
from vusfa.scenes.views import places_in_view


@st.composite
def graphs(draw: st.DrawFn) -> Tensor:
    """Up to seven states and three actions; every state can be reached from every other."""
    size = draw(st.integers(2, 7))
    ring = [(state + 1) % size for state in range(size)]
    rest = draw(st.lists(st.lists(st.integers(-1, size - 1), min_size=size, max_size=size), max_size=2))
    return torch.tensor([ring, *rest]).T


def best_mean(graph: Tensor, seen: list[list[bool]], start: int) -> float:
    """Smallest mean time: over which goals are recognized and where the searcher is."""
    away, size = shortest_path_distances(graph).tolist(), len(graph)

    def after(known: frozenset[int], here: int) -> tuple[frozenset[int], int]:
        new = {goal for goal in range(size) if seen[here][goal] and goal not in known}
        return known | new, sum(away[here][goal] for goal in new)

    @cache
    def cost(known: frozenset[int], here: int) -> int:
        known, walked = after(known, here)
        left = size - len(known)
        return walked + min(
            (
                away[here][there] * left + cost(known, there)
                for there in range(size)
                if after(known, there)[0] != known
            ),
            default=0,
        )

    return cost(frozenset(), start) / (size - 1)


def best_over_walks(graph: Tensor, start: int, limit: int) -> tuple[int, float]:
    """Most states visited within ``limit`` actions, and largest sum of d / T over goals, of all walks."""
    away = shortest_path_distances(graph).tolist()[start]

    @cache
    def found(visited: frozenset[int], here: int, time: int) -> tuple[int, float]:
        gain = (0, 0.0) if here in visited else (1, away[here] / max(time, 1))
        if time == limit:
            return gain
        ahead = [there for there in graph[here].tolist() if there >= 0]
        onward = [found(visited | {here}, there, time + 1) for there in ahead]
        return gain[0] + max(one for one, _ in onward), gain[1] + max(two for _, two in onward)

    states, spl = found(frozenset(), start, 0)
    return states - 1, spl


@settings(max_examples=25, derandomize=True)
@given(graphs(), st.data())
def test_between_the_best_searcher_and_what_was_shown(graph: Tensor, data: st.DataObject) -> None:
    size = len(graph)
    rows = st.lists(st.booleans(), min_size=size, max_size=size)
    drawn = data.draw(st.lists(rows, min_size=size, max_size=size))
    seen = [[here == goal or drawn[here][goal] for goal in range(size)] for here in range(size)]
    only = [[here == goal for goal in range(size)] for here in range(size)]
    distance = shortest_path_distances(graph).long()
    found = search_times(graph)
    in_view = search_times(graph, torch.tensor(seen))
    bound = one_new_state_per_action(graph)
    for table in (found, in_view, bound):
        assert (table >= distance).all()
    for start in range(size):
        best = best_mean(graph, only, start) * (size - 1)
        assert bound[start].sum() <= best + 1e-9
        assert best - 1e-9 <= found[start].sum() <= 1.35 * best
        best = best_mean(graph, seen, start) * (size - 1)
        assert best - 1e-9 <= in_view[start].sum() <= 1.6 * best


@settings(max_examples=15)
@given(graphs())
def test_times_are_those_of_a_walk(graph: Tensor) -> None:
    distance = shortest_path_distances(graph).tolist()
    for start, times in enumerate(search_times(graph).tolist()):
        order = sorted(range(len(graph)), key=times.__getitem__)
        assert order[0] == start
        for one, other in pairwise(order):
            assert times[other] - times[one] >= max(1, distance[one][other])


@settings(max_examples=15)
@given(graphs())
def test_no_walk_is_above_the_bound(graph: Tensor) -> None:
    limit = 9
    distance, bound = shortest_path_distances(graph).double(), one_new_state_per_action(graph)
    for start in range(len(graph)):
        states, spl = best_over_walks(graph, start, limit)
        times = bound[start]
        assert states <= int(((times > 0) & (times <= limit)).sum())
        within = (times > 0) & (times <= limit)
        assert spl <= float((distance[start][within] / times[within]).sum()) + 1e-9


def test_what_cannot_be_reached_is_not_found() -> None:
    one_way = torch.tensor([[1, 2], [-1, -1], [0, -1]])  # 1 cannot be left
    times = search_times(one_way).tolist()
    assert times[1] == [NEVER, 0, NEVER]
    assert times[2][0] == 1
    assert sum(time < NEVER for time in times[0]) >= 2
    assert one_new_state_per_action(one_way)[1].tolist() == [NEVER, 0, NEVER]
    everywhere = search_times(one_way, torch.ones(3, 3, dtype=torch.bool))
    assert everywhere.tolist() == [[0, 1, 1], [NEVER, 0, NEVER], [1, 2, 0]]


def test_episodes_of_searchers(make_scene: Callable[..., Scene]) -> None:
    """The same starts and goals, one row each; the numbers are those of the tables."""
    rooms = SceneSet([make_scene("hall", 3, 2), make_scene("attic", 2, 2)])
    scene, start = torch.tensor([0, 0, 1]), torch.tensor([3, 20, 0])
    goal = torch.tensor([20, 3, 13])
    shortest = rooms.distance(start + rooms.offsets[scene], goal + rooms.offsets[scene])
    none = torch.zeros(3, dtype=torch.int64)
    lost = Episodes(
        scene, goal, start, none > 0, none + 12, shortest, none + 2, none > 0, rooms.names, 12, none
    )
    found = evaluate_searchers(lost, rooms)
    assert tuple(found) == SEARCHERS
    hall, attic = rooms.scenes
    for mode, tables in {
        "map-goal-unknown": [search_times(room.graph) for room in (hall, attic)],
        "map-goal-in-view": [search_times(room.graph, places_in_view(room)) for room in (hall, attic)],
        "new-state-per-action": [one_new_state_per_action(room.graph) for room in (hall, attic)],
        "shortest-path": [room.distance.long() for room in (hall, attic)],
    }.items():
        times = torch.stack([tables[s][a, g] for s, a, g in zip(scene, start, goal, strict=True)])
        assert found[mode].length.tolist() == times.clamp(max=12).tolist()
        assert found[mode].success.tolist() == (times <= 12).tolist()
        assert not found[mode].collisions.any()
        assert torch.equal(found[mode].start, start)


def test_a_large_scene_is_refused(monkeypatch: pytest.MonkeyPatch, make_scene: Callable[..., Scene]) -> None:
    monkeypatch.setattr("vusfa.evaluation.searchers.MAX_STATES", 15)
    with pytest.raises(SceneError, match=r"'hall' has 16 states.*at most 15.*searchers=false"):
        evaluate_searchers(
            Episodes(*[torch.zeros(0).long()] * 8, ("hall",), 500), SceneSet([make_scene("hall")])
        )
