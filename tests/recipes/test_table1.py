"""recipes/table1.py on small cells of the bathroom."""

from __future__ import annotations

import dataclasses
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import torch

from vusfa.envs import resolve_goals
from vusfa.experiments.manifest import make_manifest, write_manifest
from vusfa.experiments.runs import read_run, read_runs, write_run
from vusfa.scenes import SceneSet
from vusfa.training import load_checkpoint

SMALL = [
    "preset=controlled",
    "agent.hidden_size=8",
    "agent.embedding_size=8",
    "agent.history=1",
    "scenes=[bathroom]",
    "total_frames=160",
    "collector.num_envs=8",
    "collector.rollout=4",
]


@pytest.fixture
def table1() -> Any:
    return import_module("vusfa.experiments.table1")


@pytest.fixture
def folders(tmp_path: Path) -> dict[str, Path]:
    rooms = SceneSet.bundled(["bathroom"])
    drawn = make_manifest(rooms, resolve_goals(rooms, "paper"), episodes_per_goal=1, validation_goals=2)
    manifest = write_manifest(tmp_path / "episodes.npz", drawn)
    return {"results": tmp_path / "results", "runs": tmp_path / "runs", "manifest": manifest}


def test_a_cell_is_run_once_and_again_gives_the_same(
    table1: Any, folders: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    table1.table1(SMALL, models=["vusfa", "gvf"], seeds=[0], **folders)
    cells = {cell.name: cell for cell in read_runs(folders["results"], "table1")}
    assert sorted(cells) == ["gvf-0", "vusfa-0"]
    cell = cells["vusfa-0"]
    scores = cell.info["validation_spl"]
    assert scores[cell.info["checkpoint"]] == max(scores.values())
    assert cell.info["frames"] == {80: 128, 90: 160, 100: 160}[int(cell.info["checkpoint"][11:-3])]
    sampled = cell.episodes["sampled"]
    assert len(sampled) == 176 - 2  # two goals are for the choice of checkpoints
    assert sampled.trained.sum().item() == 5
    assert torch.equal(sampled.start, cells["gvf-0"].episodes["greedy"].start)
    assert cell.exact is not None
    assert len(cell.exact.goal) == 176

    capsys.readouterr()
    table1.table1(SMALL, models=["vusfa"], seeds=[0], **folders)
    assert "already there" in capsys.readouterr().out
    folders["results"], folders["runs"] = folders["results"] / "again", folders["runs"] / "again"
    table1.table1(SMALL, models=["vusfa"], seeds=[0], **folders)
    assert read_run(folders["results"], "table1", "vusfa-0").episodes["sampled"].equal(sampled)


def test_a_cell_goes_on_where_it_was_cut_off(
    table1: Any, folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(table1, "choose_checkpoint", _interrupt)
    with pytest.raises(KeyboardInterrupt):
        table1.table1(SMALL, models=["gvf"], seeds=[1], **folders)
    assert read_runs(folders["results"], "table1") == []
    monkeypatch.setattr(table1, "train", None)  # nothing is trained twice
    monkeypatch.setattr(table1, "choose_checkpoint", lambda paths, manifest: {paths[1]: 0.5, paths[0]: 0.4})
    table1.table1(SMALL, models=["gvf"], seeds=[1], **folders)
    cell = read_run(folders["results"], "table1", "gvf-1")
    assert (cell.info["seed"], cell.info["checkpoint"]) == (1, "checkpoint-90.pt")


def _interrupt(*arguments: object) -> float:
    raise KeyboardInterrupt


def test_untrained_and_measured_again(table1: Any, folders: dict[str, Path]) -> None:
    table1.table1(SMALL, models=["untrained"], seeds=[2], **folders)
    cell = read_run(folders["results"], "table1", "untrained-2")
    assert (cell.info["model"], cell.info["row"], cell.info["frames"]) == ("untrained", "untrained", 0)
    old = {way: dataclasses.replace(table, remaining=None) for way, table in cell.episodes.items()}
    write_run(folders["results"], dataclasses.replace(cell, episodes=old))
    table1.table1(SMALL, models=["untrained"], seeds=[2], again=True, **folders)
    anew = read_run(folders["results"], "table1", "untrained-2")
    assert anew.info == cell.info
    for way, table in anew.episodes.items():
        assert table.equal(cell.episodes[way])


@pytest.mark.parametrize(("share", "steps", "frames"), [(0.01, 500, 96), (1.0, 1, 160)])
def test_a_training_ends_when_enough_goals_are_reached(
    table1: Any, folders: dict[str, Path], share: float, steps: int, frames: int
) -> None:
    """At the first look, after 96 of 160 frames, or never; schedules end where they would have ended."""
    stop = [f"early_stopping.{name}" for name in (f"success={share}", f"max_steps={steps}", "every=70")]
    settings = [*SMALL, *stop, "early_stopping.episodes_per_goal=5", "optim.horizon=1000"]
    table1.table1(settings, models=["gvf"], seeds=[0], **folders)
    cell = read_run(folders["results"], "table1", "gvf-0")
    assert (cell.info["frames"], cell.info["checkpoint"]) == (frames, "checkpoint-100.pt")
    config = load_checkpoint(folders["runs"] / "table1" / "gvf-0" / "checkpoint.pt")["config"]
    assert (config["total_frames"], config["optim"]["horizon"]) == (160, 1000)


def test_looking_whether_to_end_changes_nothing(table1: Any, folders: dict[str, Path]) -> None:
    weights = []
    for number, looks in enumerate(([], ["early_stopping.success=1.0", "early_stopping.every=32"])):
        changed = [*SMALL, *looks, "early_stopping.max_steps=1", "agent.history=2", "autocast=true"]
        last = table1.checkpoints(folders["runs"] / str(number), changed, [1.0])[-1]
        weights.append(load_checkpoint(last)["agent"])
    assert all(torch.equal(weight, weights[1][name]) for name, weight in weights[0].items())
