from __future__ import annotations

from pathlib import Path

import pytest
import table1
import torch

from vusfa.envs import resolve_goals
from vusfa.evaluation.manifest import make_manifest, write_manifest
from vusfa.evaluation.results import read_cell, read_cells
from vusfa.scenes import SceneSet

SMALL = [
    "preset=controlled", "agent.hidden_size=8", "agent.embedding_size=8", "agent.history=1", "scenes=[bathroom]",
    "total_frames=160", "collector.num_envs=8", "collector.rollout=4", "logger.console=false",
]  # fmt: skip


@pytest.fixture
def folders(tmp_path: Path) -> dict[str, Path]:
    rooms = SceneSet.bundled(["bathroom"])
    drawn = make_manifest(rooms, resolve_goals(rooms, "paper"), episodes_per_goal=1, validation_goals=2)
    manifest = write_manifest(tmp_path / "episodes.npz", drawn)
    return {"results": tmp_path / "results", "runs": tmp_path / "runs", "manifest": manifest}


def test_cells_are_run_once_and_again_give_the_same(
    folders: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    table1.table1(SMALL, models=["vusfa", "gvf"], seeds=[0], **folders)
    cells = {cell.name: cell for cell in read_cells(folders["results"], "table1")}
    assert sorted(cells) == ["gvf-0", "vusfa-0"]
    cell = cells["vusfa-0"]
    assert cell.info["frames"] in (128, 160)
    assert max(cell.info["validation_spl"].values()) == cell.info["validation_spl"][cell.info["checkpoint"]]
    sampled = cell.episodes["sampled"]
    assert len(sampled) == 176 - 2
    assert sampled.trained.sum().item() == 5
    assert torch.equal(sampled.start, cells["gvf-0"].episodes["greedy"].start)
    assert cell.exact is not None
    assert len(cell.exact.goal) == 176

    capsys.readouterr()
    table1.table1(SMALL, models=["vusfa"], seeds=[0], **folders)
    assert "already there" in capsys.readouterr().out
    folders["results"], folders["runs"] = folders["results"] / "again", folders["runs"] / "again"
    table1.table1(SMALL, models=["vusfa"], seeds=[0], **folders)
    again = read_cell(folders["results"], "table1", "vusfa-0")
    assert again.episodes["sampled"].equal(sampled)


def test_a_cell_goes_on_where_it_was_cut_off(
    folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(table1, "validation_score", _interrupt)
        table1.table1(SMALL, models=["gvf"], seeds=[1], **folders)
    assert read_cells(folders["results"], "table1") == []
    monkeypatch.setattr(table1, "train", None)  # nothing is trained twice
    table1.table1(SMALL, models=["gvf"], seeds=[1], **folders)
    assert read_cell(folders["results"], "table1", "gvf-1").info["seed"] == 1


def _interrupt(*arguments: object) -> float:
    raise KeyboardInterrupt
