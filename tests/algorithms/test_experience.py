"""The graph of an agent's own transitions, against breadth-first search in plain Python and whole scenes."""

from __future__ import annotations

from collections import deque

import pytest
import torch
from tensordict import TensorDict

from vusfa.algorithms import ExperienceGraph
from vusfa.algorithms.experience import passing_weights
from vusfa.algorithms.imitation import all_transitions
from vusfa.envs import TargetNavEnv
from vusfa.errors import ConfigError
from vusfa.scenes import SceneSet


def batch(triples: list[tuple[int, int, int]], scene: list[int] | None = None) -> TensorDict:
    state, action, following = (torch.tensor(column) for column in zip(*triples, strict=True))
    scenes = torch.tensor(scene or [0] * len(triples))
    return TensorDict(
        {
            "state_id": state.unsqueeze(-1),
            "action": action,
            "scene_id": scenes,
            "next": {"state_id": following.unsqueeze(-1)},
        },
        [len(triples)],
    )


def random_graph(seed: int, states: int = 12, actions: int = 3) -> ExperienceGraph:
    """A world of which each action has been tried with a probability of two thirds."""
    generator = torch.Generator().manual_seed(seed)
    successor = torch.randint(states, (states, actions), generator=generator)
    tried = torch.rand(states, actions, generator=generator) < 2 / 3
    graph = ExperienceGraph(states, actions)
    graph.extend(batch([(s, a, int(successor[s, a])) for s, a in tried.nonzero().tolist()]))
    return graph


def searched(graph: ExperienceGraph, goal: int) -> dict[int, int]:
    """Steps from every state that a breadth-first search backwards from the goal finds."""
    found, queue = {goal: 0}, deque([goal])
    while queue:
        reached = queue.popleft()
        for state, action in (graph.successor == reached).nonzero().tolist():
            assert graph.successor[state, action] == reached
            if state not in found:
                found[state] = found[reached] + 1
                queue.append(state)
    return found


@pytest.mark.parametrize("seed", range(8))
def test_steps_and_best_actions_of_random_graphs(seed: int) -> None:
    graph = random_graph(seed)
    torch.manual_seed(seed)
    sample = graph.sample(num_goals=6, batch_size=60)
    assert len(sample) == 60
    for pair in sample:
        state, goal = int(pair["state_id"]), int(pair["goal_id"])
        steps = searched(graph, goal)
        assert state != goal
        assert pair["steps_to_goal"] == steps[state]
        best = [steps.get(int(s), 99) == steps[state] - 1 and s >= 0 for s in graph.successor[state]]
        assert pair["best_action"].tolist() == best
    states, distance = graph.steps_to(sample["goal_id"][:1])
    steps = searched(graph, int(sample["goal_id"][0]))
    assert distance[0].tolist() == [steps.get(int(state), -1) for state in states]


def test_whole_scenes_give_their_own_distances() -> None:
    """Walked until every action has been tried, the graph knows what the scenes know."""
    scenes = SceneSet.bundled(["bathroom", "bedroom"])
    graph = ExperienceGraph(scenes.num_states, scenes.num_actions)
    graph.extend(TargetNavEnv(scenes, batch_size=[8], history=1).rollout(20, break_when_any_done=False))
    assert 0 < graph.num_transitions <= 160
    every = [(s, a, int(scenes.successor[s, a])) for s in range(scenes.num_states) for a in range(4)]
    graph.extend(batch(every, scenes.scene_id.repeat_interleave(4).tolist()))
    assert graph.num_transitions == 4 * scenes.num_states
    torch.manual_seed(0)
    sample = graph.sample(num_goals=10, batch_size=200)
    assert (sample["scene_id"].diff() >= 0).all()
    assert set(sample["scene_id"].tolist()) == {0, 1}
    for pair in sample:
        scene = scenes.scenes[int(pair["scene_id"])]
        first = int((scenes.scene_id == pair["scene_id"]).nonzero()[0])
        goal = pair["goal_id"] - first
        assert pair["steps_to_goal"] == scene.distance[pair["state_id"] - first, goal]


def test_the_later_outcome_counts_and_paths_are_searched_again() -> None:
    graph = ExperienceGraph(3, 1)
    graph.extend(batch([(0, 0, 1), (1, 0, 2)]))
    assert graph.steps_to(torch.tensor([2]))[1].tolist() == [[2, 1, 0]]
    graph.extend(batch([(0, 0, 2)]))
    assert graph.steps_to(torch.tensor([2]))[1].tolist() == [[1, 1, 0]]


