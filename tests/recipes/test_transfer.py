"""recipes/transfer.py on an agent trained for a second."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from vusfa.errors import CheckpointError, VusfaError
from vusfa.experiments.runs import Run, read_run, write_run


@pytest.fixture
def folders(
    recipe: Callable[[str], Any], settings: Callable[..., Any], small: list[str], tmp_path: Path
) -> dict[str, Path]:
    folder = tmp_path / "runs" / "table1" / "gvf-0"
    recipe("train").train(settings(*small, "agent.model=gvf", f"folder={folder}"), [])
    write_run(tmp_path / "results", Run("table1", "gvf-0", {"checkpoint": "checkpoint.pt"}, {}))
    return {"results": tmp_path / "results", "runs": tmp_path / "runs"}


def test_run_and_show(
    recipe: Callable[[str], Any],
    folders: dict[str, Path],
    tmp_path: Path,
    scene_file: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    transfer = recipe("transfer")
    asked = {"models": ["gvf"], "seeds": [0], "kinds": ["random"], "sets": 2, "frames": 96, "every": 48}
    transfer.run(**asked, **folders)
    info = read_run(folders["results"], "transfer", "gvf-0-random").info
    assert [len(entry["goals"]) for entry in info["curves"]] == [5, 5]
    assert info["curves"][0]["fine-tuned"]["frames"] == [0, 48, 96]
    assert info["curves"][0]["fine-tuned"] != info["curves"][0]["from scratch"]
    assert {3, 9, 12}.isdisjoint(info["curves"][0]["goals"])
    capsys.readouterr()
    transfer.run(**asked, **folders)
    assert "already there" in capsys.readouterr().out
    transfer.show(results=folders["results"], out=tmp_path / "transfer.png", scenes=[str(scene_file)])
    printed = capsys.readouterr().out
    assert "| random | gvf | fine-tuned | 1 |" in printed
    assert (tmp_path / "transfer.png").exists()


def test_what_is_missing(recipe: Callable[[str], Any], folders: dict[str, Path], tmp_path: Path) -> None:
    transfer = recipe("transfer")
    with pytest.raises(CheckpointError, match=r"checkpoint\.pt: missing; run vusfa table1"):
        transfer.run(models=["gvf"], seeds=[0], results=folders["results"], runs=tmp_path)
    with pytest.raises(VusfaError, match="run vusfa transfer run first"):
        transfer.show(results=folders["results"])
