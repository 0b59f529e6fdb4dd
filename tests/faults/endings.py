"""Trainings as processes, for what ends them: kills, disks, signals. Forked, so that they begin at once."""

from __future__ import annotations

import csv
import multiprocessing.util
import os
import random
import signal
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path

import torch.multiprocessing

from vusfa.cli.launch import launch
from vusfa.experiments.training import train
from vusfa.training import load_agent, load_checkpoint

__all__ = ["COLLECTORS", "ended", "killed_until_done", "logged_frames", "start", "wait_for"]

COLLECTORS = ("single", "multi_sync", "multi_async", "hogwild")
SMALL = [
    "scenes=[bathroom]", "env.goals=[3,9,12]", "env.max_steps=20", "agent.hidden_size=8",
    "agent.embedding_size=8", "agent.history=1", "collector.num_envs=6", "collector.rollout=4",
    "log_every=24", "checkpoint_every=24", "evaluation=none", "autocast=false",
]  # fmt: skip


def start(
    folder: Path, *overrides: str, prepare: Callable[[], object] = lambda: None, output: Path | None = None
) -> int:
    """Begin a training in a process, and a process group, of its own; its output goes to ``FOLDER.txt``, or
    to ``output``.

    Returns:
        the process's number.
    """
    sys.stdout.flush()
    process = os.fork()
    if process:
        return process
    code: object = 70
    try:
        os.setsid()
        # as multiprocessing does where it forks itself: else descriptors that are sent to workers are looked
        # for in the process of the tests, once one of these has sent any
        multiprocessing.util._run_after_forkers()  # type: ignore[attr-defined]
        written = os.open(output or folder.with_suffix(".txt"), os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(written, 1)
        os.dup2(written, 2)
        sys.stdout = sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
        prepare()
        torch.multiprocessing.set_start_method("fork", force=True)
        sys.argv = ["train", *SMALL, f"folder={folder}", *overrides]
        launch(lambda settings, given: train(settings, given).exit_code)
    except SystemExit as end:
        code = end.code
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code if isinstance(code, int) else 71)


def ended(process: int, seconds: float = 120.0) -> int:
    """Exit code of a training, negative for a signal; nothing of its group may be left.

    Raises:
        TimeoutError: it does not end, or leaves processes.
    """
    end = time.monotonic() + seconds
    found, status = os.waitpid(process, os.WNOHANG)
    while not found:
        if time.monotonic() > end:
            os.killpg(process, signal.SIGKILL)
            os.waitpid(process, 0)
            raise TimeoutError(f"the training did not end within {seconds:g} s")
        time.sleep(0.01)
        found, status = os.waitpid(process, os.WNOHANG)
    while time.monotonic() < end:
        try:
            os.killpg(process, 0)
        except ProcessLookupError:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.01)
    os.killpg(process, signal.SIGKILL)
    raise TimeoutError("the training left processes behind")


def wait_for(path: Path, process: int, seconds: float = 120.0) -> bool:
    """Wait for a file; false where the training ended before."""
    end = time.monotonic() + seconds
    while not path.exists():
        if os.waitid(os.P_PID, process, os.WEXITED | os.WNOHANG | os.WNOWAIT):
            return False
        if time.monotonic() > end:
            raise TimeoutError(f"no {path}")
        time.sleep(0.005)
    return True


def logged_frames(folder: Path) -> list[int]:
    """Frames of the log's lines."""
    with open(folder / "metrics.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert all(None not in row and None not in row.values() for row in rows), "a torn line"
    return [int(row["frames"]) for row in rows]


def killed_until_done(folder: Path, kind: str, kills: int, seed: int) -> int:
    """Kill a training (-9) at random moments and give the same command again, then let it end.

    Each time the checkpoint must be whole; at the end the log must have every line once.

    Returns:
        how often it was killed.
    """
    draw, done, before = random.Random(f"{kind} {seed}"), 0, 0
    command = [f"collector={kind}", f"seed={seed}", "resume=auto", "optim=a3c"]
    while done < kills:
        process = start(folder, *command, "total_frames=1000000")
        begun = wait_for(folder / "config.json", process)
        assert begun, folder.with_suffix(".txt").read_text()
        time.sleep(draw.random() * 0.3)
        os.kill(process, signal.SIGKILL)
        assert ended(process) == -signal.SIGKILL
        done += 1
        if (folder / "checkpoint.pt").exists():
            frames = load_checkpoint(folder / "checkpoint.pt")["frames"]
            assert frames >= before, "learning was lost"
            before = frames
    process = start(folder, *command, f"total_frames={before + 240}")
    assert ended(process) == 0, folder.with_suffix(".txt").read_text()
    load_agent(folder / "checkpoint.pt")
    frames = logged_frames(folder)
    assert frames == sorted(set(frames)), "lines of the log are doubled or missing"
    assert {path.name for path in folder.iterdir()} == {"checkpoint.pt", "config.json", "metrics.csv"}
    return done
