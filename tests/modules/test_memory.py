"""The LSTM variant, in the environment and in a loss."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv
from torchrl.modules import set_recurrent_mode

from vusfa.envs import TargetNavEnv
from vusfa.modules import MODELS, Agent
from vusfa.objectives import USFLoss
from vusfa.scenes import SceneSet

MakeAgent = Callable[..., Agent]


def rollout(agent: Agent, scenes: SceneSet, batch: list[int]) -> TensorDict:
    env = TargetNavEnv(scenes, goals=[2, 9], batch_size=batch, history=1, max_steps=3, seed=0)
    env = TransformedEnv(env, Compose(*agent.make_env_transforms()))
    return env.rollout(8, agent.get_policy_operator(), break_when_any_done=False)


@pytest.mark.parametrize("batch", [[], [6], [2, 3]], ids=str)
@pytest.mark.parametrize("model", ["gvf", "vusfa"])
def test_a_whole_rollout_at_once_gives_what_single_steps_gave(
    small_agent: MakeAgent, scenes: SceneSet, model: str, batch: list[int]
) -> None:
    agent = small_agent(model, memory="lstm")
    data = rollout(agent, scenes, batch)
    assert data["next", "done"].any()
    with set_recurrent_mode(True):
        dist = agent.get_policy_operator().get_dist(data.clone())
    torch.testing.assert_close(dist.log_prob(data["action"]), data["action_log_prob"])


def test_the_past_matters_and_a_new_episode_forgets_it(small_agent: MakeAgent, scenes: SceneSet) -> None:
    agent = small_agent("gvf", memory="lstm")
    data = rollout(agent, scenes, [6])
    critic = agent.get_value_operator()
    alone = data.exclude("recurrent_state_h", "recurrent_state_c")
    for key in ("recurrent_state_h", "recurrent_state_c"):
        alone[key] = torch.zeros_like(data[key])
    with_memory = critic(data.clone())["state_value"]
    without = critic(alone)["state_value"]
    first = data["is_init"]
    torch.testing.assert_close(with_memory[first], without[first])
    assert (with_memory[~first] - without[~first]).abs().min() > 0


@pytest.mark.parametrize("model", MODELS)
def test_the_loss_reaches_the_memory(small_agent: MakeAgent, scenes: SceneSet, model: str) -> None:
    agent = small_agent(model, memory="lstm")
    data = rollout(agent, scenes, [6])
    with set_recurrent_mode(True):
        terms = USFLoss(agent.get_policy_operator(), agent.get_value_operator())(data)
    sum(value for key, value in terms.items() if key.startswith("loss")).backward()
    assert all(parameter.grad.any() for parameter in agent.memory.parameters())


def test_without_memory_the_environment_needs_nothing(small_agent: MakeAgent) -> None:
    assert small_agent().make_env_transforms() == []
