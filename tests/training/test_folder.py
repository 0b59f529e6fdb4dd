"""A run's folder: one writer, nothing overwritten unasked, nothing left of the dead."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from vusfa.errors import ConfigError
from vusfa.files import remove_leftovers
from vusfa.training import RunFolder
from vusfa.training.folder import found_checkpoint

DEAD = 2**22  # above any process's number


def settings(**changed: Any) -> dict[str, Any]:
    agent = {"model": "vusfa"}
    return {"name": "fast", "agent": agent, "scenes": ["bathroom"], "seed": 0, "resume": None} | {
        "overwrite": False,
        **changed,
    }


def test_four_trainings_of_one_second_have_four_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("vusfa.training.folder.time.strftime", lambda _: "now")
    with RunFolder(None, settings()) as one, RunFolder(None, settings()) as two:
        with RunFolder(None, settings()) as three:
            paths = [str(folder.path) for folder in (one, two, three)]
        (two.path / "checkpoint.pt").touch()
    start = "runs/fast-vusfa-bathroom-seed0/now"
    assert paths == [start, f"{start}-2", f"{start}-3"]
    assert [path.name for path in Path("runs").rglob("*") if path.is_file()] == ["checkpoint.pt"]
    assert not one.path.exists()  # it did not begin


def test_two_runs_at_once_do_not_share_a_folder(tmp_path: Path):
    with RunFolder(tmp_path / "run", settings()):
        other = RunFolder(tmp_path / "run", settings())
        with pytest.raises(ConfigError, match=rf"process {os.getpid()} is writing a run; wait for it"), other:
            pass
    with RunFolder(tmp_path / "run", settings()):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_lock_whose_process_is_dead_holds_nobody_up(tmp_path: Path):
    (tmp_path / ".lock").write_text(str(DEAD))
    with RunFolder(tmp_path, settings()):
        assert (tmp_path / ".lock").read_text().split()[0] == str(os.getpid())


def test_a_run_is_not_overwritten_unasked(tmp_path: Path):
    path = tmp_path / "checkpoint.pt"
    path.write_text("learned")
    (tmp_path / "notes.txt").touch()
    words = "where a run is already .*resume=auto .*another folder, or overwrite=true"
    for changed in ({}, {"resume": str(tmp_path / "other" / "checkpoint.pt")}):
        with pytest.raises(ConfigError, match=words):
            RunFolder(tmp_path, settings(**changed))
    for resume in (path, tmp_path / "checkpoint-80.pt"):
        with RunFolder(tmp_path, settings(resume=str(resume))):
            assert path.read_text() == "learned"
    with RunFolder(tmp_path, settings(overwrite=True)):
        assert not path.exists()
    assert [place.name for place in tmp_path.iterdir()] == ["notes.txt"]


def test_what_auto_finds(tmp_path: Path):
    assert found_checkpoint(tmp_path) is None
    (tmp_path / "checkpoint.pt").touch()
    assert found_checkpoint(tmp_path) == str(tmp_path / "checkpoint.pt")
    with pytest.raises(ConfigError, match="give folder="):
        found_checkpoint(None)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_may_not_be_written(tmp_path: Path):
    tmp_path.chmod(0o500)
    with pytest.raises(ConfigError, match="may not be written"):
        RunFolder(tmp_path / "run", settings())


def test_unfinished_files_of_dead_processes_go(tmp_path: Path):
    names = [f".checkpoint.pt.{DEAD}.tmp", f".checkpoint.pt.{os.getpid()}.tmp", ".hidden", "a.1.tmp"]
    for name in names:
        (tmp_path / name).touch()
    with RunFolder(tmp_path, settings()):
        assert {place.name for place in tmp_path.iterdir()} == {*names[1:], ".lock"}


def test_temporary_folders_of_dead_processes_go(tmp_path: Path):
    """pymp-*, *wandb-media and others of a library are made within."""
    kept = {f"vusfa-{os.getpid()}-abc", "vusfa-mine", "pymp-1"}
    for name in (f"vusfa-{DEAD}-abc", *kept):
        (tmp_path / name / "pymp-x").mkdir(parents=True)
    remove_leftovers(tmp_path)
    assert {place.name for place in tmp_path.iterdir()} == {
        f"vusfa-{os.getpid()}-abc",
        "vusfa-mine",
        "pymp-1",
    }


def test_a_process_takes_its_temporary_folder_along(tmp_path: Path):
    (tmp_path / f"vusfa-{DEAD}-abc").mkdir()
    code = (
        "import os, tempfile\nfrom vusfa.files import use_own_temporary_folder as use\nuse()\nuse()\n"
        "print(tempfile.mkdtemp(prefix='pymp-'))"
    )
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    made = Path(done.stdout.strip())
    assert made.parent.name.startswith("vusfa-"), done.stderr
    assert made.parent.parent == tmp_path
    assert list(tmp_path.iterdir()) == []
