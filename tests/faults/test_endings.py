"""Trainings that are killed, run out of disk, or are signalled; ``make faults`` does more of the same."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from endings import COLLECTORS, ended, killed_until_done, start, wait_for

from vusfa.training import load_agent, load_checkpoint


@pytest.mark.parametrize("kind", COLLECTORS)
def test_killed_and_begun_again(tmp_path: Path, kind: str):
    assert killed_until_done(tmp_path / "run", kind, kills=3, seed=0) == 3


def test_a_disk_that_is_full(tmp_path: Path):
    """At the first checkpoint, and at a later one: RLIMIT_FSIZE stands for the disk."""
    path = tmp_path / "run" / "checkpoint.pt"
    process = start(path.parent, "total_frames=24")
    assert ended(process) == 0
    size, whole = path.stat().st_size, path.read_bytes()

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size - 1000, size - 1000))

    more = ["total_frames=2400", "resume=auto"]
    assert ended(start(path.parent, *more, prepare=limit)) == 1
    assert path.read_bytes() == whole
    text = (tmp_path / "run.txt").read_text().splitlines()[-1]
    assert text.startswith(f"error: {path}: cannot be written (File too large); ")
    assert text.endswith(f"resume from {path}")
    assert {place.name for place in path.parent.iterdir()} == {path.name, "config.json", "metrics.csv"}
    assert ended(start(tmp_path / "other", *more[:1], prepare=limit)) == 1
    assert (tmp_path / "other.txt").read_text().splitlines()[-1].endswith("there is no checkpoint yet")
    assert ended(start(path.parent, "total_frames=96", "resume=auto")) == 0
    assert load_checkpoint(path)["frames"] == 96


def test_a_disk_that_is_really_full(tmp_path: Path):
    """With W&B, whose files lie beside the run's, and whose copies of checkpoints take the space first."""
    pytest.importorskip("wandb")
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=300k", "none", disk], capture_output=True
    ).returncode:
        pytest.skip("may not mount a disk in memory")
    try:
        more = ["logger=wandb", "logger.mode=offline", "total_frames=2400"]
        assert ended(start(disk / "run", *more, output=tmp_path / "run.txt")) == 1
        text = (tmp_path / "run.txt").read_text()
        assert "Traceback" not in text
        (line,) = (line for line in text.splitlines() if line.startswith("error"))
        assert "checkpoint.pt: cannot be written (No space left on device)" in line
        assert load_checkpoint(disk / "run" / "checkpoint.pt")["frames"] >= 24
    finally:
        subprocess.run(["umount", "--lazy", disk], check=True)


@pytest.mark.parametrize(
    ("kind", "number"),
    [
        ("multi_async", signal.SIGHUP),
        ("multi_async", signal.SIGINT),
        ("hogwild", signal.SIGTERM),
        ("single", signal.SIGTERM),
    ],
)
def test_a_signal_to_the_whole_group(tmp_path: Path, kind: str, number: signal.Signals):
    """A closed terminal, Ctrl-C, a batch system's end of time: it reaches the workers as well."""
    folder = tmp_path / "run"
    more = [f"collector={kind}", "preset=paper", "evaluation=trained", "evaluation.episodes_per_goal=1"]
    process = start(folder, *more, "total_frames=1000000")
    assert wait_for(folder / "checkpoint.pt", process)
    os.killpg(process, number)
    assert ended(process) == 128 + number
    assert "error" not in (tmp_path / "run.txt").read_text()
    frames = load_agent(folder / "checkpoint.pt")[2]["frames"]
    # nothing half-written, and no evaluation of a training that was cut short
    assert {path.name for path in folder.iterdir()} == {"checkpoint.pt", "config.json", "metrics.csv"}
    if kind != "single":
        return
    process = start(
        folder, f"resume={folder}/checkpoint.pt", f"total_frames={frames + 24}", "evaluation=none"
    )
    assert ended(process) == 0, (tmp_path / "run.txt").read_text()
    assert load_checkpoint(folder / "checkpoint.pt")["frames"] >= frames + 24


def test_a_folder_that_is_renamed(tmp_path: Path):
    folder = tmp_path / "run"
    process = start(folder, "total_frames=1000000")
    assert wait_for(folder / "checkpoint.pt", process)
    folder.rename(tmp_path / "moved")
    assert ended(process) == 1
    text = (tmp_path / "run.txt").read_text()
    assert "Traceback" not in text
    assert "removed or renamed since the run began" in text.splitlines()[-1]
    load_checkpoint(tmp_path / "moved" / "checkpoint.pt")
    assert not (folder / "metrics.csv").exists()


def test_a_checkpoint_replaced_by_a_folder(tmp_path: Path):
    folder = tmp_path / "run"
    process = start(folder, "total_frames=1000000")
    assert wait_for(folder / "checkpoint.pt", process)
    (folder / "checkpoint.pt").unlink()
    (folder / "checkpoint.pt").mkdir()
    assert ended(process) in (1, -signal.SIGKILL)
    lines = (tmp_path / "run.txt").read_text().splitlines()
    assert "cannot be written (Is a directory)" in lines[-1]


def test_too_few_descriptors(tmp_path: Path):
    used = len(os.listdir("/proc/self/fd"))

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_NOFILE, (used + 16, used + 16))

    process = start(tmp_path / "run", "collector=multi_async", "collector.num_workers=6", prepare=limit)
    assert ended(process) == 1
    lines = (tmp_path / "run.txt").read_text().splitlines()
    assert lines[-1].startswith("error: ")
    assert "Too many open files" in lines[-1]
    assert not (tmp_path / "run").exists()


def test_ctrl_c_while_starting(tmp_path: Path):
    """In the middle of an import: a line, no traceback."""
    code = "import os, signal, sys\nimport vusfa.cli\nos.kill(os.getpid(), signal.SIGINT)\n"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (-signal.SIGINT, "error: interrupted while starting\n")
