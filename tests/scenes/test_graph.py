"""Graph functions against networkx, plain-Python transcriptions and the rooms' published numbers."""

from __future__ import annotations

import time

import networkx as nx
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from vusfa.errors import GoalError
from vusfa.scenes import Scene, bundled_names, markov
from vusfa.scenes import graph as graphs
from vusfa.scenes.validation import distance_faults


@st.composite
def random_graphs(draw: st.DrawFn, max_states: int = 12, max_actions: int = 4) -> np.ndarray:
    """(N, A) tables with blocked moves, self-loops, islands and one-way doors."""
    num_states = draw(st.integers(1, max_states))
    num_actions = draw(st.integers(1, max_actions))
    seed = draw(st.integers(0, 2**32 - 1))
    blocked = draw(st.sampled_from([0.0, 0.3, 0.8, 1.0]))
    rng = np.random.default_rng(seed)
    table = rng.integers(0, num_states, (num_states, num_actions))
    table[rng.random(table.shape) < blocked] = -1
    return table


def as_networkx(table: np.ndarray) -> nx.DiGraph:
    graph = nx.DiGraph()
    graph.add_nodes_from(range(len(table)))
    graph.add_edges_from((s, int(t)) for s, row in enumerate(table) for t in row if t >= 0)
    return graph


def success_by_hand(
    table: np.ndarray, policy: np.ndarray, goal: int, steps: int, starts: list[int] | None = None
) -> float:
    """Plain Python, forwards: the distribution of one walker, from each start in turn, the goal absorbing."""
    num_states, num_actions = table.shape
    reachable = nx.ancestors(as_networkx(table), goal)
    total, counted = 0.0, 0
    for start in range(num_states):
        if start == goal or start not in reachable or (starts is not None and start not in starts):
            continue
        at = [0.0] * num_states
        at[start] = 1.0
        for _ in range(steps):
            then = [0.0] * num_states
            for state in range(num_states):
                if state == goal:
                    then[goal] += at[goal]
                    continue
                for action in range(num_actions):
                    target = int(table[state, action])
                    then[state if target < 0 else target] += at[state] * policy[state, action]
            at = then
        total += at[goal]
        counted += 1
    return total / counted if counted else float("nan")


@given(random_graphs())
def test_shortest_paths_are_those_of_networkx(table: np.ndarray) -> None:
    lengths = dict(nx.all_pairs_shortest_path_length(as_networkx(table)))
    expected = [[lengths[s].get(g, -1) for g in range(len(table))] for s in range(len(table))]
    found = graphs.shortest_path_distances(torch.from_numpy(table))
    assert found.dtype == torch.int16
    assert found.tolist() == expected
    goals = list(range(0, len(table), 2))
    assert graphs.steps_to_goals(table, goals).tolist() == [[row[g] for row in expected] for g in goals]


@given(random_graphs())
def test_components_are_those_of_networkx(table: np.ndarray) -> None:
    graph = as_networkx(table)
    weak, strong = graphs.weak_components(table), graphs.strong_components(table)
    assert set(map(frozenset, weak)) == set(map(frozenset, nx.weakly_connected_components(graph)))
    assert set(map(frozenset, strong)) == set(map(frozenset, nx.strongly_connected_components(graph)))
    for parts in (weak, strong):
        assert [len(part) for part in parts] == sorted(map(len, parts), reverse=True)
        assert all(part == tuple(sorted(part)) for part in parts)


@given(random_graphs())
def test_blocked_moves_stay_in_place(table: np.ndarray) -> None:
    successor, blocked = graphs.successor_table(table)
    for state, row in enumerate(table.tolist()):
        assert successor[state].tolist() == [state if target < 0 else target for target in row]
        assert blocked[state].tolist() == [target < 0 for target in row]


@given(random_graphs(max_states=7), st.integers(0, 12))
def test_random_walk_is_that_of_the_transcription(table: np.ndarray, steps: int) -> None:
    num_states = len(table)
    uniform = np.full(table.shape, 1 / table.shape[1])
    found = markov.random_walk_success(table, range(num_states), steps)
    expected = [success_by_hand(table, uniform, goal, steps) for goal in range(num_states)]
    np.testing.assert_allclose(found.numpy(), expected, rtol=0, atol=1e-12)


