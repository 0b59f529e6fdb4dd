"""Pairs of state and goal: their numbers, and an agent's answers to all of them."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from vusfa.errors import SceneError
from vusfa.modules import Agent, InferencePolicy, TabularPolicy, make_agent
from vusfa.scenes import Scene, SceneSet

SIZES = {"hidden_size": 16, "embedding_size": 8, "history": 1}


def table(
    rooms: SceneSet, goals: torch.Tensor, model: str = "gvf", **options: int
) -> tuple[Agent, TabularPolicy]:
    torch.manual_seed(0)
    agent = make_agent(model, scenes=rooms, **SIZES)
    return agent, TabularPolicy(agent, rooms, goals, **options)


@pytest.fixture(scope="module")
def rooms() -> SceneSet:
    return SceneSet.bundled(["bathroom", "bedroom"])


def test_every_pair_of_one_scene_once_and_no_other(rooms: SceneSet) -> None:
    goals = torch.tensor([500, 3, 175, 176, 3])
    _, pairs = table(rooms, goals)
    found = list(zip(pairs.state.tolist(), pairs.goal.tolist(), pairs.scene.tolist(), strict=True))
    sizes = [scene.num_states for scene in rooms.scenes]
    wanted = {(state, goal, 0) for goal in (3, 175) for state in range(sizes[0])}
    wanted |= {(state, goal, 1) for goal in (176, 500) for state in range(sizes[0], sum(sizes))}
    assert len(found) == len(wanted)
    assert set(found) == wanted
    assert torch.equal(pairs.rows(pairs.state, pairs.goal), torch.arange(len(found)))


def test_a_state_that_is_no_goal_is_not_mistaken_for_one(rooms: SceneSet) -> None:
    _, pairs = table(rooms, torch.tensor([3]))
    with pytest.raises(IndexError):
        pairs.logits(torch.tensor([7]), torch.tensor([4]))


@pytest.mark.parametrize("goal", [580, -1, 10**12])
def test_a_goal_that_is_no_state(rooms: SceneSet, goal: int) -> None:
    with pytest.raises(SceneError, match=rf"there is no state {goal}; this set has 0\.\.579"):
        table(rooms, torch.tensor([3, goal]))


@pytest.mark.parametrize("model", ["gvf", "vusfa"])
def test_answers_are_the_actors(rooms: SceneSet, model: str) -> None:
    agent, pairs = table(rooms, torch.tensor([3, 200, 480]), model, at_once=100)
    inputs = TensorDict(
        {"state_id": pairs.state.unsqueeze(-1), "goal_id": pairs.goal, "scene_id": pairs.scene},
        pairs.state.shape,
    )
    wanted = agent.get_policy_operator().get_dist(inputs).logits
    found = pairs.logits(pairs.state, pairs.goal).log_softmax(-1)
    torch.testing.assert_close(found, wanted)


def test_a_tabulated_walker_acts_as_before_and_forgets_its_table(rooms: SceneSet) -> None:
    torch.manual_seed(0)
    agent = make_agent("vusfa", scenes=rooms, **SIZES)
    policy, goals = InferencePolicy(agent), torch.tensor([3, 200])
    goal = torch.tensor([3, 200, 200, 3, 3])
    rows = {"state_id": torch.tensor([[0], [300], [176], [175], [3]]), "goal_id": goal}
    rows["scene_id"] = (goal > 100).long()

    def actions() -> list[int]:
        torch.manual_seed(5)
        with torch.no_grad():
            drawn = policy(TensorDict(rows, [5]))["action"]
            with set_exploration_type(ExplorationType.DETERMINISTIC):
                return [*drawn.tolist(), *policy(TensorDict(rows, [5]))["action"].tolist()]

    before = actions()
    with policy.cached(goals, rooms):
        assert actions() == before
        with torch.no_grad():
            for param in agent.parameters():
                param.neg_()
        assert actions() == before  # within, the table is what acts
    assert actions() != before


@pytest.mark.parametrize(("rows", "tabulated"), [(None, True), (100, True), (99, False)])
def test_a_table_is_made_where_it_pays(rooms: SceneSet, rows: int | None, tabulated: bool) -> None:
    """Three goals of a room of 100 states: 300 answers, three per row that will be asked for."""
    hall = SceneSet([Scene("hall", torch.full((100, 4), -1), torch.rand(100, 1, 6))])
    policy = InferencePolicy(make_agent("gvf", scenes=hall, **SIZES))
    with policy.cached(torch.tensor([5, 7, 9]), hall, rows):
        assert bool(policy._table) == tabulated
    assert not policy._table


def test_an_agent_that_sees_more_has_no_table(rooms: SceneSet) -> None:
    agent = make_agent("gvf", scenes=rooms, hidden_size=8, embedding_size=8)
    assert not agent.is_tabular
    with pytest.raises(ValueError, match="history=4"):
        TabularPolicy(agent, rooms)
