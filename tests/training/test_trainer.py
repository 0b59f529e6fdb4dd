"""Settings become a training; hindsight takes its steps besides."""

from __future__ import annotations

import math
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

import vusfa.modules.inference
from vusfa.cli.launch import compose
from vusfa.conf import FOLDER as CONF
from vusfa.errors import ConfigError, VusfaError
from vusfa.modules import TabularPolicy, pretrain_autoencoder
from vusfa.training import Trainer, make_trainer

SMALL = [
    "env.goals=[3,9,12]",
    "agent.hidden_size=8",
    "agent.embedding_size=8",
    "agent.history=1",
    "collector.num_envs=6",
    "collector.rollout=4",
]
HINDSIGHT = ["algorithm=hindsight", "hindsight.batch_size=16", "hindsight.updates=3"]


def made(scene_file: Path, *overrides: str) -> Trainer:
    cfg = compose(CONF, "train", [f"scenes=[{scene_file}]", *SMALL, *overrides])
    settings: Any = OmegaConf.to_container(cfg, resolve=True)
    return make_trainer(settings)


def steps_taken(trainer: Trainer) -> int:
    states = trainer.optimizer.state_dict()["state"]
    return max(int(state["step"]) for state in states.values())


def run(trainer: Trainer, updates: int) -> dict[str, torch.Tensor]:
    with trainer.collecting() as batches:
        for _ in range(updates):
            batch, terms = trainer.update(batches)
            assert batch.shape == (6, 4)
    return terms


def test_without_hindsight_one_step_a_batch(scene_file: Path):
    trainer = made(scene_file)
    terms = run(trainer, 4)
    assert trainer.algorithm.replay_steps == 0
    assert steps_taken(trainer) == 4
    assert "loss_hindsight_critic" not in terms


def test_hindsight_steps_as_often_as_asked(scene_file: Path):
    trainer = made(scene_file, *HINDSIGHT)
    terms = run(trainer, 4)
    assert trainer.algorithm.replay_steps == 2
    assert steps_taken(trainer) == 12
    assert len(trainer.algorithm.replay) == 4 * 6 * 4
    assert math.isfinite(terms["loss_hindsight_critic"].item())


@pytest.mark.parametrize("extra", [[], HINDSIGHT], ids=["usf", "hindsight"])
def test_entropy_and_rate_follow_the_frames(scene_file: Path, extra: list[str]):
    trainer = made(
        scene_file,
        *extra,
        "optim.lr=0.01",
        "optim.horizon=48",
        "entropy.start=1.0",
        "entropy.horizon=48",
        "entropy.end=0.0",
    )
    run(trainer, 2)  # the second update begins at 24 of 48 frames
    assert trainer.algorithm.loss.entropy_coeff == pytest.approx(0.5)
    assert float(trainer.optimizer.param_groups[0]["lr"]) == pytest.approx(0.005)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (
            ["agent.memory=lstm"],
            "algorithm=hindsight cannot train an agent with agent.memory=lstm; give agent.m",
        ),
        (["agent.observation=features"], "agent.observation=features; give agent.observation=index, or"),
        (["collector=multi_async"], "no fixed order"),
        (["hindsight.temperature=0"], "hindsight: "),
        (["hindsight.updates=0"], "hindsight.updates is 0; give 1 or more, or algorithm=usf"),
    ],
)
def test_what_hindsight_cannot_do_is_said(scene_file: Path, overrides: list[str], words: str):
    with pytest.raises(ConfigError, match=words):
        made(scene_file, *HINDSIGHT, *overrides)


def test_an_autoencoders_phi_and_regressed_rewards(scene_file: Path, monkeypatch: pytest.MonkeyPatch):
    briefly = partial(pretrain_autoencoder, steps=100)
    monkeypatch.setattr("vusfa.algorithms.autoencoder.pretrain_autoencoder", briefly)
    trainer = made(scene_file, "preset=autoencoder")
    agent = trainer.agent
    before = {name: value.clone() for name, value in agent.state_dict().items()}
    terms = run(trainer, 3)
    moved = {
        name.split(".")[0] for name, value in agent.state_dict().items() if not value.equal(before[name])
    }
    assert moved == {"fusion", "scene_layer", "successor", "reward", "policy"}
    assert terms["loss_reward"].item() > 0
    assert terms["loss_critic"].item() == 0
    assert trainer.algorithm.explained is not None
    assert 0 < trainer.algorithm.explained <= 1


def test_regression_of_the_reward_needs_reward_weights(scene_file: Path):
    with pytest.raises(ConfigError, match=r"objective\.terms\.reward is 0\.5.*reward_weights"):
        made(scene_file, "agent.model=gvf", "objective.terms.reward=0.5")


@pytest.mark.parametrize(
    ("overrides", "tabulated"),
    [
        (["collector.rollout=100"], True),
        (["collector.rollout=1"], False),  # more pairs than three a frame
        (["collector.rollout=100", "agent.history=4"], False),
    ],
)
def test_where_answers_are_tabulated(
    scene_file: Path, overrides: list[str], tabulated: bool, monkeypatch: pytest.MonkeyPatch
):
    tables = []

    class Counted(TabularPolicy):
        def __init__(self, *args: Any) -> None:
            super().__init__(*args)
            tables.append(self)

    monkeypatch.setattr(vusfa.modules.inference, "TabularPolicy", Counted)
    trainer = made(scene_file, *overrides)
    with trainer.collecting() as batches:
        trainer.collect(batches)
    assert bool(tables) == tabulated


def test_tabulated_or_not_the_same_is_learned(scene_file: Path):
    weights = []
    for cached in (True, False):
        trainer = made(scene_file, "autocast=false", "collector.rollout=100")
        if not cached:
            trainer.acting.cached = lambda *_: nullcontext()
        with trainer.collecting() as batches:
            for _ in range(3):
                trainer.update(batches)
        weights.append(trainer.agent.state_dict())
    torch.testing.assert_close(*weights, rtol=1e-4, atol=1e-5)


def test_weights_that_are_no_numbers_end_the_training(scene_file: Path, tmp_path: Path):
    trainer = made(scene_file)
    path = tmp_path / "checkpoint.pt"
    with trainer.collecting() as batches:
        trainer.update(batches)
        before = trainer.save(path).read_bytes()
        with torch.no_grad():
            trainer.agent.fusion.linear.bias[1] = math.nan
        for call in (trainer.metrics, lambda: trainer.save(path)):
            with pytest.raises(VusfaError, match=r"24 frames.*fusion.linear.bias.*optim.lr"):
                call()
    assert path.read_bytes() == before
