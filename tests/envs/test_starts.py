"""Where episodes begin."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from vusfa.envs.starts import DRAW_LIMIT, draw_goals, draw_starts, path_table, paths_from, start_table
from vusfa.errors import GoalError
from vusfa.scenes import Scene, SceneSet


def table_of(graphs: list[list[list[int]]], goals: list[int]):
    sizes = torch.tensor([0, *(len(graph) for graph in graphs)])
    names = [f"scene {i}" for i in range(len(graphs))]
    return start_table([torch.tensor(g) for g in graphs], sizes.cumsum(0), torch.tensor(goals), names)


def reachable_from(graph: list[list[int]], start: int) -> set[int]:
    """Plain Python, to compare with."""
    found, todo = {start}, [start]
    while todo:
        for target in graph[todo.pop()]:
            if target >= 0 and target not in found:
                found.add(target)
                todo.append(target)
    return found


def possible_starts(graph: list[list[int]], goal: int) -> list[int]:
    return [s for s in range(len(graph)) if s != goal and goal in reachable_from(graph, s)]


@st.composite
def graphs(draw: st.DrawFn) -> list[list[list[int]]]:
    actions = draw(st.integers(1, 3))
    scenes = []
    for _ in range(draw(st.integers(1, 3))):
        size = draw(st.integers(2, 7))
        row = st.lists(st.integers(-1, size - 1), min_size=actions, max_size=actions)
        scenes.append(draw(st.lists(row, min_size=size, max_size=size)))
    return scenes


@settings(max_examples=150)
@given(graphs())
def test_every_start_and_no_other_equally_often(graphs: list[list[list[int]]]) -> None:
    """Drawing k times the number of starts, one integer after the other, meets each exactly k times."""
    first = 0
    for index, graph in enumerate(graphs):
        for goal in range(len(graph)):
            expected = possible_starts(graph, goal)
            if not expected:
                with pytest.raises(GoalError, match=f"'scene {index}': no other state can reach goal {goal}"):
                    table_of(graphs, [first + goal])
                continue
            table = table_of(graphs, [first + goal])
            draws = torch.arange(3 * len(expected))
            goals = table.goals.take(torch.zeros_like(draws))
            found = draw_starts(table.members, goals, draws).tolist()
            assert sorted(found) == sorted([first + s for s in expected] * 3)
        first += len(graph)


@settings(max_examples=50)
@given(graphs())
def test_all_goals_together_are_as_each_alone(graphs: list[list[list[int]]]) -> None:
    first, goals, expected = 0, [], []
    for graph in graphs:
        for goal in range(len(graph)):
            if possible_starts(graph, goal):
                goals.append(first + goal)
                expected.append([first + s for s in possible_starts(graph, goal)])
        first += len(graph)
    if not goals:
        return
    table = table_of(graphs, goals)
    for slot, wanted in enumerate(expected):
        draws = torch.arange(len(wanted))
        assert (
            sorted(draw_starts(table.members, table.goals.take(draws * 0 + slot), draws).tolist()) == wanted
        )


def test_draws_are_uniform() -> None:
    ring = [[(i + 1) % 7] for i in range(7)]
    table = table_of([ring], [3])
    generator = torch.Generator().manual_seed(0)
    draws = torch.randint(DRAW_LIMIT, (60_000,), generator=generator)
    counts = draw_starts(table.members, table.goals.take(draws * 0), draws).bincount(minlength=7)
    assert counts[3] == 0
    # six starts, 10,000 each; five standard deviations are 456
    assert (counts[counts > 0] - 10_000).abs().max() < 456


def test_goals_are_uniform_over_scenes_first() -> None:
    """One goal in the first scene weighs as much as three in another; one without goals is never drawn."""
    pair, ring = [[1], [0]], [[1], [2], [0]]
    table = table_of([pair, pair, ring], [4, 0, 5, 6])  # not sorted by scene
    scene, goal = (x.flatten() for x in torch.meshgrid(torch.arange(6), torch.arange(6), indexing="ij"))
    drawn = draw_goals(table, scene, goal)
    assert drawn.goal.bincount(minlength=7).tolist() == [18, 0, 0, 0, 6, 6, 6]
    assert torch.equal(drawn.scene, torch.where(drawn.goal == 0, 0, 2))


def test_paths_are_looked_up_in_the_scenes_own_table() -> None:
    ring, pair = torch.tensor([[1], [2], [0]]), torch.tensor([[1], [0]])
    scenes = SceneSet([Scene("pair", pair, torch.rand(2, 1, 2)), Scene("ring", ring, torch.rand(3, 1, 2))])
    table = start_table([s.graph for s in scenes.scenes], scenes.offsets, torch.tensor([1, 4]), scenes.names)
    state = torch.tensor([0, 2, 3, 4])
    goals = table.goals.take(torch.tensor([0, 1, 1, 1]))
    paths = path_table(scenes, table.goals)
    assert paths is not None
    assert paths_from(paths, goals, state).tolist() == [1, 2, 1, 0]


def test_two_hundred_thousand_states_take_memory_for_few_lists() -> None:
    """A ring whose states are all goals: one list serves them all; a list each would take 320 GB."""
    size = 200_000
    ring = ((torch.arange(size) + 1) % size).unsqueeze(1)
    table = start_table([ring], torch.tensor([0, size]), torch.arange(size), ["ring"])
    columns = [*table.goals, table.members, table.order, table.scene_first, table.scene_goals]
    assert sum(column.numel() for column in columns) < 10 * size
    draws = torch.tensor([0, size - 2, size - 1])
    assert draw_starts(table.members, table.goals.take(torch.tensor([0, 0, 5])), draws).tolist() == [
        1,
        size - 1,
        0,
    ]
