from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from vusfa.evaluation import evaluate
from vusfa.modules import InferencePolicy, TabularPolicy, make_agent
from vusfa.scenes import SceneSet


@pytest.mark.parametrize("model", ["gvf", "usfa", "sfdp", "vusfa"])
def test_the_same_logits_as_the_agents(rooms: SceneSet, model: str) -> None:
    torch.manual_seed(0)
    agent = make_agent(model, scenes=rooms, history=1, hidden_size=8, embedding_size=8).train()
    table = TabularPolicy(agent, rooms, at_once=40)  # several goals of a scene, several times
    assert agent.training
    agent.eval()
    scene = torch.tensor([0] * 9 + [1] * 9)
    state = rooms.offsets[scene] + torch.arange(18) % 16
    goal = rooms.offsets[scene] + torch.arange(18) * 7 % 16
    expected = InferencePolicy(agent).logits(state.unsqueeze(-1), goal, scene).softmax(-1)
    torch.testing.assert_close(table.probabilities(state, goal, scene), expected.detach())


def test_a_table_of_some_goals_alone(rooms: SceneSet) -> None:
    torch.manual_seed(0)
    agent = make_agent("vusfa", scenes=rooms, history=1, hidden_size=8, embedding_size=8)
    goals = torch.tensor([20, 3])
    every, some = TabularPolicy(agent, rooms), TabularPolicy(agent, rooms, goals)
    for goal, scene in ((3, 0), (20, 1)):
        state = torch.arange(*rooms.offsets[scene : scene + 2].tolist())
        to = torch.full_like(state, goal)
        torch.testing.assert_close(some.logits(state, to), every.logits(state, to))
    with pytest.raises(IndexError):
        some.logits(torch.tensor([5]), torch.tensor([4]))


@pytest.mark.parametrize("sample", [True, False])
def test_the_same_walks_as_the_actors(rooms: SceneSet, sample: bool) -> None:
    torch.manual_seed(1)
    agent = make_agent("vusfa", scenes=rooms, history=1, hidden_size=8, embedding_size=8)
    with torch.no_grad():
        for parameter in agent.policy.parameters():
            parameter.mul_(5.0)
    policies = agent.get_policy_operator(out_keys=["action"]), TabularPolicy(agent, rooms)
    one, two = (
        evaluate(policy, rooms, episodes_per_goal=3, max_steps=40, history=1, sample=sample, batch_size=17)
        for policy in policies
    )
    assert one.equal(two)
    assert 0 < one.success.sum() < len(one)


def test_more_than_one_frame_is_no_table(rooms: SceneSet) -> None:
    agent = make_agent("gvf", scenes=rooms, history=2, hidden_size=8, embedding_size=8)
    with pytest.raises(ValueError, match="history=2"):
        TabularPolicy(agent, rooms)


def test_walks_do_not_read_the_latent(rooms: SceneSet) -> None:
    """omega alone reads z_g, and the value alone reads omega: with means and with samples an agent walks
    alike."""
    agents = []
    for latent in ("mean", "sample"):
        torch.manual_seed(2)
        agents.append(make_agent("vusfa", scenes=rooms, history=1, hidden_size=8, eval_latent=latent))
    one, two = (evaluate(agent.get_policy_operator(), rooms, history=1, max_steps=30) for agent in agents)
    assert one.equal(two)
    state = torch.arange(3)
    values = []
    for agent in agents:
        critic = agent.eval().get_value_operator()
        batch = {"state_id": state.unsqueeze(-1), "goal_id": state + 5, "scene_id": state * 0}
        values.append(critic(TensorDict(batch, [3]))["state_value"])
    assert not torch.equal(*values)
