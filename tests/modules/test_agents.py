from __future__ import annotations

import copy
import json
import pickle
from collections.abc import Callable
from typing import ClassVar

import pytest
import torch
from tensordict import TensorDict
from torch.distributions import Categorical
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import A2CLoss

from vusfa.errors import ConfigError
from vusfa.modules import ARCHITECTURES, MODELS, Agent, SiameseEncoder, make_agent
from vusfa.scenes import SceneSet

MakeAgent = Callable[..., Agent]
MakeBatch = Callable[..., TensorDict]

TRUNK = {"state_embedding": 16, "goal_embedding": 16, "fused": 16, "hidden": 16, "state_value": 1}
SUCCESSOR = {"successor_features": 16, "reward_weights": 16}
GAUSSIAN = {"state_loc": 16, "state_scale": 16, "goal_loc": 16, "goal_scale": 16, "goal_latent": 16}
WRITTEN = {
    "gvf": TRUNK,
    "usfa": {**TRUNK, **SUCCESSOR},
    "sfdp": {**TRUNK, **SUCCESSOR},
    "vusfa": {**TRUNK, **SUCCESSOR, **GAUSSIAN, "state_kl": 1, "goal_kl": 1},
}


@pytest.mark.parametrize("architecture", ARCHITECTURES)
@pytest.mark.parametrize("model", MODELS)
class TestEveryModelInEveryArchitecture:
    @pytest.mark.parametrize("batch", [(), (3,), (2, 5), (60,)])
    def test_keys_and_shapes(
        self,
        small_agent: MakeAgent,
        make_batch: MakeBatch,
        model: str,
        architecture: str,
        batch: tuple[int, ...],
    ) -> None:
        agent, data = small_agent(model, architecture), make_batch(*batch)
        critic = agent.get_value_operator()(data.clone())
        new = {key: tuple(critic[key].shape) for key in set(critic.keys()) - set(data.keys())}
        assert new == {key: (*batch, size) for key, size in WRITTEN[model].items()}
        assert all(critic[key].dtype == torch.float32 for key in new)
        actor = agent.get_policy_operator()(data.clone())
        new = {key: tuple(actor[key].shape) for key in set(actor.keys()) - set(data.keys())}
        assert new == {"action": batch, "action_log_prob": batch}
        assert actor["action"].dtype == torch.int64
        assert agent.get_policy_operator().get_dist(data.clone()).logits.shape == (*batch, 4)

    def test_features_give_the_same_numbers(
        self, small_agent: MakeAgent, make_batch: MakeBatch, scenes: SceneSet, model: str, architecture: str
    ) -> None:
        """The weights of one agent load into the other, and what they write agrees; noise as well."""
        by_id, fed = (
            small_agent(model, architecture),
            small_agent(model, architecture, seed=1, observation="features"),
        )
        fed.load_state_dict(by_id.state_dict())
        for rows in (3, 60):
            data = make_batch(rows)
            observed = data.exclude("state_id", "goal_id")
            observed["observation"] = scenes.features[data["state_id"], 0]
            observed["goal_observation"] = scenes.features[data["goal_id"], 0]
            outcomes = []
            for agent, inputs in ((by_id, data), (fed, observed)):
                torch.manual_seed(0)
                critic = agent.get_value_operator()(inputs.clone()).select(*WRITTEN[model])
                logits = agent.get_policy_operator().get_dist_params(inputs.clone())["logits"]
                outcomes.append([*critic.values(), logits])
            for ours, theirs in zip(*outcomes, strict=True):
                torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)

    def test_config_rebuilds_the_agent(
        self, small_agent: MakeAgent, scenes: SceneSet, model: str, architecture: str
    ) -> None:
        agent = small_agent(model, architecture)
        stored = json.loads(json.dumps(agent.config))
        assert (stored["scenes"], stored["fingerprint"]) == (["hall", "attic", "cellar"], scenes.fingerprint)
        of_scenes = ("scenes", "fingerprint", "num_actions")
        again = make_agent(scenes=scenes, **{k: v for k, v in stored.items() if k not in of_scenes})
        again.load_state_dict(agent.state_dict())
        assert again.config == agent.config

    def test_copies_and_pickles_share_as_the_original_does(
        self, small_agent: MakeAgent, make_batch: MakeBatch, model: str, architecture: str
    ) -> None:
        """Workers get a copy; in it, actor and critic must still be made of the agent's own layers."""
        agent, data = small_agent(model, architecture), make_batch(5)
        wanted = agent.eval().get_policy_operator().get_dist(data.clone()).logits
        for clone in (copy.deepcopy(agent), pickle.loads(pickle.dumps(agent))):
            torch.testing.assert_close(clone.get_policy_operator().get_dist(data.clone()).logits, wanted)
            held = {id(p) for p in clone.parameters()}
            assert {id(p) for p in clone.get_policy_operator().parameters()} < held
            assert {id(p) for p in clone.get_value_operator().parameters()} < held


