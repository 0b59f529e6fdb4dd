"""The agents as TorchRL's own parts run them: losses, vmap, compile, export, other number types."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv
from torchrl.objectives import A2CLoss, ClipPPOLoss, KLPENPPOLoss, LossModule, PPOLoss, ReinforceLoss
from torchrl.objectives.value import GAE, TD0Estimator, VTrace

from vusfa.envs import SceneObservation, TargetNavEnv
from vusfa.errors import ConfigError
from vusfa.modules import Agent, FeatureFrames, InferencePolicy
from vusfa.scenes import SceneSet

MakeAgent = Callable[..., Agent]
MakeBatch = Callable[..., TensorDict]

MODELS = ("gvf", "usfa", "sfdp", "vusfa")
KINDS: list[dict[str, Any]] = [
    {},
    {"history": 1},
    {"architecture": "reference"},
    {"shared_heads": True},
    {"deduplicate": False},
    {"observation": "features"},
    {"memory": "lstm"},
]
LOSSES: list[type[LossModule]] = [A2CLoss, PPOLoss, ClipPPOLoss, KLPENPPOLoss, ReinforceLoss]


@torch.no_grad()
def collected(agent: Agent, scenes: SceneSet, steps: int = 12, rows: int = 5) -> TensorDict:
    """A rollout with all that TorchRL's losses read."""
    goals = {"hall": [1, 3], "attic": [2, 4]}
    env = TransformedEnv(TargetNavEnv(scenes, goals, [rows], max_steps=7, seed=0))
    if agent.config["observation"] == "features":
        env.append_transform(SceneObservation(scenes))
    env.append_transform(Compose(*agent.make_env_transforms()))
    actor = agent.get_policy_operator(["action", "action_log_prob", "logits"])
    return env.rollout(steps, actor, break_when_any_done=False)


@pytest.mark.parametrize("kind", KINDS[:6], ids=str)
@pytest.mark.parametrize("model", MODELS)
def test_losses_with_their_default_estimators(
    small_agent: MakeAgent, scenes: SceneSet, model: str, kind: dict[str, Any]
) -> None:
    """Nothing is set: the default GAE runs the critic under vmap."""
    agent = small_agent(model, **kind)
    data = collected(agent, scenes)
    for loss_class in LOSSES:
        agent.zero_grad()
        loss = loss_class(agent.get_policy_operator(), agent.get_value_operator())
        terms = loss(data.clone())
        total = sum(value for key, value in terms.items() if key.startswith("loss_"))
        total.backward()
        assert total.isfinite()
        assert all(p.grad is not None and p.grad.any() for p in agent.policy.parameters())
        assert agent.encoder.branch.first.weight.grad.any()


@pytest.mark.parametrize("kind", KINDS[:6], ids=str)
def test_gae_under_vmap_is_gae_one_by_one(
    small_agent: MakeAgent, scenes: SceneSet, kind: dict[str, Any]
) -> None:
    agent = small_agent("vusfa", **kind).eval()  # no noise
    data, critic = collected(agent, scenes), agent.get_value_operator()
    ours, theirs = (
        GAE(gamma=0.9, lmbda=0.8, value_network=critic, deactivate_vmap=plain)(data.clone())
        for plain in (False, True)
    )
    for key in ("advantage", "value_target", "state_value"):
        torch.testing.assert_close(ours[key], theirs[key], rtol=1e-4, atol=1e-5)


def test_a_critic_draws_noise_of_its_own_under_vmap(small_agent: MakeAgent, scenes: SceneSet) -> None:
    agent = small_agent("vusfa", initial_scale=0.5)
    data = collected(agent, scenes)
    estimator = GAE(gamma=0.9, lmbda=0.8, value_network=agent.get_value_operator())
    assert estimator.vmap_randomness == "different"
    first, second = (estimator(data.clone())["state_value"] for _ in range(2))
    assert not torch.equal(first, second)


