"""Interrupted and resumed is uninterrupted, number for number; a checkpoint of something else is refused."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from vusfa.cli.resume import resumed_settings
from vusfa.errors import CheckpointError
from vusfa.report.runs import read_run
from vusfa.training import load_checkpoint


def log(folder: Path) -> list[dict[str, str]]:
    with open(folder / "metrics.csv", newline="") as file:
        return [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)]


def assert_equal(one, other, where: str = "") -> None:
    """Two checkpoints, entry by entry; only the time spent and what was asked for may differ."""
    assert type(one) is type(other), where
    if isinstance(one, dict):
        assert one.keys() == other.keys(), where
        for key in one.keys() - {"seconds", "run_id", "config", "overrides"}:
            assert_equal(one[key], other[key], f"{where}/{key}")
    elif isinstance(one, list | tuple):
        assert len(one) == len(other), where
        for index, pair in enumerate(zip(one, other, strict=True)):
            assert_equal(*pair, f"{where}/{index}")
    elif isinstance(one, torch.Tensor):
        assert torch.equal(one, other), where
    else:
        assert one == other, where


@pytest.mark.parametrize(
    "options",
    [
        ["agent.model=vusfa", "objective.bottleneck_step_size=0.1", "objective.information_target=0.01"],
        ["agent.model=gvf", "optim=tf_rmsprop"],
        ["agent.model=usfa", "agent=lstm", "env.goal_sampling=episode"],
        ["agent.model=sfdp", "autocast=true"],
        ["agent.model=vusfa", "algorithm=hindsight", "hindsight.batch_size=16", "hindsight.updates=2"],
        ["agent.model=usfa", "agent.history=1", "algorithm=replay_search", "algorithm.updates=2"]
        + ["algorithm.batch_size=16", "algorithm.num_goals=4", "algorithm.learning_starts=40"],
    ],
    ids=["vusfa", "gvf", "lstm", "autocast", "hindsight", "replay_search"],
)
def test_resumed_equals_uninterrupted(
    recipe, settings, small, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: list[str]
):
    if "agent=lstm" in options or "agent.history=1" in options:
        small.remove("agent.history=2")
    module = recipe("train")

    class Interruption:
        """A signal that comes in the 17th update: in mid-episode, and between two lines of the log."""

        exit_code = 143

        def __init__(self) -> None:
            self.asked = 0

        def __enter__(self):
            return self

        def __exit__(self, *_) -> None:
            pass

        @property
        def received(self) -> bool:
            self.asked += 1
            return self.asked > 17

    def run(name: str, *more: str) -> int:
        cfg = settings(*small, *options, "total_frames=960", f"folder={tmp_path / name}", *more)
        return module.train(cfg, [])[2]

    assert run("whole") == 0
    with monkeypatch.context() as patch:
        patch.setattr("vusfa.experiments.training.StopOnSignal", Interruption)
        assert run("parts") == 143
    assert load_checkpoint(tmp_path / "parts" / "checkpoint.pt")["frames"] == 17 * 24
    torch.manual_seed(12345)  # a new process begins anywhere
    assert run("parts", f"resume={tmp_path / 'parts' / 'checkpoint.pt'}") == 0
    whole, parts = (load_checkpoint(tmp_path / name / "checkpoint.pt") for name in ("whole", "parts"))
    assert_equal(whole, parts)
    assert whole["frames"] == 960
    assert log(tmp_path / "whole") == log(tmp_path / "parts")
    assert len(log(tmp_path / "whole")) == 20


def test_the_run_keeps_its_name(recipe, settings, small, tmp_path: Path):
    train = recipe("train").train
    path = tmp_path / "run" / "checkpoint.pt"
    first, _, _ = train(settings(*small, "total_frames=48", f"folder={path.parent}"), [])
    second, _, _ = train(settings(*small, "total_frames=96", f"folder={path.parent}", f"resume={path}"), [])
    assert first.run_id == second.run_id
    assert second.seconds > first.seconds


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["agent.model=gvf"], "saved with agent.model=vusfa, not gvf"),
        (["agent.hidden_size=16"], "saved with agent.hidden_size=8, not 16"),
        (["env.goals=[3,9,13]"], r"saved with env.goals=\[3, 9, 12\], not \[3, 9, 13\]"),
        (["collector.num_envs=9"], r"the checkpoint holds \[6\] environments, the collector \[9\]"),
        (["optim=tf_rmsprop"], "its optimizer is not a TFRMSprop"),
    ],
)
def test_a_checkpoint_of_another_training_is_refused(
    recipe, settings, small, tmp_path: Path, options: list[str], words: str
):
    train = recipe("train").train
    path = tmp_path / "run" / "checkpoint.pt"
    train(settings(*small, "agent.model=vusfa", "total_frames=48", f"folder={path.parent}"), [])
    kept = path.read_bytes()
    elsewhere = tmp_path / "new"
    with pytest.raises(CheckpointError, match=words):
        train(settings(*small, "agent.model=vusfa", *options, f"folder={elsewhere}", f"resume={path}"), [])
    assert not elsewhere.exists()
    assert path.read_bytes() == kept


def test_a_run_moves_with_its_scene_and_its_list_of_goals(
    recipe, settings, small, tmp_path: Path, scene_file: Path, monkeypatch: pytest.MonkeyPatch
):
    """Its files hold them as seen from its folder, and nothing else of its author's disk."""
    home, elsewhere = tmp_path / "home", tmp_path / "elsewhere"
    home.mkdir()
    (home / "few.yaml").write_text("hall: [3, 9]\n")
    (home / "hall.h5").write_bytes(scene_file.read_bytes())
    options = [f"scenes=[{home / 'hall.h5'}]", f"env.goals={home / 'few.yaml'}", "total_frames=48"]
    recipe("train").train(settings(*small, *options, f"folder={home / 'run'}"), options)
    config = json.loads((home / "run" / "config.json").read_text())
    state = torch.load(home / "run" / "checkpoint.pt", weights_only=True)
    assert str(tmp_path) not in f"{config} {state['config']} {state['overrides']}"
    assert (config["scenes"], config["env"]["goals"]) == (["../hall.h5"], "../few.yaml")
    home.rename(elsewhere)
    monkeypatch.chdir(tmp_path)
    assert Path(read_run(elsewhere / "run").scenes[0]).samefile(elsewhere / "hall.h5")
    path = elsewhere / "run" / "checkpoint.pt"
    options = [f"resume={path}", "total_frames=96"]
    again = resumed_settings(OmegaConf.to_container(settings(*small, *options)), options)
    assert Path(again["env"]["goals"]).samefile(elsewhere / "few.yaml")
    assert recipe("train").train(again).trainer.frames == 96
    (elsewhere / "hall.h5").rename(tmp_path / "lost.h5")
    with pytest.raises(CheckpointError, match=r"hall\.h5: there is no such file; .* give them as scenes"):
        resumed_settings(OmegaConf.to_container(settings(*small, *options)), options)
    options.append(f"scenes=[{tmp_path / 'lost.h5'}]")
    again = resumed_settings(OmegaConf.to_container(settings(*small, *options)), options)
    assert again["scenes"] == [str(tmp_path / "lost.h5")]