class TestOperators:
    @pytest.mark.parametrize("model", MODELS)
    def test_the_trunk_is_the_same_object(self, small_agent: MakeAgent, model: str) -> None:
        agent = small_agent(model)
        actor, critic = list(agent.get_policy_operator().module), list(agent.get_value_operator().module)
        shared = [module for module in actor if any(module is other for other in critic)]
        names = [type(module.module).__name__ for module in shared]
        psi = ["SuccessorHead"] if model in ("sfdp", "vusfa") else []
        assert names == ["SiameseTrunk", "SceneLayer", *psi]
        assert all(a is b for a, b in zip(actor[:-1], agent.get_policy_operator().module[:-1], strict=True))

    @pytest.mark.parametrize(("model", "computed"), [("usfa", False), ("sfdp", True), ("vusfa", True)])
    def test_the_actor_computes_psi_only_if_it_reads_it(
        self, small_agent: MakeAgent, make_batch: MakeBatch, model: str, computed: bool
    ) -> None:
        params = small_agent(model).get_policy_operator().get_dist_params(make_batch(3))
        assert ("successor_features" in sorted(params.keys())) == computed
        assert "reward_weights" not in sorted(params.keys())

    def test_more_can_be_kept(self, small_agent: MakeAgent, make_batch: MakeBatch) -> None:
        actor = small_agent("sfdp").get_policy_operator(out_keys=["action", "successor_features"])
        out = actor(make_batch(3))
        assert out["successor_features"].shape == (3, 16)
        assert "action_log_prob" not in sorted(out.keys())

    def test_samples_follow_the_logits(self, small_agent: MakeAgent, make_batch: MakeBatch) -> None:
        actor, data = small_agent("gvf").get_policy_operator(), make_batch(1)
        torch.manual_seed(0)
        out = actor(data.expand(20_000).clone())
        probs = actor.get_dist(data.clone()).probs[0]
        frequency = torch.bincount(out["action"], minlength=4) / 20_000
        torch.testing.assert_close(frequency, probs.detach(), atol=0.015, rtol=0)
        torch.testing.assert_close(out["action_log_prob"], probs.log()[out["action"]])

    def test_deterministic_exploration(self, small_agent: MakeAgent, make_batch: MakeBatch) -> None:
        actor, data = small_agent("gvf").get_policy_operator(), make_batch(50)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            action = actor(data.clone())["action"]
        assert torch.equal(action, actor.get_dist(data.clone()).logits.argmax(-1))

    def test_torchrls_own_loss(self, small_agent: MakeAgent, make_batch: MakeBatch) -> None:
        agent, data = small_agent("gvf"), make_batch(6)
        data = agent.get_policy_operator()(data).detach()
        data["advantage"], data["value_target"] = torch.randn(6, 1), torch.randn(6, 1)
        loss = A2CLoss(agent.get_policy_operator(), agent.get_value_operator())
        terms = loss(data)
        sum(value for key, value in terms.items() if key.startswith("loss")).backward()
        assert all(parameter.grad.any() for parameter in agent.parameters())


def siamese(agent: Agent) -> SiameseEncoder:
    return next(module for module in agent.modules() if isinstance(module, SiameseEncoder))


def gradients(agent: Agent, key: str, data: TensorDict) -> set[str]:
    """Names of the parameters that a sum of squares of ``key`` has a gradient for."""
    agent.zero_grad()
    if key == "logits":
        out = agent.get_policy_operator().get_dist_params(data.clone())
    else:
        out = agent.get_value_operator()(data.clone())
    out[key].square().sum().backward()
    return {name for name, p in agent.named_parameters() if p.grad is not None and p.grad.any()}


