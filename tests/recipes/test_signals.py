"""SIGTERM and Ctrl-C leave a good checkpoint, in real processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from vusfa.training import load_agent, load_checkpoint

TRAIN = Path(__file__).parents[2] / "recipes" / "train.py"


def start(*overrides: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, str(TRAIN), *overrides],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,  # a group of its own, as a terminal gives each command
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )


def wait_for(path: Path, process: subprocess.Popen[str], seconds: float = 90.0) -> None:
    end = time.monotonic() + seconds
    while not path.exists():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end, f"{path} did not appear"
        time.sleep(0.05)


def group_is_empty(group: int, seconds: float = 10.0) -> bool:
    """Whether all processes of a group have ended; multiprocessing's own helper takes a moment longer."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


@pytest.mark.parametrize(
    ("kind", "number", "code"),
    [("single", signal.SIGTERM, 143), ("multi_async", signal.SIGINT, 130)],
    ids=["sigterm", "ctrl-c"],
)
def test_a_signal_leaves_a_good_checkpoint(small, tmp_path: Path, kind: str, number: int, code: int):
    folder = tmp_path / "run"
    options = [f"collector={kind}", "total_frames=1000000000", "evaluation=trained", f"folder={folder}"]
    process = start(*small, *options)
    try:
        wait_for(folder / "metrics.csv", process)
        # Ctrl-C reaches the workers, too
        os.killpg(process.pid, number) if number == signal.SIGINT else os.kill(process.pid, number)
        _, err = process.communicate(timeout=60)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == code, err
    assert "Traceback" not in err
    assert group_is_empty(process.pid), "processes were left behind"
    agent, _, state = load_agent(folder / "checkpoint.pt")
    assert state["frames"] > 0
    assert agent.config["model"] == "vusfa"
    # nothing half-written, and no evaluation of a training that was cut short
    names = {path.name for path in folder.iterdir()}
    assert names == {"metrics.csv", "config.json", "checkpoint.pt"}

    if kind != "single":
        return
    # the command that goes on needs nothing but the checkpoint
    done = state["frames"]
    again = start(
        f"resume={folder / 'checkpoint.pt'}",
        f"total_frames={done + 48}",
        "evaluation=none",
    )
    _, err = again.communicate(timeout=90)
    assert again.returncode == 0, err
    assert load_checkpoint(folder / "checkpoint.pt")["frames"] >= done + 48