def test_states_are_drawn_as_walks_pass_them() -> None:
    """Walks in plain Python from uniform starts, through a uniform state at each distance."""
    distance = torch.tensor([1, 2, 2, 3, 3, 3])
    passed = [0.0] * 6
    for start in range(6):
        length = int(distance[start])
        for d in range(1, length + 1):
            at = (distance == d).nonzero().flatten().tolist()
            for state in at:
                passed[state] += 1 / length / len(at)
    torch.testing.assert_close(passing_weights(distance), torch.tensor(passed))
    graph = ExperienceGraph(7, 1)
    graph.extend(batch([(s + 1, 0, s) for s in range(6)]))  # a corridor to state 0
    torch.manual_seed(0)
    near = {
        share: (graph.sample(600, 12000, path_share=share)["steps_to_goal"] == 1).float().mean()
        for share in (0.0, 1.0)
    }
    assert near[1.0] > near[0.0] + 0.05


def test_nothing_known_and_unseen_goals_are_refused() -> None:
    graph = ExperienceGraph(4, 2)
    with pytest.raises(ValueError, match="no transition is known"):
        graph.sample(1, 1)
    graph.extend(batch([(0, 0, 0)]))  # a collision leads nowhere
    with pytest.raises(ValueError, match="no transition is known"):
        graph.sample(1, 1)
    graph.extend(batch([(0, 0, 1), (2, 0, 3)], [0, 1]))
    for goals in ([0, 3], [7 % 4, 0]):
        with pytest.raises(ValueError, match="not seen states of one scene"):
            graph.steps_to(torch.tensor(goals))


def test_state_dict() -> None:
    graph, other = random_graph(1), ExperienceGraph(12, 3)
    other.load_state_dict(graph.state_dict())
    for one in (graph, other):
        torch.manual_seed(0)
        one.drawn = one.sample(4, 40)  # type: ignore[attr-defined]
    assert bool((graph.drawn == other.drawn).all())  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (lambda s: s.update(successor=s["successor"][:5]), ConfigError, r"\(5, 3\).*do not fit \(12, 3\)"),
        (lambda s: s.update(scene_of=s["scene_of"][:5]), ConfigError, "do not fit"),
        (lambda s: s["successor"].fill_(12), ValueError, "not among 12"),
        (lambda s: s["successor"].fill_(-2), ValueError, "not among 12"),
        (lambda s: s["scene_of"].fill_(-1), ValueError, "different or unknown scenes"),
        (lambda s: s["scene_of"].copy_(torch.arange(12)), ValueError, "different or unknown scenes"),
    ],
)
def test_a_damaged_state_is_refused(change, error: type[Exception], message: str) -> None:
    state = {name: value.clone() for name, value in random_graph(1).state_dict().items()}
    change(state)
    other = ExperienceGraph(12, 3)
    with pytest.raises(error, match=message):
        other.load_state_dict(state)
    assert other.num_transitions == 0


@pytest.mark.parametrize("seed", range(4))
def test_labels_of_given_pairs(seed: int) -> None:
    graph = random_graph(seed)
    state, goal = torch.arange(12).repeat_interleave(12), torch.arange(12).repeat(12)
    steps, best = graph.label(state.view(12, 12), goal.view(12, 12))
    assert steps.shape == (12, 12)
    assert best.shape == (12, 12, 3)
    for s in range(12):
        for g in range(12):
            found = searched(graph, g) if graph.scene_of[g] >= 0 else {}
            known = s in found and graph.scene_of[s] >= 0
            assert steps[s, g] == (found[s] if known else 0)
            marks = [
                known and s != g and n >= 0 and found.get(int(n), 99) == found[s] - 1
                for n in graph.successor[s]
            ]
            assert best[s, g].tolist() == marks


def test_labels_of_two_scenes_and_of_goals_in_another() -> None:
    scenes = SceneSet.bundled(["bathroom", "bedroom"])
    graph = ExperienceGraph(scenes.num_states, scenes.num_actions)
    graph.extend(all_transitions(scenes))
    state, goal = torch.randint(580, (2, 200))
    steps, best = graph.label(state, goal)
    same = scenes.scene_id[state] == scenes.scene_id[goal]
    assert bool((steps[~same] == 0).all())
    assert not best[~same].any()
    assert torch.equal(steps[same], scenes.distance(state[same], goal[same]).long().clamp(min=0))
    for s, g, marks in zip(state[same].tolist(), goal[same].tolist(), best[same], strict=True):
        ahead = scenes.distance(scenes.successor[s], torch.full((4,), g))
        assert marks.tolist() == [s != g and int(d) == int(scenes.distance(s, g)) - 1 for d in ahead]
