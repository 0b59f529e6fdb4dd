from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from vusfa.evaluation import evaluate
from vusfa.modules import Agent, InferencePolicy, TriedActions, make_agent
from vusfa.scenes import SceneSet


@pytest.fixture
def rooms() -> SceneSet:
    return SceneSet.bundled(["bathroom"])


@pytest.fixture
def agent(rooms: SceneSet) -> Agent:
    return make_agent("usfa", scenes=rooms, history=1, hidden_size=8, embedding_size=8)


def rows(state: list[int], tried: torch.Tensor | None = None, first: bool = False) -> TensorDict:
    count = len(state)
    made = TensorDict({"state_id": torch.tensor(state).view(-1, 1)}, [count])
    made["goal_id"], made["scene_id"] = torch.full((count,), 7), torch.zeros(count).long()
    made["is_init"] = torch.full((count, 1), first)
    return made if tried is None else made.set("tried", tried)


def test_the_likeliest_action_by_hand(agent: Agent) -> None:
    logits = InferencePolicy(agent).logits(torch.tensor([[3]]), torch.tensor([7]), torch.zeros(1).long())[0]
    counts = torch.tensor([4, 0, 1, 2], dtype=torch.uint8)
    tried = torch.zeros(1, 176, 4, dtype=torch.uint8)
    tried[0, 3], tried[0, 4, 1] = counts, 9  # of another state: not looked at
    policy = TriedActions(agent, 176, 4, weight=0.5, temperature=2.0)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        after = policy(rows([3], tried.clone()))
    best = int((logits / 2 - 0.5 * counts).argmax())
    assert after["action"].item() == best
    tried[0, 3, best] += 1
    assert torch.equal(after["next", "tried"], tried)


def test_a_new_episode_has_tried_nothing(agent: Agent) -> None:
    policy = TriedActions(agent, 176, 4)
    after = policy(rows([3, 4], torch.full((2, 176, 4), 5, dtype=torch.uint8), first=True))
    assert after["next", "tried"].sum().item() == 2


def test_counts_do_not_overflow(agent: Agent) -> None:
    tried = torch.full((1, 176, 4), 255, dtype=torch.uint8)
    assert TriedActions(agent, 176, 4)(rows([3], tried))["next", "tried"][0, 3].tolist() == [255] * 4


def test_without_weight_it_is_the_agent(rooms: SceneSet, agent: Agent) -> None:
    tables = [
        evaluate(policy, rooms, [7, 9], episodes_per_goal=20, max_steps=40, history=1)
        for policy in (InferencePolicy(agent), TriedActions(agent, 176, 4, weight=0.0))
    ]
    assert abs(tables[0].length.double().mean() - tables[1].length.double().mean()) < 6


def test_memory_alone_reaches_more_than_a_random_walk(rooms: SceneSet) -> None:
    plain, remembering = (
        evaluate(TriedActions(None, 176, 4, weight=weight), rooms, episodes_per_goal=5, history=1)
        for weight in (0.0, 3.0)
    )
    assert remembering.success.double().mean() > plain.success.double().mean() + 0.04


def test_an_agent_with_a_memory_of_its_own_is_refused(rooms: SceneSet) -> None:
    recurrent = make_agent("gvf", scenes=rooms, memory="lstm", hidden_size=8, embedding_size=8)
    with pytest.raises(ValueError, match="no memory of its own"):
        TriedActions(recurrent, 176, 4)
