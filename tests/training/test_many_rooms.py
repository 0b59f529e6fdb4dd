"""Trainings and evaluations in rooms that are opened lazily."""

from __future__ import annotations

import collections
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from tests.training.few_scenes import SMALL
from vusfa.errors import ConfigError, SceneError
from vusfa.evaluation import evaluate
from vusfa.evaluation.exact import exact_goals
from vusfa.experiments.measure import evaluation_policy, measure_goals, probabilities_by_scene
from vusfa.experiments.validation import Validation
from vusfa.modules import InferencePolicy, TabularPolicy, make_agent
from vusfa.scenes import Scene, SceneSet, places
from vusfa.training import Trainer, load_agent, make_loggers, make_trainer


@pytest.fixture
def rooms(tmp_path: Path, make_scene: Callable[..., Scene]) -> Path:
    for index in range(5):
        scene = make_scene(f"room {index}")
        pictures = np.full((scene.num_states, 36, 48, 3), 40 * index, np.uint8)
        pictures[:, :, ::2] += np.arange(scene.num_states, dtype=np.uint8)[:, None, None, None]
        scene.save(tmp_path / f"{index}.h5", pictures)
    return tmp_path


@pytest.fixture
def made(settings: Callable[..., Any], rooms: Path) -> Callable[..., Trainer]:
    def make(*overrides: str, lazy: bool = True) -> Trainer:
        plain: Any = OmegaConf.to_container(settings(*SMALL, *overrides))
        return make_trainer(plain, scenes=SceneSet.open(rooms, lazy=lazy))

    return make


def run(trainer: Trainer, updates: int, path: Path | None = None) -> None:
    with trainer.collecting() as batches:
        for _ in range(updates):
            trainer.update(batches)
        if path is not None:
            trainer.save(path)


def values(trainer: Trainer) -> list[torch.Tensor]:
    moments = trainer.optimizer.state_dict()["state"].values()
    return [*trainer.agent.state_dict().values(), *(value for state in moments for value in state.values())]


KINDS = {
    "fixed": ["env.goal_sampling=fixed"],
    "episode": ["env.goal_sampling=episode"],
    "frames": ["agent.history=2"],
    "hindsight": ["algorithm=hindsight", "hindsight.batch_size=16", "hindsight.capacity=200"],
    "search": ["algorithm=replay_search", "algorithm.learning_starts=24", "algorithm.batch_size=64"],
    "features": ["agent.observation=features", "env.crop=random"],
    "pixels": ["agent.observation=pixels", "agent.encoder=conv", "agent.picture_size=[36,48]"],
    "pictures": ["agent.encoder=conv", "agent.picture_size=[36,48]"],
}


@pytest.mark.parametrize("kind", KINDS)
def test_numbers_are_those_of_rooms_in_memory_and_a_resumed_run_goes_on(
    made: Callable[..., Trainer], tmp_path: Path, kind: str
) -> None:
    extra = [*KINDS[kind], "agent.normalize_features=false"]
    lazy = made(*extra)
    run(lazy, 6)
    eager = made(*extra, lazy=False)
    run(eager, 6)
    assert all(torch.equal(*pair) for pair in zip(values(lazy), values(eager), strict=True))
    run(made(*extra), 3, tmp_path / "half.pt")
    resumed = made(*extra)
    resumed.resume(tmp_path / "half.pt")
    run(resumed, 3)
    assert all(torch.equal(*pair) for pair in zip(values(lazy), values(resumed), strict=True))


