"""The pretrained encoder: it says what was seen, and stays as it is."""

from __future__ import annotations

import pytest
import torch

from vusfa.errors import ConfigError
from vusfa.modules import explained_features, make_agent, pretrain_autoencoder
from vusfa.scenes import SceneSet


@pytest.fixture(scope="module")
def rooms() -> SceneSet:
    return SceneSet.bundled(["bathroom"])


def test_the_mean_explains_nothing_and_the_features_explain_themselves() -> None:
    features = torch.rand(9, 4)
    assert explained_features(features.mean(0).expand(9, 4), features) == pytest.approx(0, abs=1e-6)
    assert explained_features(features, features) == 1


@pytest.mark.parametrize("history", [1, 4])
def test_pretraining_explains_most_of_what_was_seen(rooms: SceneSet, history: int) -> None:
    torch.manual_seed(0)
    sizes = {"history": history, "hidden_size": 64, "embedding_size": 32}
    agent = make_agent("usfa", scenes=rooms, pretrained="autoencoder", **sizes)
    before = pretrain_autoencoder(agent, steps=0)
    after = pretrain_autoencoder(agent, steps=150, batch_size=128, lr=3e-3)
    features = agent.encoder.frames.lookup(None)
    centred = features - features.mean(0)
    best = torch.linalg.svdvals(centred).square()
    linear = (best[:32].sum() / best.sum()).item()
    assert before < 0.1
    assert 0.7 * linear < after <= 1


def test_only_the_encoder_is_constant(rooms: SceneSet) -> None:
    agent = make_agent("usfa", scenes=rooms, history=1, hidden_size=8, pretrained="autoencoder")
    pretrain_autoencoder(agent, steps=1)
    moving = {name.split(".")[0] for name, param in agent.named_parameters() if param.requires_grad}
    constant = {name.split(".")[0] for name, param in agent.named_parameters() if not param.requires_grad}
    assert constant == {"encoder"}
    assert moving >= {"fusion", "scene_layer", "successor", "reward", "policy"}


def test_the_same_seed_makes_the_same_encoder(rooms: SceneSet) -> None:
    made = []
    for _ in range(2):
        torch.manual_seed(3)
        agent = make_agent("usfa", scenes=rooms, history=1, hidden_size=8, pretrained="autoencoder")
        pretrain_autoencoder(agent, steps=20, seed=5)
        made.append(agent.state_dict())
    torch.testing.assert_close(*made, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"model": "vusfa"}, "no Gaussian"),
        ({"model": "usfa", "shared_encoder": False}, "one code for states and goals"),
        ({"model": "usfa", "observation": "pixels"}, "reconstructs the scenes' features"),
        ({"model": "usfa", "architecture": "paper"}, "pretrained is no part of architecture 'paper'"),
    ],
)
def test_what_cannot_be_pretrained(rooms: SceneSet, settings: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_agent(scenes=rooms, pretrained="autoencoder", **settings)


def test_other_agents_keep_their_encoder(rooms: SceneSet) -> None:
    with pytest.raises(ConfigError, match="made with pretrained='autoencoder'"):
        pretrain_autoencoder(make_agent("usfa", scenes=rooms, history=1, hidden_size=8))