def test_other_estimators(small_agent: MakeAgent, scenes: SceneSet) -> None:
    agent = small_agent("vusfa").eval()
    data, critic, actor = collected(agent, scenes), agent.get_value_operator(), agent.get_policy_operator()
    for estimator in (
        TD0Estimator(gamma=0.9, value_network=critic),
        VTrace(gamma=0.9, value_network=critic, actor_network=actor),
    ):
        assert estimator(data.clone())["advantage"].isfinite().all()


def test_an_lstm_needs_vmap_switched_off(small_agent: MakeAgent, scenes: SceneSet) -> None:
    """torch has no LSTM under vmap; TorchRL's way around it is one argument."""
    agent = small_agent("sfdp", memory="lstm")
    data, critic = collected(agent, scenes), agent.get_value_operator()
    loss = A2CLoss(agent.get_policy_operator(), critic)
    GAE(gamma=0.9, lmbda=0.8, value_network=critic, deactivate_vmap=True)(data)
    terms = loss(data)
    assert sum(value for key, value in terms.items() if key.startswith("loss_")).isfinite()


@pytest.mark.parametrize("kind", KINDS[:3], ids=str)
def test_row_by_row_is_the_same(small_agent: MakeAgent, make_batch: MakeBatch, kind: dict[str, Any]) -> None:
    agent, plain = small_agent("vusfa", **kind), small_agent("vusfa", **kind, deduplicate=False)
    for rows in (3, 40):
        data = make_batch(rows, history=agent.config["history"])
        outcomes = []
        for one in (agent.eval(), plain.eval()):
            value = one.get_value_operator()(data.clone())["state_value"]
            outcomes.append([value, *torch.autograd.grad(value.square().sum(), one.scene_layer.parameters())])
        torch.testing.assert_close(*outcomes, rtol=1e-4, atol=1e-5)


def test_weights_may_be_a_batch(small_agent: MakeAgent, make_batch: MakeBatch) -> None:
    """An ensemble of critics, as TorchRL's losses hold them."""
    agents = [small_agent("vusfa", seed=seed).eval() for seed in range(3)]
    data, critic = make_batch(6), agents[0].get_value_operator()
    weights = torch.stack([TensorDict.from_module(agent.get_value_operator()) for agent in agents])

    def value(parameters: TensorDict, rows: TensorDict) -> torch.Tensor:
        with parameters.to_module(critic):
            return critic(rows)["state_value"]

    with torch.no_grad():
        together = torch.vmap(value, (0, None))(weights, data)
        for agent, found in zip(agents, together, strict=True):
            torch.testing.assert_close(found, agent.get_value_operator()(data.clone())["state_value"])


@pytest.mark.parametrize("deduplicate", [True, False])
def test_compiles_as_one_graph(small_agent: MakeAgent, make_batch: MakeBatch, deduplicate: bool) -> None:
    agent, data = small_agent("vusfa", deduplicate=deduplicate).eval(), make_batch(6)
    critic = agent.get_value_operator()
    torch.compiler.reset()
    module = critic if deduplicate else InferencePolicy(agent)
    after = torch.compile(module, fullgraph=True, backend="eager")(data.clone())
    if deduplicate:
        torch.testing.assert_close(after["state_value"], critic(data.clone())["state_value"])
    else:
        assert after["action"].shape == (6,)


def test_exports(small_agent: MakeAgent, make_batch: MakeBatch) -> None:
    agent, data = small_agent("vusfa").eval(), make_batch(6)
    critic = agent.get_value_operator()
    program = torch.export.export(critic, args=(), kwargs=dict(data.items()), strict=False)
    other = make_batch(6, seed=1)
    written = program.module()(**dict(other.items()))
    torch.testing.assert_close(written[-1], critic(other.clone())["state_value"])


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16, torch.bfloat16])
@pytest.mark.parametrize("kind", [*KINDS[:3], *KINDS[5:]], ids=str)
def test_other_number_types(
    small_agent: MakeAgent, scenes: SceneSet, dtype: torch.dtype, kind: dict[str, Any]
) -> None:
    agent = small_agent("vusfa", **kind).to(dtype)
    for rows in (3, 25):
        written = agent.get_value_operator()(collected(agent, scenes, steps=3, rows=rows))
        assert written["state_value"].dtype == written["successor_features"].dtype == dtype
        written["state_value"].sum().backward()
        if agent.memory is None:
            policy = InferencePolicy(agent)
            with policy.cached(), torch.no_grad():
                assert policy(written)["action"].dtype == torch.int64