def test_a_setting_opens_rooms_lazily_and_an_evaluation_of_the_run_follows(
    settings: Callable[..., Any], rooms: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def opened(*overrides: str) -> tuple[bool, bool]:
        """Whether the training's rooms are in the files, and those of its agent when it is loaded."""
        plain: Any = OmegaConf.to_container(settings(*SMALL, f"scenes=[{rooms}]", *overrides))
        trainer = make_trainer(plain)
        with trainer.collecting():
            trainer.save(tmp_path / "checkpoint.pt")
        return trainer.scenes.is_lazy, load_agent(tmp_path / "checkpoint.pt")[1].is_lazy

    assert opened() == opened("lazy_scenes=auto") == opened("lazy_scenes=false") == (False, False)
    assert opened("lazy_scenes=true") == (True, True)
    monkeypatch.setattr(places, "LAZY_SCENES", 5)
    assert opened() == (True, True)
    assert opened("lazy_scenes=false") == (False, False)


def test_workers_read_what_they_need(made: Callable[..., Trainer], fast_workers: None) -> None:
    trainer = made("collector=multi_sync", "collector.num_workers=2", "env.goal_sampling=episode")
    before = [value.clone() for value in trainer.agent.state_dict().values()]
    run(trainer, 3)
    assert trainer.frames == 3 * 6 * 4
    assert any(
        not torch.equal(old, new)
        for old, new in zip(before, trainer.agent.state_dict().values(), strict=True)
    )


def test_a_store_that_vanishes_ends_the_run_with_its_name(made: Callable[..., Trainer], rooms: Path) -> None:
    trainer = made("env.active_scenes=1")
    with trainer.collecting() as batches:
        trainer.update(batches)
        for path in rooms.glob("*.h5"):
            path.unlink()
        with pytest.raises(SceneError, match=r"\.h5: has gone since it was opened"):
            collections.deque((trainer.update(batches) for _ in range(30)), maxlen=0)


@pytest.mark.parametrize("history", [1, 2])
def test_an_evaluation_goes_from_scene_to_scene(rooms: Path, history: int) -> None:
    eager, lazy = SceneSet.open(rooms, lazy=False), SceneSet.open(rooms, lazy=True)
    options = {"history": history, "hidden_size": 8, "embedding_size": 8, "normalize_features": False}
    agents = [make_agent("vusfa", scenes=world, **options) for world in (eager, lazy)]
    agents[1].load_state_dict(agents[0].state_dict())
    assert isinstance(evaluation_policy(agents[1], lazy), InferencePolicy)
    goals = torch.arange(0, 80, 3)
    tables = [
        evaluate(
            evaluation_policy(agent),
            world,
            goals,
            episodes_per_goal=2,
            max_steps=12,
            history=history,
            sample=False,
            batch_size=size,
        )
        for agent, world, size in ((agents[0], eager, 4096), (agents[1], lazy, 4096), (agents[1], lazy, 9))
    ]
    for other in tables[1:]:
        for name in ("goal", "start", "length", "success", "collisions", "remaining"):
            assert torch.equal(getattr(other, name), getattr(tables[0], name))
    if history > 1:
        return
    table = TabularPolicy(agents[0], eager)
    expected = exact_goals(table.probabilities, eager)
    found = exact_goals(probabilities_by_scene(agents[1], lazy), lazy)
    for name, column in expected.metrics.items():
        assert torch.allclose(found.metrics[name], column, atol=1e-6)


def test_an_evaluation_during_the_training_samples_scenes(
    made: Callable[..., Trainer], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("vusfa.training.metrics", "vusfa.experiments.validation"):
        monkeypatch.setattr(f"{module}.MAX_SCENES", 3)
    trainer = made()
    validation = Validation(trainer, make_loggers([], tmp_path, {}, run_id="a"))
    assert len(trainer.scenes.scene_id[validation.goals].unique()) == 3
    found = validation.measure()
    assert not [name for name in found if name.startswith("scene/")]
    assert found["scenes/eval/trained/success_p10"] <= found["scenes/eval/trained/success_p90"]
    again = Validation(trainer, make_loggers([], tmp_path, {}, run_id="a"))
    assert torch.equal(again.goals, validation.goals)
    every = torch.arange(0, 80, 5)
    table = measure_goals(trainer, every, episodes_per_goal=1, max_steps=5)
    assert table.success.shape == (16,)


def test_sums_of_too_many_goals_for_columns_are_a_table(
    made: Callable[..., Trainer], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vusfa.training.metrics.MAX_GOALS", 3)
    trainer = made()
    run(trainer, 5, tmp_path / "a.pt")
    table = trainer.episodes.table()
    assert table["scene"].tolist()[:3] == ["room 0", "room 0", "room 1"]
    first = table["episodes"].sum()
    logged = trainer.metrics()
    assert logged["episodes"] == first > 0
    assert not [name for name in logged if name.startswith("goal/")]
    assert trainer.episodes.table()["episodes"].sum() == first  # of the whole training


def test_an_autoencoder_needs_all_features_at_once(
    made: Callable[..., Trainer], monkeypatch: pytest.MonkeyPatch
) -> None:
    given = ["preset=autoencoder", *SMALL, "agent.pretrained=autoencoder"]
    run(made(*given), 2)
    monkeypatch.setattr("vusfa.modules.autoencoder.RESIDENT_BYTES", 100)
    with pytest.raises(
        ConfigError, match=r"algorithm=autoencoder learns from the features of all states at once"
    ):
        made(*given)
