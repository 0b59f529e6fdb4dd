from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import InteractionType
from torch.distributions import Categorical
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from vusfa.envs import TargetNavEnv
from vusfa.errors import ConfigError
from vusfa.modules import (
    ARCHITECTURES,
    MODELS,
    Agent,
    InferencePolicy,
    action_probs,
    draw,
    draw_actions,
)
from vusfa.modules.rows import SceneBlocks, SortedByScene
from vusfa.scenes import SceneSet

MakeAgent = Callable[..., Agent]
MakeBatch = Callable[..., TensorDict]


@pytest.mark.parametrize("architecture", ARCHITECTURES)
@pytest.mark.parametrize("model", MODELS)
class TestBesideTheActor:
    @pytest.mark.parametrize("batch", [(), (3,), (2, 5), (60,)])
    def test_the_same_draws_of_the_same_logits(
        self,
        small_agent: MakeAgent,
        make_batch: MakeBatch,
        model: str,
        architecture: str,
        batch: tuple[int, ...],
    ) -> None:
        agent, data = small_agent(model, architecture), make_batch(*batch)
        actions = []
        for policy in (agent.get_policy_operator(), InferencePolicy(agent)):
            torch.manual_seed(3)
            actions.append(policy(data.clone())["action"])
        assert actions[0].shape == batch
        assert torch.equal(*actions)

    @pytest.mark.parametrize("history", [1, 4])
    def test_logits(
        self, small_agent: MakeAgent, make_batch: MakeBatch, model: str, architecture: str, history: int
    ) -> None:
        agent, data = small_agent(model, architecture, history=history), make_batch(40)
        wanted = agent.get_policy_operator().get_dist_params(data.clone())["logits"]
        policy, rows = InferencePolicy(agent), (data["state_id"], data["goal_id"], data["scene_id"])
        torch.testing.assert_close(policy.logits(*rows), wanted, atol=1e-5, rtol=1e-5)
        blocks = SceneBlocks.of(*SortedByScene.sort(data["scene_id"], 3))
        assert blocks is not None
        torch.testing.assert_close(policy.logits(*rows[:2], blocks), wanted, atol=1e-5, rtol=1e-5)
        with policy.cached():
            torch.testing.assert_close(policy.logits(*rows), wanted, atol=1e-5, rtol=1e-5)
            torch.testing.assert_close(policy.logits(*rows[:2], blocks), wanted, atol=1e-5, rtol=1e-5)


def test_it_writes_the_action_alone(small_agent: MakeAgent, make_batch: MakeBatch) -> None:
    data = make_batch(4, 3)
    before = set(data.keys())
    assert set(InferencePolicy(small_agent("vusfa"))(data).keys()) - before == {"action"}


def test_the_likeliest_action_when_that_is_asked_for(small_agent: MakeAgent, make_batch: MakeBatch) -> None:
    agent, data = small_agent("vusfa"), make_batch(50)
    wanted = agent.get_policy_operator().get_dist_params(data.clone())["logits"].argmax(-1)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert torch.equal(InferencePolicy(agent)(data)["action"], wanted)


def test_weights_are_the_agents_own(small_agent: MakeAgent, make_batch: MakeBatch) -> None:
    agent, data = small_agent("gvf"), make_batch(200)
    policy = InferencePolicy(agent)
    policy(data)
    with torch.no_grad():
        agent.policy.linear.bias.zero_()[:, 2] = 1e6
    assert bool((policy(data)["action"] == 2).all())


@pytest.mark.parametrize("batch", [[], [6], [2, 3]], ids=str)
def test_an_agent_with_a_memory_walks_alike(
    small_agent: MakeAgent, scenes: SceneSet, batch: list[int]
) -> None:
    agent = small_agent("vusfa", memory="lstm")
    env = TargetNavEnv(scenes, goals=[2, 9], batch_size=batch, history=1, max_steps=4, seed=0)
    env = TransformedEnv(env, Compose(*agent.make_env_transforms()))
    policy, walks = InferencePolicy(agent), []
    for context, one in (
        (nullcontext(), agent.get_policy_operator(["action"])),
        (nullcontext(), policy),
        (policy.cached(torch.tensor([2, 9])), policy),
    ):
        with context, torch.no_grad():
            env.set_seed(0)
            torch.manual_seed(0)
            walks.append(env.rollout(12, one, break_when_any_done=False))
    assert walks[0]["next", "done"].any()
    for walk in walks[1:]:
        assert set(walk.keys(True)) == set(walks[0].keys(True))
        assert torch.equal(walk["action"], walks[0]["action"])
        for key in ("recurrent_state_h", "recurrent_state_c"):
            torch.testing.assert_close(walk["next", key], walks[0]["next", key])
    with pytest.raises(ConfigError, match=r"reads 'is_init'; give the environment agent.make_env_transforms"):
        policy(env.base_env.reset())


class TestDraws:
    def test_are_categoricals(self) -> None:
        logits = torch.randn(500, 4) * 3
        torch.manual_seed(1)
        wanted = Categorical(logits=logits).sample()
        torch.manual_seed(1)
        assert torch.equal(draw_actions(logits), wanted)

    @pytest.mark.parametrize("rows", [1, 7, 500])
    def test_probs_are_drawn_from_as_multinomial_does(self, rows: int) -> None:
        probs = action_probs(torch.randn(rows, 4) * 3)
        torch.testing.assert_close(probs, Categorical(probs=probs).probs)
        for seed in range(20):
            torch.manual_seed(seed)
            wanted, after = torch.multinomial(probs, 1).squeeze(-1), torch.get_rng_state()
            torch.manual_seed(seed)
            assert torch.equal(draw(probs), wanted)
            assert torch.equal(torch.get_rng_state(), after)

    def test_by_hand(self) -> None:
        logits = torch.tensor([0.0, 1.0, -torch.inf]).expand(20_000, 3)
        share = draw_actions(logits).bincount(minlength=3) / 20_000
        assert share[2].item() == 0
        assert share[1].item() == pytest.approx(2.71828 / 3.71828, abs=0.02)

    def test_a_mean_action_does_not_exist(self) -> None:
        with pytest.raises(NotImplementedError, match="RANDOM or MODE"):
            draw_actions(torch.zeros(2, 4), InteractionType.MEAN)
