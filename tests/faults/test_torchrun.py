"""Data-parallel trainings as a user begins them, with a real ``torchrun``: what ends them, and how."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from endings import SMALL, ended, start
from test_ranks import STEADY, trained

from vusfa.training import load_checkpoint

ROOT = Path(__file__).parents[2]
#: At its end an evaluation that takes minutes.
EVALUATED = [
    "total_frames=240",
    "checkpoint_every=240",
    "evaluation=all",
    "evaluation.interval=null",
    "evaluation.episodes_per_goal=5000",
    "agent.history=2",
]
Torchrun = Callable[..., subprocess.Popen]
long = pytest.mark.skipif(not os.environ.get("VUSFA_LONG"), reason="part of make faults")


@pytest.fixture
def torchrun() -> Iterator[Torchrun]:
    """Begins a training with ``torchrun``, whose output goes to ``FOLDER.txt``."""
    begun: list[subprocess.Popen[Any]] = []

    def begin(folder: Path, ranks: int, *overrides: str) -> subprocess.Popen:
        command = [sys.executable, "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={ranks}"]
        command += ["-m", "vusfa.cli", "train", *SMALL, *STEADY, f"folder={folder}", *overrides]
        paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
        environ = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": paths}
        with open(folder.with_suffix(".txt"), "wb") as output:
            begun.append(
                subprocess.Popen(command, stdout=output, stderr=output, env=environ, start_new_session=True)
            )
        return begun[-1]

    yield begin
    for process in begun:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def rank_of(launcher: subprocess.Popen, rank: int) -> int:
    """The process of a rank."""
    for child in Path(f"/proc/{launcher.pid}/task/{launcher.pid}/children").read_text().split():
        if f"LOCAL_RANK={rank}".encode() in Path(f"/proc/{child}/environ").read_bytes().split(b"\0"):
            return int(child)
    raise LookupError(rank)


def wait_for(path: Path, launcher: subprocess.Popen) -> None:
    end = time.monotonic() + 120
    while not path.exists():
        assert launcher.poll() is None, path.parent.with_suffix(".txt").read_text()
        assert time.monotonic() < end
        time.sleep(0.02)


def errors(folder: Path) -> list[str]:
    return [line for line in said_by_all(folder) if line.startswith("error: ")]


def said_by_all(folder: Path) -> list[str]:
    return folder.with_suffix(".txt").read_text().splitlines()


def gone(launcher: subprocess.Popen, seconds: float = 25.0) -> int:
    """Exit code of a launcher that has to end now, with all its ranks."""
    code = launcher.wait(seconds)
    with pytest.raises(ProcessLookupError):
        os.killpg(launcher.pid, 0)
    return code


@pytest.mark.parametrize("rank", [pytest.param(0, marks=long), 1])
def test_a_killed_rank_ends_all_and_any_number_of_ranks_goes_on(
    tmp_path: Path, torchrun: Torchrun, rank: int
):
    folder = tmp_path / "run"
    launcher = torchrun(folder, 2, "total_frames=1000000000", "log_every=240", "checkpoint_every=240")
    wait_for(folder / "checkpoint.pt", launcher)
    process = rank_of(launcher, rank)
    os.kill(process, signal.SIGKILL)
    assert gone(launcher) == 1
    (error,) = errors(folder)
    assert error.startswith(f"error: rank {rank} (process {process} on ")
    assert str(folder / "checkpoint.pt") in error
    frames = load_checkpoint(folder)["frames"]
    assert frames % 24 == 0 < frames
    again = [f"resume={folder / 'checkpoint.pt'}", f"total_frames={frames + 48}"]
    alone = start(tmp_path / "one", *STEADY, *again)
    assert trained(tmp_path / "two", 2, *again)["frames"] == frames + 48
    assert ended(alone) == 0, (tmp_path / "one.txt").read_text()
    assert load_checkpoint(tmp_path / "one")["frames"] == frames + 48


@pytest.mark.parametrize("rank", [0, pytest.param(1, marks=long)])
def test_a_killed_rank_during_the_evaluation_ends_all(tmp_path: Path, torchrun: Torchrun, rank: int):
    folder = tmp_path / "run"
    launcher = torchrun(folder, 2, *EVALUATED)
    wait_for(folder / "checkpoint.pt", launcher)
    time.sleep(0.5)
    process = rank_of(launcher, rank)
    os.kill(process, signal.SIGKILL)
    assert gone(launcher) == 1
    (error,) = errors(folder)
    assert error.startswith(f"error: rank {rank} (process {process} on ")
    assert error.endswith(f"; the agent is in {folder / 'checkpoint.pt'}: evaluate it")
    assert load_checkpoint(folder)["frames"] == 240


@long
@pytest.mark.parametrize("given", [["total_frames=1000000000"], EVALUATED])
def test_a_signal_to_the_launcher_ends_all(tmp_path: Path, torchrun: Torchrun, given: list[str]):
    folder = tmp_path / "run"
    launcher = torchrun(folder, 2, *given, "log_every=240", "checkpoint_every=240")
    wait_for(folder / "checkpoint.pt", launcher)
    time.sleep(0.5)
    launcher.send_signal(signal.SIGTERM)
    assert gone(launcher) == 1
    frames = load_checkpoint(folder)["frames"]
    if given is EVALUATED:
        assert frames == 240
        said_why = f"rank 0 was ended by SIGTERM; the agent is in {folder / 'checkpoint.pt'}: evaluate it"
        assert errors(folder) == [f"error: {said_why}"]
    else:
        assert frames > 240
        assert errors(folder) == []
        assert str(folder / "checkpoint.pt") in said_by_all(folder)


@long
def test_more_ranks_than_environments(tmp_path: Path, torchrun: Torchrun):
    folder = tmp_path / "run"
    launcher = torchrun(folder, 2, "collector.num_envs=1")
    assert gone(launcher, 120) == 1
    assert errors(folder) == ["error: collector.num_envs=1 is fewer than the 2 ranks; give a multiple of 2"]
    assert not folder.exists()