def test_paths_that_version_0_1_wrote(tmp_path: Path, scene_file: Path, monkeypatch: pytest.MonkeyPatch):
    """As they were given: from the folder that the run was started in."""
    (tmp_path / "run").mkdir()
    config = {"agent": {"model": "gvf"}, "scenes": ["rooms/hall.h5"]}
    (tmp_path / "run" / "config.json").write_text(json.dumps(config))
    monkeypatch.chdir(tmp_path)
    assert read_run("run").scenes == ["rooms/hall.h5"]  # where it is, or was
    (tmp_path / "run" / "hall.h5").write_bytes(b"")
    assert Path(read_run("run").scenes[0]).samefile("run/hall.h5")


def test_other_scenes_are_refused(recipe, settings, small, tmp_path: Path, make_scene):
    train = recipe("train").train
    path = tmp_path / "run" / "checkpoint.pt"
    train(settings(*small, "total_frames=48", f"folder={path.parent}"), [])
    make_scene("attic").save(tmp_path / "attic.h5")
    with pytest.raises(CheckpointError, match="trained in hall, not in attic"):
        train(
            settings(
                *small, f"scenes=[{tmp_path / 'attic.h5'}]", f"resume={path}", f"folder={tmp_path / 'x'}"
            ),
            [],
        )
    make_scene("hall", features=9).save(tmp_path / "hall.h5")
    with pytest.raises(CheckpointError, match="have changed since"):
        train(settings(*small, f"resume={path}", f"folder={tmp_path / 'x'}"), [])


@pytest.mark.usefixtures("fast_workers")
def test_workers_begin_new_episodes_when_resumed(recipe, settings, small, tmp_path: Path):
    train = recipe("train").train
    path = tmp_path / "run" / "checkpoint.pt"
    options = [*small, "collector=multi_async", f"folder={path.parent}"]
    train(settings(*options, "total_frames=48"), [])
    trainer, _, _ = train(settings(*options, "total_frames=96", f"resume={path}"), [])
    assert (trainer.frames, trainer.updates) == (96, 8)