@given(random_graphs(max_states=7), st.integers(0, 12), st.integers(0, 1000))
def test_policy_success_is_that_of_the_transcription(table: np.ndarray, steps: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    num_states, num_actions = table.shape
    goals = rng.integers(0, num_states, size=4)
    policies = rng.dirichlet(np.full(num_actions, 0.3), size=(4, num_states))
    one_each = markov.policy_success(table, torch.from_numpy(policies), torch.from_numpy(goals), steps)
    expected = [success_by_hand(table, p, int(g), steps) for p, g in zip(policies, goals, strict=True)]
    np.testing.assert_allclose(one_each.numpy(), expected, rtol=0, atol=1e-12)
    shared = markov.policy_success(table, policies[0], goals, steps)
    expected = [success_by_hand(table, policies[0], int(goal), steps) for goal in goals]
    np.testing.assert_allclose(shared.numpy(), expected, rtol=0, atol=1e-12)


def test_numbers_worked_out_by_hand() -> None:
    # States 0-1-2 in a line; action 0 right, action 1 left; both ends blocked.
    line = torch.tensor([[1, -1], [2, 0], [-1, 1]])
    assert graphs.shortest_path_distances(line).tolist() == [[0, 1, 2], [1, 0, 1], [2, 1, 0]]
    # To state 2 in 3 steps: from 1 by R, LRR (1/2 + 1/8); from 0 by RR*, BRR (1/4 + 1/8).
    assert markov.arrival_probability(line, torch.full((3, 2), 0.5), 2, 3).tolist() == [[3 / 8, 5 / 8, 1.0]]
    assert markov.random_walk_success(line, 2, 3).tolist() == [0.5]
    assert markov.random_walk_success(line, [0, 1], 0).tolist() == [0.0, 0.0]


def test_unreachable_pairs_are_left_out_and_goals_that_none_reaches_are_nan() -> None:
    # 0 <-> 1, and 2 alone: state 2 can only ever be left.
    graph = torch.tensor([[1], [0], [0]])
    assert graphs.steps_to_goals(graph, [0, 2]).tolist() == [[0, 1, 1], [-1, -1, 0]]
    found = markov.random_walk_success(graph, [0, 2], 1)
    assert found[0] == 1.0
    assert found[1].isnan()
    assert markov.random_walk_success(graph, 1, 2).tolist() == [1.0]
    assert markov.random_walk_success(graph, 1, 1).tolist() == [0.5]  # from 0 yes, from 2 not yet


def test_float32_softmax_is_taken_for_a_distribution() -> None:
    line = torch.tensor([[1, -1], [2, 0], [-1, 1]])
    torch.manual_seed(0)
    policy = torch.randn(3, 2).softmax(-1)
    found = markov.policy_success(line, policy, 2, 40)
    exact = policy.double() / policy.double().sum(-1, keepdim=True)
    assert abs(float(found) - success_by_hand(line.numpy(), exact.numpy(), 2, 40)) < 1e-12


def test_many_blocks_of_goals_join_up(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    table = rng.integers(-1, 20, (20, 3))
    policies = rng.dirichlet(np.ones(3), size=(20, 20))
    uniform = np.full((20, 3), 1 / 3)
    whole = [markov.arrival_probability(table, policy, range(20), 9) for policy in (policies, uniform)]
    monkeypatch.setattr(markov, "goals_at_once", lambda states, per_goal: 3)
    parts = [markov.arrival_probability(table, policy, range(20), 9) for policy in (policies, uniform)]
    assert torch.equal(parts[0], whole[0])
    assert torch.equal(parts[1], whole[1])


def test_distances_are_right_exactly_when_they_obey_bellmans_equation() -> None:
    rng = np.random.default_rng(5)
    for _ in range(60):
        size = int(rng.integers(1, 12))
        table = rng.integers(-1, size, (size, 2))
        distance = graphs.shortest_path_distances(table).numpy()
        assert distance_faults(table, distance) == []
        assert distance_faults(table, distance.astype(np.int64)) == []
        changed = distance.copy()
        start, goal = rng.integers(0, size, 2)
        changed[start, goal] += rng.choice([-3, -1, 1, 2, 300])
        (fault,) = distance_faults(table, changed)
        wrong, right = changed[start, goal], distance[start, goal]
        assert f"state {start} to state {goal}: {wrong}, but by the graph it is {right};" in fault


def test_all_distances_of_one_too_many_are_noticed() -> None:
    ring = np.array([[1], [2], [0]])
    distance = graphs.shortest_path_distances(ring).numpy()
    assert distance_faults(ring, distance + 1)
    assert distance_faults(ring, np.where(distance == 0, 3, distance))  # a whole way round


def test_paths_longer_than_int16_holds() -> None:
    length = 40_000
    chain = torch.arange(1, length + 1).unsqueeze(1)
    chain[-1] = -1
    assert graphs.steps_to_goals(chain, length - 1)[0, 0] == length - 1


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda g: markov.random_walk_success(g, [3], 5), GoalError, "goal 3 is not a state.*0..2"),
        (lambda g: markov.random_walk_success(g, [-1], 5), GoalError, "goal -1 is not a state"),
        (lambda g: graphs.steps_to_goals(g, [0.5]), GoalError, "integer state ids"),
        (lambda g: markov.random_walk_success(g, [0], -1), ValueError, "steps is -1"),
        (
            lambda g: markov.policy_success(g, torch.ones(3, 3), [0], 5),
            ValueError,
            r"shape \(3, 3\); give \(3, 2\)",
        ),
        (
            lambda g: markov.policy_success(g, torch.ones(3, 2), [0], 5),
            ValueError,
            r"at \(0,\) is \[1.0, 1.0\]",
        ),
        (
            lambda g: markov.policy_success(g, torch.full((3, 2), torch.nan), [0], 5),
            ValueError,
            "not a distribution",
        ),
        (
            lambda g: markov.policy_success(g, torch.tensor([[1.5, -0.5]] * 3), [0], 5),
            ValueError,
            "not a distribution",
        ),
        (lambda g: graphs.shortest_path_distances(g + 5), ValueError, "states are 0..2"),
        (lambda g: graphs.shortest_path_distances(g.float()), ValueError, "integer table"),
    ],
)
def test_bad_arguments_are_named(call, error, words) -> None:
    with pytest.raises(error, match=words):
        call(torch.tensor([[1, -1], [2, 0], [-1, 1]]))


