from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.nn.functional import one_hot

from vusfa.evaluation import evaluate, get_metric
from vusfa.evaluation.exact import exact_goals, expected_walks, uniform_probabilities
from vusfa.modules import Agent, InferencePolicy, TabularPolicy, make_agent
from vusfa.scenes import Scene, SceneSet
from vusfa.scenes.markov import arrival_by_step


@pytest.fixture
def rooms(make_scene: Callable[..., Scene]) -> SceneSet:
    return SceneSet([make_scene("hall"), make_scene("attic", 3, 1)])


@pytest.fixture
def agent(rooms: SceneSet) -> Agent:
    torch.manual_seed(0)
    made = make_agent("vusfa", scenes=rooms, history=1, hidden_size=16, embedding_size=16)
    with torch.no_grad():  # an untrained policy is nearly uniform: let it prefer something
        for parameter in made.policy.parameters():
            parameter.mul_(6.0)
    return made.eval()


def test_a_step_by_hand() -> None:
    """Two states, one action that goes there with the chance p and one that stays."""
    graph, acts = torch.tensor([[1, 0], [1, 1]]), torch.tensor([[[0.3, 0.7], [0.5, 0.5]]])
    for k, chance in zip(range(5), arrival_by_step(graph, acts, [1]), strict=False):
        assert chance[0, 0].item() == pytest.approx(1 - 0.7**k)


def test_a_corridor_by_hand() -> None:
    """Three states in a row, forward with the chance of one half, else blocked: SPL sums d / k P(arrive at
    k)."""
    corridor = torch.tensor([[1, -1], [2, -1], [-1, -1]])
    scenes = SceneSet([Scene("corridor", corridor, torch.rand(3, 1, 4))])
    table = exact_goals(uniform_probabilities(2), scenes)
    assert table.goal.tolist() == [1, 2]  # nothing leads to the first
    one = sum(0.5**k / k for k in range(1, 501))
    two = sum((k - 1) * 0.5**k * 2 / k for k in range(2, 501))
    torch.testing.assert_close(
        table.metrics["spl"], torch.tensor([one, (one + two) / 2], dtype=torch.float64)
    )
    torch.testing.assert_close(table.metrics["success_500"], torch.ones(2, dtype=torch.float64))
    missed = 0.5**100, (0.5**100 + 101 * 0.5**100) / 2
    torch.testing.assert_close(
        1 - table.metrics["success_100"], torch.tensor(missed, dtype=torch.float64), atol=1e-12, rtol=0
    )


@pytest.mark.parametrize("greedy", [False, True])
def test_beside_sampled_episodes(rooms: SceneSet, agent: Agent, greedy: bool) -> None:
    """Each mean of 400 episodes a goal lies within five of its standard errors of what is computed."""
    table = TabularPolicy(agent, rooms)

    def likeliest(state: Tensor, goal: Tensor, scene: Tensor) -> Tensor:
        return one_hot(table.logits(state, goal).argmax(-1), 4).double()

    probabilities = likeliest if greedy else table.probabilities
    exact = exact_goals(probabilities, rooms)
    sampled = evaluate(
        InferencePolicy(agent), rooms, episodes_per_goal=400, max_steps=500, history=1, sample=not greedy
    )
    assert exact.metrics["success_100"].min() < 1
    for row in range(len(exact.goal)):
        here = sampled.select((sampled.goal == exact.goal[row]) & (sampled.scene == exact.scene[row]))
        within = (here.success & (here.length <= 100)).double().mean()
        error = max(0.004, 0.025 * 4 * float(within * (1 - within)) ** 0.5)
        assert abs(within - exact.metrics["success_100"][row]) < 2.5 * error
        assert abs(get_metric("spl").value(here) - exact.metrics["spl"][row]) < 0.125


def test_goals_are_computed_together_or_apart(rooms: SceneSet, agent: Agent) -> None:
    policy = TabularPolicy(agent, rooms)
    tables = [exact_goals(policy.probabilities, rooms, at_once=size) for size in (5, 64)]
    torch.testing.assert_close(tables[0].metrics["spl"], tables[1].metrics["spl"], atol=1e-5, rtol=1e-5)
    assert torch.equal(tables[0].goal, tables[1].goal)


def test_expected_walks_in_a_corridor_by_hand() -> None:
    """Three states in a row, forward with the chance of one half, else blocked, at most four actions."""
    corridor = torch.tensor([[1, -1], [2, -1], [1, -1]])
    scenes = SceneSet([Scene("corridor", corridor, torch.rand(3, 1, 4))])
    walks = expected_walks(None, scenes, torch.tensor([2]), max_steps=4)
    near = [0.5**k for k in range(1, 5)]  # from the middle: the chance of arriving with the k-th action
    far = [0.0, *((k - 1) * 0.5**k for k in range(2, 5))]
    lengths = [
        sum(k * p for k, p in enumerate(chances, 1)) + 4 * (1 - sum(chances)) for chances in (near, far)
    ]
    arrived = [sum(k * p for k, p in enumerate(chances, 1)) for chances in (near, far)]
    assert walks.length.tolist() == pytest.approx([sum(lengths) / 2])
    assert walks.success.tolist() == pytest.approx([(sum(near) + sum(far)) / 2])
    assert walks.shortest.tolist() == [1.5]
    assert walks.length_ratio == pytest.approx(sum(arrived) / (1 * sum(near) + 2 * sum(far)))


def test_expected_walks_of_an_agent_beside_the_table_of_all_goals(rooms: SceneSet, agent: Agent) -> None:
    chances = TabularPolicy(agent, rooms).probabilities
    every = exact_goals(chances, rooms)
    goals = torch.tensor([2, 7, 18])
    rows = [int(((every.scene == scene) & (every.goal == goal)).nonzero()) for scene, goal in
            ((0, 2), (0, 7), (1, 2))]  # fmt: skip
    for steps, column in ((100, every.metrics["success_100"]), (500, every.metrics["success_500"])):
        walks = expected_walks(chances, rooms, goals, steps)
        torch.testing.assert_close(walks.success, column[rows], atol=1e-4, rtol=1e-4)
    assert bool((walks.length >= walks.shortest).all())
    assert walks.length_ratio > 1
