"""The action before, in the environment, in an agent's memory and in evaluations."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv, check_env_specs
from torchrl.modules import set_recurrent_mode

from vusfa.envs import TargetNavEnv
from vusfa.errors import ConfigError
from vusfa.evaluation import evaluate
from vusfa.modules import ActionInput, Agent, InferencePolicy, PreviousAction
from vusfa.scenes import SceneSet

MakeAgent = Callable[..., Agent]


@pytest.mark.parametrize("batch", [[], [6], [2, 3]], ids=str)
def test_the_environment_tells_the_action_before(scenes: SceneSet, batch: list[int]) -> None:
    env = TargetNavEnv(scenes, goals=[2, 9], batch_size=batch, history=1, max_steps=3, seed=0)
    env = TransformedEnv(env, PreviousAction(4))
    check_env_specs(env)
    walk = env.rollout(12, break_when_any_done=False)
    time = len(batch)
    assert torch.equal(walk["next", "previous_action"], walk["action"])
    before = walk["previous_action"].narrow(time, 1, 11)
    ended = walk["next", "done"].squeeze(-1).narrow(time, 0, 11)
    assert ended.any()
    assert not ended.all()
    assert bool((before[ended] == 4).all())
    assert torch.equal(before[~ended], walk["action"].narrow(time, 0, 11)[~ended])
    assert bool((walk["previous_action"].narrow(time, 0, 1) == 4).all())


def test_a_code_gets_the_vector_of_its_action() -> None:
    layer, codes = ActionInput(2, 3), torch.randn(4, 3)
    actions = torch.tensor([0, 2, 1, 0])
    expected = torch.stack([code + layer.embedding.weight[a] for code, a in zip(codes, actions, strict=True)])
    assert torch.equal(layer(codes, actions), expected)


def test_a_whole_rollout_at_once_gives_what_single_steps_gave(
    small_agent: MakeAgent, scenes: SceneSet
) -> None:
    agent = small_agent("vusfa", memory="lstm", previous_action=True)
    env = TargetNavEnv(scenes, goals=[2, 9], batch_size=[6], history=1, max_steps=3, seed=0)
    env = TransformedEnv(env, Compose(*agent.make_env_transforms()))
    walks = []
    for one in (agent.get_policy_operator(), InferencePolicy(agent)):
        with torch.no_grad():
            env.set_seed(0)
            torch.manual_seed(0)
            walks.append(env.rollout(8, one, break_when_any_done=False))
    data = walks[0]
    assert torch.equal(data["action"], walks[1]["action"])
    with set_recurrent_mode(True):
        dist = agent.get_policy_operator().get_dist(data.clone())
    torch.testing.assert_close(dist.log_prob(data["action"]), data["action_log_prob"])
    other = data.clone()
    other["previous_action"] = (other["previous_action"] + 1) % 5
    with set_recurrent_mode(True):
        moved = agent.get_policy_operator().get_dist(other)
    assert not torch.allclose(moved.logits, dist.logits)


def test_evaluation_hands_it_over(scenes: SceneSet) -> None:
    """A policy that goes on as it went before, and starts forwards, turns in a ring to every goal."""

    class Onwards(torch.nn.Module):
        in_keys, out_keys = ("state_id", "previous_action"), ("action",)
        starts = 0

        def forward(self, rows: TensorDict) -> TensorDict:
            before = rows["previous_action"]
            self.starts += int((before == 4).sum())
            return rows.set("action", torch.where(before == 4, 0, before))

    policy = Onwards()
    table = evaluate(policy, scenes, episodes_per_goal=3, history=1, batch_size=10)  # type: ignore[arg-type]
    assert bool(table.success.all())
    assert policy.starts == len(table.success) == 63
    size = torch.tensor([7, 9, 5])[table.scene]
    assert torch.equal(table.length, (table.goal - table.start) % size)


def test_it_belongs_to_a_memory(small_agent: MakeAgent, scenes: SceneSet) -> None:
    with pytest.raises(ConfigError, match=r"give memory='lstm'"):
        small_agent(previous_action=True)
    agent = small_agent(memory="lstm", previous_action=True)
    rows = TargetNavEnv(scenes, goals=[2], batch_size=[3], history=1, seed=0).reset()
    for policy in (agent.get_policy_operator(), InferencePolicy(agent)):
        with pytest.raises(ConfigError, match="make_env_transforms"):
            policy(rows.clone())
