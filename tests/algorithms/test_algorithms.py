"""The registry of algorithms and loss terms, and what an algorithm may ask of the trainer."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf
from torch import nn

from vusfa.algorithms import (
    ALGORITHMS,
    LOSS_TERMS,
    USF,
    Algorithm,
    make_algorithm,
    register_algorithm,
    register_loss_term,
    threads_per_step,
)
from vusfa.cli.launch import compose
from vusfa.conf import settings
from vusfa.errors import CheckpointError, ConfigError
from vusfa.modules import make_agent
from vusfa.objectives import RewardRegressionLoss
from vusfa.scenes import Scene, SceneSet
from vusfa.training import Trainer, make_trainer


@pytest.fixture
def registry() -> Iterator[None]:
    """What a test registers goes with it."""
    tables = (ALGORITHMS, LOSS_TERMS, settings.ALGORITHMS, settings.LOSS_TERMS)
    before = [set(table) for table in tables]
    yield
    for table, names in zip(tables, before, strict=True):
        for name in set(table) - names:
            del table[name]


@pytest.fixture
def trainer_of(scene_file: Path) -> Callable[..., Trainer]:
    def make(*overrides: str, **algorithm: Any) -> Trainer:
        sizes = [
            "agent.hidden_size=8",
            "agent.embedding_size=8",
            "collector.num_envs=6",
            "collector.rollout=4",
        ]
        cfg = compose(overrides=[f"scenes=[{scene_file}]", "env.goals=[3,9,12]", *sizes, *overrides])
        settings: Any = OmegaConf.to_container(cfg, resolve=True)
        settings["algorithm"] |= algorithm
        return make_trainer(settings)

    return make


def test_an_unknown_name_is_refused():
    with pytest.raises(ConfigError, match=r"'hindsite' is registered by no module.*mean 'hindsight'"):
        make_algorithm("hindsite", None, None, {})  # type: ignore[arg-type]


@pytest.mark.usefixtures("registry")
def test_the_trainer_does_what_an_algorithm_says(trainer_of: Callable[..., Trainer]):
    calls: list[str] = []

    @register_algorithm("mine")
    class Mine(Algorithm):
        replay_steps = 2

        def __init__(self, agent, scenes, settings) -> None:
            super().__init__(agent, scenes, settings)
            self.own = nn.Parameter(torch.ones(2))

        def parameters(self):
            return [*self.agent.parameters(), self.own]

        def prepare(self) -> str:
            return "prepared"

        def schedule(self, frames: int) -> None:
            calls.append(f"schedule {frames}")

        def losses(self, batch):
            calls.append(f"losses {tuple(batch.shape)}")
            return {"loss_mine": self.own.sum(), "seen": torch.tensor(1.0)}

        def replay_losses(self):
            calls.append("replay")
            return {"loss_replay": self.own.square().sum()}

        def after_step(self) -> None:
            calls.append("after")

    trainer = trainer_of(name="mine")
    assert trainer.note == "prepared"
    with trainer.collecting() as batches:
        for _ in range(2):
            _, terms = trainer.update(batches)
    once = ["losses (6, 4)", "replay", "replay", "after"]
    assert calls == ["schedule 0", *once, "schedule 24", *once]
    assert set(terms) == {"loss_mine", "seen", "loss_replay", "grad_norm"}
    assert trainer.algorithm.own.max() < 1
    assert trainer.optimizer.state_dict()["state"][len(list(trainer.agent.parameters()))]["step"] == 6


@pytest.mark.usefixtures("registry")
def test_terms_are_added_to_the_papers(trainer_of: Callable[..., Trainer]):
    class Second(RewardRegressionLoss):
        def forward(self, tensordict):
            return {"loss_second": super().forward(tensordict)["loss_reward"]}

    register_loss_term("second", lambda agent, coeff: Second(agent.get_value_operator(), coeff))
    trainer = trainer_of("objective.terms.reward=0.5", "objective.terms.second=0.25")
    assert isinstance(trainer.algorithm, USF)
    with trainer.collecting() as batches:
        _, terms = trainer.update(batches)
    torch.testing.assert_close(terms["loss_second"] * 2, terms["loss_reward"])
    with pytest.raises(
        ConfigError, match=r"objective\.terms\.secnd is registered by no module.*did you mean"
    ):
        trainer_of("+objective.terms.secnd=1")


def test_a_pretrained_encoder_belongs_to_its_algorithm(trainer_of: Callable[..., Trainer]):
    with pytest.raises(ConfigError, match="give algorithm=autoencoder"):
        trainer_of("agent.model=usfa", "agent.pretrained=autoencoder")
    with pytest.raises(ConfigError, match=r"give agent\.pretrained=autoencoder"):
        trainer_of("agent.model=usfa", "algorithm=autoencoder")


def test_a_state_of_another_algorithm_is_refused(make_scene: Callable[..., Scene], trainer_of):
    agent = make_agent("gvf", scenes=SceneSet([make_scene("hall")]), hidden_size=8, embedding_size=8)
    assert Algorithm(agent, None, {}).state_dict() == {}  # type: ignore[arg-type]
    with pytest.raises(CheckpointError, match="of another algorithm"):
        trainer_of().algorithm.load_state_dict({})
    hindsight = trainer_of("algorithm=hindsight").algorithm
    with pytest.raises(CheckpointError, match="of a training without hindsight"):
        hindsight.load_state_dict(trainer_of().algorithm.state_dict())
    search = trainer_of("algorithm=replay_search", "agent.history=1").algorithm
    with pytest.raises(CheckpointError, match="of a training without replay_search"):
        search.load_state_dict(trainer_of().algorithm.state_dict())


@pytest.mark.parametrize(
    ("number", "message"),
    [
        (0, "threads_per_update is 0; give a whole number of 1 or more"),
        (1.5, "threads_per_update is 1.5; give a whole number of 1 or more"),
        (True, "threads_per_update is True; give a whole number of 1 or more"),
        (30, "threads_per_update is 30, which does not divide the 64 threads; give 16 or 32"),
        (65, "threads_per_update is 65, which does not divide the 64 threads; give 64"),
    ],
)
def test_a_bad_share_of_the_threads_is_refused(number: object, message: str) -> None:
    optim = {"kind": "a3c_rmsprop", "options": {"threads_per_update": number}}
    with pytest.raises(ConfigError, match=rf"^optim\.options\.{message}$"):
        threads_per_step({"optim": optim, "collector": {"kind": "single", "num_envs": 64}})