def test_double_precision_by_default(small_agent: MakeAgent, scenes: SceneSet) -> None:
    try:
        torch.set_default_dtype(torch.float64)
        agent = small_agent("vusfa")
        written = agent.get_value_operator()(collected(agent, scenes, steps=3))
    finally:
        torch.set_default_dtype(torch.float32)
    assert written["state_value"].dtype == torch.float64


class TestWrongUses:
    @pytest.mark.parametrize("rows", [2, 60])
    @pytest.mark.parametrize("history", [1, 4])
    def test_another_world(
        self, small_agent: MakeAgent, make_batch: MakeBatch, filmed: SceneSet, rows: int, history: int
    ) -> None:
        agent = small_agent("vusfa", scenes=filmed, history=history)  # 6 states
        data = make_batch(rows, history=history)
        data["state_id"][0] = 20
        for policy in (agent.get_policy_operator(), agent.get_value_operator(), InferencePolicy(agent)):
            with pytest.raises(
                ConfigError, match=r"state_id holds \d+, and the agent's scenes have the states 0..5"
            ):
                policy(data.clone())

    @pytest.mark.parametrize("model", ["gvf", "vusfa"])
    def test_a_scene_without_weights(self, small_agent: MakeAgent, make_batch: MakeBatch, model: str) -> None:
        agent, data = small_agent(model), make_batch(6)
        data["scene_id"][2] = 3
        for policy in (agent.get_policy_operator(), agent.get_value_operator(), InferencePolicy(agent)):
            with pytest.raises(ConfigError, match="scene_id holds 3, and the agent has weights for 3 scenes"):
                policy(data.clone())

    def test_missing_entries(self, small_agent: MakeAgent, make_batch: MakeBatch) -> None:
        lstm, seeing = small_agent(memory="lstm"), small_agent(observation="features")
        for operator in ("get_policy_operator", "get_value_operator"):
            with pytest.raises(ConfigError, match=r"transforms of agent.make_env_transforms\(\)"):
                getattr(lstm, operator)()(make_batch(3, history=1))
            with pytest.raises(ConfigError, match="append the transform vusfa"):
                getattr(seeing, operator)()(make_batch(3))
        with pytest.raises(ConfigError, match="SceneObservation adds observations"):
            InferencePolicy(seeing)(make_batch(3))


class TestScaleOfFeatures:
    @pytest.mark.parametrize("change", [lambda x: x * 1e-4, lambda x: x.softmax(-1) ** 2, lambda x: x * 1e5])
    def test_any_scale_is_normalized(self, scenes: SceneSet, change: Callable[[Any], Any]) -> None:
        table = FeatureFrames(change(scenes.features), normalize=True).lookup(None)
        torch.testing.assert_close(table.std(0, correction=0), torch.ones(12), rtol=1e-3, atol=0)

    def test_the_bundled_rooms_as_ever(self) -> None:
        features = SceneSet.bundled(["bathroom"]).features
        deviation = features[:, 0].std(0, correction=0)
        assert (deviation < 1e-3).any()
        assert torch.equal(FeatureFrames(features, normalize=True).deviation, deviation.clamp(min=1e-3))

    def test_constant_features_are_named(self) -> None:
        features = torch.rand(6, 1, 9) * 1e-5
        features[..., [1, 4]] = 0.7
        with pytest.warns(UserWarning, match=r"2 of 9 features are the same in all states.*columns \[1, 4\]"):
            table = FeatureFrames(features, normalize=True).lookup(None)
        assert table[:, [1, 4]].abs().max() < 0.1
        with pytest.raises(ConfigError, match="none of the 9 features changes over 6 states"):
            FeatureFrames(torch.ones(6, 1, 9), normalize=True)
