"""Checkpoints: whole or refused; what they hold comes back."""

from __future__ import annotations

import random
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from vusfa.cli.launch import launch
from vusfa.errors import CheckpointError, ConfigError
from vusfa.experiments.training import train
from vusfa.scenes import Scene, SceneSet
from vusfa.training import load_agent
from vusfa.training.checkpoint import check_scenes, load_checkpoint, save_checkpoint
from vusfa.training.random_state import random_state, restore_random_state
from vusfa.training.upgrade import upgrade_config

DATA = Path(__file__).parent / "data"


def test_what_is_saved_comes_back(tmp_path: Path, checkpoint_state: dict[str, Any]):
    found = load_checkpoint(
        save_checkpoint(tmp_path / "run" / "a.pt", {**checkpoint_state, "rng": random_state()})
    )
    assert torch.equal(found["agent"]["w"], checkpoint_state["agent"]["w"])
    assert found["frames"] == 7
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["a.pt"]


@pytest.mark.parametrize("kept", [0.0, 0.3, 0.7, 0.99])
def test_a_truncated_file_is_named(tmp_path: Path, checkpoint_state: dict[str, Any], kept: float):
    path = save_checkpoint(tmp_path / "a.pt", checkpoint_state)
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    with pytest.raises(CheckpointError, match=r"a\.pt: not a whole checkpoint \(\d+ bytes\)"):
        load_checkpoint(path)


def test_other_files_are_refused(tmp_path: Path, checkpoint_state: dict[str, Any]):
    with pytest.raises(CheckpointError, match="no such checkpoint"):
        load_checkpoint(tmp_path / "none.pt")
    text = tmp_path / "notes.pt"
    text.write_text("not a checkpoint at all")
    with pytest.raises(CheckpointError, match="not a whole checkpoint"):
        load_checkpoint(text)
    torch.save({"weights": torch.zeros(3)}, tmp_path / "other.pt")
    with pytest.raises(CheckpointError, match="'agent_config' is missing"):
        load_checkpoint(tmp_path / "other.pt")
    torch.save([1], tmp_path / "list.pt")
    with pytest.raises(CheckpointError, match="no checkpoint of vusfa"):
        load_checkpoint(tmp_path / "list.pt")
    torch.save({**checkpoint_state, "format": 99}, tmp_path / "new.pt")
    with pytest.raises(CheckpointError, match="format 99"):
        load_checkpoint(tmp_path / "new.pt")


def test_no_code_is_run(tmp_path: Path, checkpoint_state: dict[str, Any]):
    class Trap:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "sprung",))

    torch.save({**checkpoint_state, "format": 1, "config": Trap()}, tmp_path / "a.pt")
    with pytest.raises(CheckpointError):
        load_checkpoint(tmp_path / "a.pt")
    assert not (tmp_path / "sprung").exists()


def test_a_failed_save_keeps_the_old_one(tmp_path: Path, checkpoint_state: dict[str, Any]):
    path = save_checkpoint(tmp_path / "a.pt", checkpoint_state)
    with pytest.raises(Exception, match="pickle"):
        save_checkpoint(path, {**checkpoint_state, "config": lambda: None})
    assert load_checkpoint(path)["frames"] == 7
    assert list(tmp_path.iterdir()) == [path]


def test_scenes_must_be_the_same(make_scene: Callable[..., Scene]):
    rooms = SceneSet([make_scene("hall")])
    saved = {"names": ["hall"], "fingerprint": rooms.fingerprint}
    check_scenes("a.pt", saved, rooms)
    with pytest.raises(CheckpointError, match="trained in hall, not in attic"):
        check_scenes("a.pt", saved, SceneSet([make_scene("attic")]))
    with pytest.raises(CheckpointError, match="have changed since"):
        check_scenes("a.pt", saved, SceneSet([make_scene("hall", features=9)]))


def test_random_states_come_back(tmp_path: Path, checkpoint_state: dict[str, Any]):
    torch.manual_seed(3)
    np.random.default_rng()
    random.gauss(0, 1)  # leaves a second number in store
    path = save_checkpoint(tmp_path / "a.pt", {**checkpoint_state, "rng": random_state()})
    drawn = torch.rand(3).tolist(), np.random.rand(3).tolist(), [random.gauss(0, 1) for _ in range(3)]  # noqa: NPY002
    restore_random_state(load_checkpoint(path)["rng"])
    again = torch.rand(3).tolist(), np.random.rand(3).tolist(), [random.gauss(0, 1) for _ in range(3)]  # noqa: NPY002
    assert drawn == again


def answers(agent) -> dict[str, torch.Tensor]:
    rows = {"state_id": torch.arange(20).unsqueeze(-1), "goal_id": torch.full((20,), 9)}
    inputs = TensorDict({**rows, "scene_id": torch.zeros(20, dtype=torch.int64)}, [20])
    with torch.no_grad():
        logits = agent.get_policy_operator().get_dist(inputs.clone()).logits
        return {"logits": logits, "state_value": agent.get_value_operator()(inputs)["state_value"]}


def test_a_checkpoint_of_version_0_1_loads():
    agent, scenes, state = load_agent(DATA / "checkpoint_0_1.pt")
    assert (scenes.names, state["frames"], state["format"]) == (("bathroom",), 48, 2)
    assert agent.config["model"] == "vusfa"
    stood = torch.load(DATA / "checkpoint_0_1.pt", weights_only=True)["collector"]["carrier"]["step_count"]
    assert torch.equal(state["collector"]["carrier"]["elapsed_steps"], stood)
    assert stood.any()
    expected, found = torch.load(DATA / "expected_0_1.pt"), answers(agent)
    for name, value in found.items():
        torch.testing.assert_close(value, expected[name])


def test_a_training_of_version_0_1_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """As it would have there: weights, optimizer, replay, random states, environments in mid-episode."""
    shutil.copy(DATA / "checkpoint_0_1.pt", tmp_path / "checkpoint.pt")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["train", "resume=checkpoint.pt"])
    trained = []
    with pytest.raises(SystemExit) as end:
        launch(lambda settings, overrides: trained.append(train(settings, overrides)) or 0)
    assert end.value.code == 0
    trainer = trained[0].trainer
    assert (trainer.frames, trainer.settings["algorithm"]) == (96, {"name": "hindsight"})
    expected = torch.load(DATA / "expected_0_1.pt")["resumed_logits"]
    torch.testing.assert_close(answers(trainer.agent.eval())["logits"], expected)


def test_settings_that_only_version_0_1_has_are_named():
    with pytest.raises(CheckpointError, match=r"objective.n_steps=5, which only version 0.1 has"):
        upgrade_config({"objective": {"n_steps": 5}})


@pytest.mark.parametrize("device", ["cuda:99", "meta", "nope", "cpu:\x1b[2J"])
def test_a_device_that_is_not_there_is_found_before_the_file_is_read(tmp_path: Path, device: str):
    for read in (load_checkpoint, partial(load_agent, scenes=None)):
        with pytest.raises(ConfigError, match=r"device is '.*', which cannot be used here") as error:
            read(tmp_path / "none.pt", device=device)
        assert "\x1b" not in str(error.value)
