"""Regression of the reward: what it computes, and what it moves."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from vusfa.modules import Agent, make_agent
from vusfa.objectives import RewardRegressionLoss, reward_regression_loss
from vusfa.scenes import SceneSet


@pytest.fixture
def agent() -> Agent:
    torch.manual_seed(0)
    rooms = SceneSet.bundled(["bathroom"])
    return make_agent("usfa", scenes=rooms, history=1, hidden_size=16, embedding_size=8, reward_scale=1.0)


def steps(number: int = 6) -> TensorDict:
    torch.manual_seed(1)
    return TensorDict(
        {
            "state_id": torch.randint(176, (number, 1)),
            "goal_id": torch.randint(176, (number,)),
            "scene_id": torch.zeros(number, dtype=torch.int64),
            "next": {"state_id": torch.randint(176, (number, 1)), "reward": torch.randn(number, 1)},
        },
        [number],
    )


def test_the_equation_row_by_row() -> None:
    phi, omega, reward = torch.randn(3, 4), torch.randn(3, 4), torch.randn(3, 1)
    wanted = [
        (sum(a * b for a, b in zip(p, w, strict=True)) - r) ** 2
        for p, w, (r,) in zip(phi.tolist(), omega.tolist(), reward.tolist(), strict=True)
    ]
    torch.testing.assert_close(reward_regression_loss(phi, omega, reward), torch.tensor(wanted))


def test_it_reads_the_state_arrived_in(agent: Agent) -> None:
    batch = steps()
    state, goal = agent.encoder(batch["next", "state_id"], batch["goal_id"])
    predicted = (state * agent.reward(goal)).sum(-1, keepdim=True)
    wanted = 0.5 * (predicted - batch["next", "reward"]).square().mean()
    loss = RewardRegressionLoss(agent.get_value_operator(), reward_coeff=0.5)
    torch.testing.assert_close(loss(batch)["loss_reward"], wanted)
    assert set(batch.keys()) == {"state_id", "goal_id", "scene_id", "next"}


def test_psi_value_and_policy_get_no_gradient(agent: Agent) -> None:
    RewardRegressionLoss(agent.get_value_operator())(steps())["loss_reward"].backward()
    moved = {
        name.split(".")[0] for name, p in agent.named_parameters() if p.grad is not None and p.grad.any()
    }
    assert "reward" in moved
    assert not moved & {"successor", "value", "policy", "scene_layer", "fusion"}


def test_weights_learn_the_reward(agent: Agent) -> None:
    loss, batch = RewardRegressionLoss(agent.get_value_operator(), functional=False), steps()
    optimiser = torch.optim.Adam(agent.reward.parameters(), lr=3e-2)
    first = loss(batch)["loss_reward"].item()
    for _ in range(60):
        optimiser.zero_grad()
        loss(batch)["loss_reward"].backward()
        optimiser.step()
    assert loss(batch)["loss_reward"].item() < 0.05 * first


def test_a_critic_without_reward_weights() -> None:
    rooms = SceneSet.bundled(["bathroom"])
    loss = RewardRegressionLoss(make_agent("gvf", scenes=rooms, hidden_size=8).get_value_operator())
    for read in (loss.check, lambda: loss.in_keys, lambda: loss(steps())):
        with pytest.raises(ValueError, match=r"writes no 'reward_weights'.*reward_weights=") as error:
            read()
    assert len(str(error.value)) < 400