# As another program measured them: mean and longest shortest path, success of a random walk in 500 steps.
MEASURED = {
    "bathroom": (8.1, 21, 0.566),
    "bedroom": (10.8, 33, 0.334),
    "kitchen": (13.0, 36, 0.219),
    "living_room": (15.6, 41, 0.254),
}


def test_bundled_rooms_have_their_published_numbers() -> None:
    assert bundled_names() == tuple(MEASURED)
    success = []
    for name, (mean, longest, walk) in MEASURED.items():
        room = Scene.bundled(name)
        between = room.distance[~torch.eye(room.num_states, dtype=torch.bool)].double()
        assert float(between.min()) == 1  # every pair is reachable
        assert round(float(between.mean()), 1) == mean
        assert int(between.max()) == longest
        success.append(markov.random_walk_success(room.graph, torch.arange(room.num_states), 500))
        assert round(float(success[-1].mean()), 3) == walk
    assert round(float(torch.cat(success).mean()), 3) == 0.291


def test_random_walk_of_a_room_is_that_of_dense_matrix_powers() -> None:
    room = Scene.bundled("bathroom")
    goal, num_states = 26, room.num_states
    transition = np.zeros((num_states, num_states))
    for state, row in enumerate(room.graph.tolist()):
        for target in row:
            transition[state, state if target < 0 else target] += 0.25
    transition[goal] = 0
    transition[goal, goal] = 1
    reached = np.linalg.matrix_power(transition, 500)[:, goal]
    expected = np.delete(reached, goal).mean()
    assert abs(float(markov.random_walk_success(room.graph, goal, 500)) - expected) < 1e-12


def test_all_goals_of_the_kitchen_take_seconds() -> None:
    room = Scene.bundled("kitchen")
    goals = torch.arange(room.num_states)
    began = time.process_time()
    walk = markov.random_walk_success(room.graph, goals, 500)
    policy = torch.full((room.num_states, room.num_states, 4), 0.25)
    each = markov.policy_success(room.graph, policy, goals, 500)
    seconds = time.process_time() - began
    torch.testing.assert_close(walk, each, rtol=0, atol=1e-12)
    assert seconds < 20  # 2 seconds on an idle core


def test_old_names_are_found_and_warn() -> None:
    with pytest.warns(DeprecationWarning, match=r"vusfa\.scenes\.markov\.policy_success"):
        assert graphs.policy_success is markov.policy_success