def heads(names: set[str]) -> set[str]:
    return {name.split(".")[0] for name in names}


class TestGradients:
    """Which layers learn from what."""

    @pytest.mark.parametrize("architecture", ARCHITECTURES)
    @pytest.mark.parametrize("model", ["sfdp", "vusfa"])
    def test_the_policys_gradient_stops_at_psi(
        self, small_agent: MakeAgent, make_batch: MakeBatch, model: str, architecture: str
    ) -> None:
        agent = small_agent(model, architecture)
        assert heads(gradients(agent, "logits", make_batch(30))) == {
            "encoder",
            "fusion",
            "scene_layer",
            "policy",
        }

    @pytest.mark.parametrize("model", ["usfa", "sfdp", "vusfa"])
    def test_the_value_trains_psi_omega_and_trunk(
        self, small_agent: MakeAgent, make_batch: MakeBatch, model: str
    ) -> None:
        trained = heads(gradients(small_agent(model), "state_value", make_batch(30)))
        assert trained == {"encoder", "fusion", "scene_layer", "successor", "reward"}

    def test_the_policy_does_not_train_the_goals_scale_but_the_value_does(
        self, small_agent: MakeAgent, make_batch: MakeBatch
    ) -> None:
        agent, data = small_agent("vusfa"), make_batch(30)
        bias = siamese(agent).branch.last.bias
        gradients(agent, "logits", data)
        assert not bias.grad[16:].any()
        gradients(agent, "state_value", data)
        assert bias.grad[16:].all()

    def test_a_scene_trains_its_own_heads(self, small_agent: MakeAgent, make_batch: MakeBatch) -> None:
        agent, data = small_agent("sfdp"), make_batch(30)
        data["scene_id"] = torch.ones_like(data["scene_id"])
        gradients(agent, "logits", data)
        for layer in (agent.scene_layer.linear, agent.policy.first, agent.policy.last):
            assert [bool(part.any()) for part in layer.weight.grad] == [False, True, False]


class TestLatents:
    def values(self, agent: Agent, data: TensorDict, seed: int) -> tuple[torch.Tensor, ...]:
        torch.manual_seed(seed)
        critic = agent.get_value_operator()(data.clone())
        logits = agent.get_policy_operator().get_dist(data.clone()).logits
        return critic["state_value"], critic["successor_features"], logits

    @pytest.mark.parametrize(
        ("mode", "eval_latent", "noisy"),
        [
            ("train", "mean", True),
            ("eval", "mean", False),
            ("eval", "sample", True),
            ("train", "sample", True),
        ],
    )
    def test_only_the_value_is_noisy(
        self, small_agent: MakeAgent, make_batch: MakeBatch, mode: str, eval_latent: str, noisy: bool
    ) -> None:
        agent = small_agent("vusfa", eval_latent=eval_latent, initial_scale=0.5).train(mode == "train")
        (value, *rest), (other, *others) = (self.values(agent, make_batch(5), seed) for seed in (0, 1))
        assert bool((value != other).any()) == noisy
        for ours, theirs in zip(rest, others, strict=True):
            assert torch.equal(ours, theirs)

    def test_each_row_has_noise_of_its_own(self, small_agent: MakeAgent, make_batch: MakeBatch) -> None:
        """The goal is encoded once, but sampled for every row."""
        data = make_batch(1).expand(6).clone()
        critic = small_agent("vusfa").get_value_operator()(data)
        assert len(critic["goal_latent"].unique(dim=0)) == 6
        assert len(critic["goal_loc"].unique(dim=0)) == 1

    def test_omega_reads_the_sample(self, small_agent: MakeAgent, make_batch: MakeBatch) -> None:
        agent = small_agent("vusfa")
        critic = agent.get_value_operator()(make_batch(5))
        torch.testing.assert_close(critic["reward_weights"], agent.reward(critic["goal_latent"]))

    @pytest.mark.parametrize("architecture", ["paper", "reference"])
    def test_embeddings_are_the_means(
        self, small_agent: MakeAgent, make_batch: MakeBatch, architecture: str
    ) -> None:
        critic = small_agent("vusfa", architecture).get_value_operator()(make_batch(5))
        assert critic["state_embedding"] is critic["state_loc"]
        assert critic["goal_embedding"] is critic["goal_loc"]

    def test_controlled_embeddings_are_the_means_normalized(
        self, small_agent: MakeAgent, make_batch: MakeBatch
    ) -> None:
        critic = small_agent("vusfa").get_value_operator()(make_batch(5))
        for which in ("state", "goal"):
            loc, embedding = critic[f"{which}_loc"], critic[f"{which}_embedding"]
            deviation = loc.std(-1, correction=0, keepdim=True)
            wanted = (loc - loc.mean(-1, keepdim=True)) / deviation
            torch.testing.assert_close(embedding, wanted, rtol=1e-2, atol=1e-2)

    def test_exploration_types_do_not_silence_it(self, small_agent: MakeAgent, make_batch: MakeBatch) -> None:
        """TorchRL's losses run deterministically; z must be drawn all the same."""
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            critic = small_agent("vusfa").get_value_operator()(make_batch(5))
        assert (critic["goal_latent"] != critic["goal_loc"]).all()


