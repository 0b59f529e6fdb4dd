"""A training in a few scenes at a time: heads that are lent, resumption, and every algorithm."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from tests.training.few_scenes import SMALL
from vusfa.errors import ConfigError
from vusfa.modules import make_agent, pretrain_autoencoder
from vusfa.objectives import TFRMSprop
from vusfa.scenes import Scene, SceneSet
from vusfa.training import Trainer, make_trainer
from vusfa.training.active_heads import ActiveHeads

SIZES = {"hidden_size": 8, "embedding_size": 8, "history": 1}


@pytest.fixture
def five(make_scene: Callable[..., Scene]) -> SceneSet:
    return SceneSet(make_scene(f"room {index}") for index in range(5))


@pytest.fixture
def made(settings: Callable[..., Any], five: SceneSet) -> Callable[..., Trainer]:
    def make(*overrides: str) -> Trainer:
        plain: Any = OmegaConf.to_container(settings(*SMALL, *overrides))
        return make_trainer(plain, scenes=five)

    return make


def run(trainer: Trainer, updates: int, path: Path | None = None) -> set[int]:
    """Scenes of the batches."""
    seen: set[int] = set()
    with trainer.collecting() as batches:
        for _ in range(updates):
            seen |= set(trainer.update(batches)[0]["scene_id"].unique().tolist())
        if path is not None:
            trainer.save(path)
    return seen


def values(trainer: Trainer) -> list[torch.Tensor]:
    moments = trainer.optimizer.state_dict()["state"].values()
    return [*trainer.agent.state_dict().values(), *(value for state in moments for value in state.values())]


@pytest.mark.parametrize("make", [torch.optim.Adam, TFRMSprop])
def test_only_lent_heads_are_stepped_and_all_come_back(five: SceneSet, make: Any) -> None:
    agent, whole = (make_agent("vusfa", scenes=five, **SIZES) for _ in range(2))
    whole.load_state_dict(agent.state_dict())
    before = {name: value.clone() for name, value in agent.state_dict().items()}
    optimizers = [make(each.parameters(), lr=0.01) for each in (agent, whole)]
    heads = ActiveHeads(agent, optimizers[0])
    for scenes in ([0, 3], [3, 4], [0, 3]):
        heads.load(torch.tensor(scenes), exactly=True)
        assert agent.scene_layer.linear.weight.shape[0] == agent.num_scenes == 2
        for each, optimizer in zip((agent, whole), optimizers, strict=True):
            hidden, scene = torch.ones(4, 8), torch.tensor(scenes).repeat_interleave(2)
            optimizer.zero_grad()
            each.scene_layer.linear(hidden, scene).square().sum().backward()
            optimizer.step()
    with heads.whole():
        weight = agent.scene_layer.linear.weight
        assert weight.shape == before["scene_layer.linear.weight"].shape
        assert torch.equal(weight[[1, 2]], before["scene_layer.linear.weight"][[1, 2]])
        assert not torch.equal(weight[4], before["scene_layer.linear.weight"][4])
        state = optimizers[0].state[weight]
        shaped = [value for value in state.values() if value.shape == weight.shape]
        assert shaped
        # 3 was lent all the time: as if all of them had been trained
        assert torch.equal(weight[3], whole.scene_layer.linear.weight[3])
    assert agent.scene_layer.linear.weight.shape[0] == 2


@pytest.mark.parametrize(
    "extra",
    [
        ["env.goal_sampling=fixed"],
        ["env.goal_sampling=episode"],
        ["algorithm=hindsight", "hindsight.batch_size=16", "hindsight.updates=2", "hindsight.capacity=200"],
        ["algorithm=replay_search", "algorithm.learning_starts=24", "algorithm.batch_size=64"],
        ["preset=autoencoder", "agent.history=1", "collector.num_envs=6", "collector.rollout=4"],
        ["agent.history=2", "agent.shared_heads=true"],
        ["agent.memory=lstm"],
        ["optim=rmsprop"],
        ["collector.num_envs=12", "optim=a3c", "optim.options.threads_per_update=6"],
    ],
    ids=["fixed", "episode", "hindsight", "search", "autoencoder", "shared", "lstm", "rmsprop", "a3c"],
)
def test_a_resumed_training_goes_on_number_for_number(
    made: Callable[..., Trainer], tmp_path: Path, extra: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    briefly = partial(pretrain_autoencoder, steps=20)
    monkeypatch.setattr("vusfa.algorithms.autoencoder.pretrain_autoencoder", briefly)
    straight = made(*extra)
    seen = run(straight, 10)
    assert len(seen) > 2
    run(made(*extra), 5, tmp_path / "half.pt")
    resumed = made(*extra)
    resumed.resume(tmp_path / "half.pt")
    run(resumed, 5)
    for one, other in zip(values(straight), values(resumed), strict=True):
        assert torch.equal(one, other)


def test_saving_changes_nothing_and_a_checkpoint_has_all_heads(
    made: Callable[..., Trainer], tmp_path: Path
) -> None:
    plain = made()
    run(plain, 6)
    saving = made()
    with saving.collecting() as batches:
        for _ in range(6):
            saving.update(batches)
            saving.save(tmp_path / "run.pt")
    assert all(torch.equal(*pair) for pair in zip(values(plain), values(saving), strict=True))
    assert len(torch.load(tmp_path / "run.pt")["agent"]["scene_layer.linear.weight"]) == 5


def test_a_worker_rotates_too(made: Callable[..., Trainer], fast_workers: None) -> None:
    trainer = made("collector=multi_sync", "collector.num_workers=2", "env.goal_sampling=episode")
    assert trainer.heads is None
    assert len(run(trainer, 10)) > 2


def test_goals_that_no_environment_could_have(made: Callable[..., Trainer]) -> None:
    with pytest.raises(ConfigError, match=r"collector.num_envs=6 leaves some of the 8 goals"):
        made("env.goals=random:4", "env.goal_sampling=fixed")
    with pytest.raises(ConfigError, match=r"lend each process some; give agent.shared_heads=true"):
        made("collector=hogwild", "collector.num_envs=6", "optim=tf_rmsprop")
