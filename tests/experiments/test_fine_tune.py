from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from vusfa.cli.launch import compose
from vusfa.conf import FOLDER as CONF
from vusfa.evaluation import evaluate, get_metric
from vusfa.experiments.fine_tune import fine_tune, fine_tuning_settings
from vusfa.modules import InferencePolicy
from vusfa.scenes import SceneSet
from vusfa.training import load_agent, make_trainer


@pytest.fixture
def config(scene_file: Path) -> dict[str, Any]:
    cfg = compose(
        CONF,
        "train",
        [
            f"scenes=[{scene_file}]",
            "env.goals=[3,9,12]",
            "env.max_steps=20",
            "agent.hidden_size=8",
            "agent.embedding_size=8",
            "collector.num_envs=6",
            "collector.rollout=4",
            "total_frames=480",
        ],
    )
    OmegaConf.resolve(cfg)
    return OmegaConf.to_container(cfg)  # type: ignore[return-value]


@pytest.fixture
def checkpoint_of(tmp_path: Path) -> Callable[[dict[str, Any]], Path]:
    def make(config: dict[str, Any]) -> Path:
        trainer = make_trainer(config)
        with trainer.collecting() as batches:
            trainer.update(batches)
            with torch.no_grad():
                trainer.algorithm.loss.bottleneck_coeff.fill_(0.25)
            return trainer.save(tmp_path / "checkpoint.pt")

    return make


@pytest.fixture
def checkpoint(config: dict[str, Any], checkpoint_of: Callable[..., Path]) -> Path:
    return checkpoint_of(config)


def test_schedules_end_with_the_new_training(config: dict[str, Any]) -> None:
    config["optim"]["horizon"] = 7
    settings = fine_tuning_settings(config, torch.tensor([5, 6]), frames=96, seed=4)
    assert settings["entropy"]["horizon"] == 96
    assert settings["optim"]["horizon"] == 7  # was no part of the run's own
    assert (settings["total_frames"], settings["seed"], settings["env"]["goals"]) == (96, 4, [5, 6])
    assert config["env"]["goals"] == [3, 9, 12]


@pytest.mark.parametrize("history", [1, 3])  # computed, and walked
def test_a_curve(history: int, config: dict[str, Any], checkpoint_of: Callable[..., Path]) -> None:
    config["agent"]["history"] = history
    _, scenes, state = load_agent(checkpoint_of(config))
    settings = fine_tuning_settings(state["config"], torch.tensor([5, 6]), frames=96, seed=4)
    curve = fine_tune(state, settings, scenes, every=48)
    assert curve["frames"] == [0, 48, 96]
    assert all(1 <= length <= 20 for length in curve["length"])
    assert all(0 <= success <= 1 for success in curve["success"])
    assert fine_tune(state, settings, scenes, every=48) == curve


def test_trained_on_begins_where_the_agent_was_and_scratch_does_not(
    checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, scenes, state = load_agent(checkpoint)
    seen: list[dict[str, Any]] = []
    settings = fine_tuning_settings(state["config"], torch.tensor([5]), frames=24, seed=9)

    def made(settings: dict[str, Any], scenes: SceneSet) -> Any:
        trainer = make_trainer(settings, scenes=scenes)
        collecting: Callable[..., Any] = trainer.collecting

        def kept() -> Any:
            beta = trainer.algorithm.loss.bottleneck_coeff.item()
            seen.append({"beta": beta, **{k: v.clone() for k, v in trainer.agent.state_dict().items()}})
            return collecting()

        monkeypatch.setattr(trainer, "collecting", kept)
        return trainer

    monkeypatch.setattr("vusfa.experiments.fine_tune.make_trainer", made)
    for start in (state, None):
        fine_tune(start, settings, scenes, every=1000)
    weight = next(name for name in state["agent"] if name.endswith("weight"))
    assert torch.equal(seen[0][weight], state["agent"][weight])
    assert not torch.equal(seen[1][weight], state["agent"][weight])
    assert (seen[0]["beta"], seen[1]["beta"]) == (0.25, pytest.approx(0.0, abs=0.01))


def test_what_is_computed_beside_what_is_walked(config: dict[str, Any], checkpoint: Path) -> None:
    """Three goals, 3000 episodes each: a one-frame agent's curve lies within five standard errors."""
    agent, scenes, state = load_agent(checkpoint)
    goals = torch.tensor([5, 6, 14])
    curve = fine_tune(state, fine_tuning_settings(config, goals, 1, seed=4), scenes, every=1000)
    table = evaluate(InferencePolicy(agent), scenes, goals, episodes_per_goal=3000, max_steps=20, history=1)
    length = table.length.double()
    assert curve["length"][0] == pytest.approx(length.mean().item(), abs=5 * 8 / 9000**0.5)
    assert curve["success"][0] == pytest.approx(table.success.double().mean().item(), abs=5 * 0.5 / 9000**0.5)
    ratio = get_metric("length_ratio").value(table)
    assert curve["length_ratio"][0] == pytest.approx(ratio, rel=0.05)