class TestPictures:
    SIZE: ClassVar = {"picture_size": (40, 44)}

    def test_pixels_and_ids_give_the_same_numbers(
        self, small_agent: MakeAgent, make_batch: MakeBatch, filmed: SceneSet
    ) -> None:
        by_id = small_agent("vusfa", scenes=filmed, encoder="conv", **self.SIZE).eval()
        by_eye = small_agent("vusfa", scenes=filmed, observation="pixels", seed=1, **self.SIZE).eval()
        by_eye.load_state_dict(by_id.state_dict())
        for rows in (3, 20):
            data = make_batch(rows, world=filmed)
            seen = data.exclude("state_id", "goal_id")
            seen["observation"] = filmed.pictures(data["state_id"]).movedim(-1, -3)
            seen["goal_observation"] = filmed.pictures(data["goal_id"]).movedim(-1, -3)
            ours, theirs = by_id.get_value_operator()(data), by_eye.get_value_operator()(seen)
            for key in ("state_embedding", "goal_embedding", "state_value"):
                torch.testing.assert_close(ours[key], theirs[key], rtol=1e-4, atol=1e-5)

    def test_convolutions_learn(
        self, small_agent: MakeAgent, make_batch: MakeBatch, filmed: SceneSet
    ) -> None:
        agent = small_agent("gvf", scenes=filmed, encoder="conv", **self.SIZE)
        trained = gradients(agent, "state_value", make_batch(5, world=filmed))
        assert len([name for name in trained if "convolutions" in name and "weight" in name]) == 3

    def test_each_distinct_picture_once(
        self, small_agent: MakeAgent, make_batch: MakeBatch, filmed: SceneSet
    ) -> None:
        agent = small_agent("gvf", scenes=filmed, encoder="conv", **self.SIZE)
        seen: list[int] = []
        convolutions = siamese(agent).frames.convolutions
        convolutions.register_forward_pre_hook(lambda _, inputs: seen.append(len(inputs[0])))
        agent.get_value_operator()(make_batch(200, world=filmed))
        assert seen == [6]

    def test_rooms_without_pictures(self, small_agent: MakeAgent) -> None:
        with pytest.raises(ValueError, match="picture"):
            small_agent("gvf", encoder="conv")


class TestTables:
    def test_the_scenes_tables_are_not_saved(self, small_agent: MakeAgent) -> None:
        assert not [name for name in small_agent().state_dict() if "table" in name]

    def test_tables_move_with_the_agent(self, small_agent: MakeAgent, scenes: SceneSet) -> None:
        before = scenes.features.clone()
        assert siamese(small_agent("sfdp").to(torch.float64)).frames.table.dtype == torch.float64
        assert torch.equal(scenes.features, before)

    def test_one_scene(self, small_agent: MakeAgent, make_batch: MakeBatch, filmed: SceneSet) -> None:
        agent = small_agent("sfdp", scenes=filmed)
        assert agent.policy.last.weight.shape == (1, 4, 16)
        assert agent.get_value_operator()(make_batch(5, world=filmed))["state_value"].shape == (5, 1)


def test_scenes_are_needed() -> None:
    with pytest.raises(ConfigError, match=r"needs scenes=\.\.\."):
        make_agent("gvf")


def test_sampler_is_categorical(small_agent: MakeAgent, make_batch: MakeBatch) -> None:
    assert isinstance(small_agent().get_policy_operator().get_dist(make_batch(2)), Categorical)
