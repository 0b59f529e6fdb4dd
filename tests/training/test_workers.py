"""Worker processes that die, stop, or do not begin: one line that names them, nothing left running."""

from __future__ import annotations

import multiprocessing
import os
import queue
import re
import signal
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from vusfa.cli.launch import compose
from vusfa.errors import ResultError, WorkerError
from vusfa.training import StopOnSignal, Trainer, load_checkpoint, make_trainer, run_training
from vusfa.training.workers import Silence, _WatchedQueue, begin_worker, started

SMALL = ["agent.hidden_size=8", "agent.embedding_size=8", "agent.history=1", "env.goals=[3,9,12]"]
SMALL += ["collector.num_envs=6", "collector.rollout=4", "scenes=[bathroom]", "total_frames=1000000"]


class Deaf:
    """A logger and a line of progress that do something after a number of updates."""

    def __init__(self, act: Callable[[Trainer], None], after: int = 3) -> None:
        self.act, self.left = act, after
        self.trainer: Trainer

    def update(self, frames: int) -> None:
        self.left -= 1
        if self.left == 0:
            self.act(self.trainer)

    def rates(self, *_: Any, **__: Any) -> None:
        pass

    log_metrics = log_checkpoint = rates


def ended_by(act: Callable[[Trainer], None], path: Path, *overrides: str) -> str:
    """What a training says that something happens to."""
    settings: Any = OmegaConf.to_container(compose(overrides=[*SMALL, *overrides]), resolve=True)
    deaf = Deaf(act)
    deaf.trainer = trainer = make_trainer(settings)
    with StopOnSignal() as stop, pytest.raises((WorkerError, ResultError)) as error:
        run_training(trainer, path, deaf, stop, deaf)  # type: ignore[arg-type]
    assert "\n" not in str(error.value)
    assert not multiprocessing.active_children()
    return str(error.value)


def signal_worker(number: int, trainer: Trainer) -> None:
    assert trainer._collector is not None
    os.kill(trainer._collector.procs[1].pid, number)


@pytest.mark.usefixtures("fast_workers")
@pytest.mark.parametrize(
    ("kind", "number"),
    [
        ("multi_sync", signal.SIGKILL),
        ("multi_async", signal.SIGTERM),
        ("multi_async", signal.SIGSEGV),
        ("hogwild", signal.SIGKILL),
    ],
)
def test_a_worker_that_dies(tmp_path: Path, kind: str, number: signal.Signals):
    path = tmp_path / "checkpoint.pt"
    text = ended_by(partial(signal_worker, number), path, f"collector={kind}", "optim=a3c")
    assert text.startswith("worker 1 of the collector (process ")
    assert f"was ended by {number.name}" in text
    frames = load_checkpoint(path)["frames"]
    assert frames >= 36
    assert text.endswith(f"all {frames} frames are in {path}: resume it")


@pytest.mark.usefixtures("fast_workers")
@pytest.mark.parametrize("kind", ["multi_sync", "multi_async", "hogwild"])
def test_a_worker_that_is_stopped(tmp_path: Path, kind: str):
    """In multi_async and hogwild the others go on sending."""
    stop = partial(signal_worker, signal.SIGSTOP)
    text = ended_by(stop, tmp_path / "a.pt", f"collector={kind}", "collector.timeout=1.5", "optim=a3c")
    named = r"worker 1 \(process \d+\) of the collector is stopped by a signal and has sent nothing for 1.5 s"
    assert re.match(named, text), text
    assert load_checkpoint(tmp_path / "a.pt")["frames"] >= 36


def test_a_disk_that_is_full_when_the_log_is_written(tmp_path: Path):
    def full(_: Trainer) -> None:
        raise ResultError("metrics.csv: cannot be written (No space left on device)")

    text = ended_by(full, tmp_path / "a.pt")
    assert text.startswith("metrics.csv: cannot be written (No space left on device); ")
    assert text.endswith(f"; all 72 frames are in {tmp_path}/a.pt: resume it")
    (tmp_path / "b.pt").mkdir()  # and no checkpoint can be written either
    assert ended_by(full, tmp_path / "b.pt").endswith("; there is no checkpoint yet")


@pytest.mark.parametrize(
    ("seconds", "limit", "words"),
    [(1.3, 20.0, "ended with exit code 0"), (60.0, 0.1, "not begun within 0.1 s")],
)
def test_workers_that_do_not_begin(seconds: float, limit: float, words: str):
    def start() -> None:
        with started(limit):
            multiprocessing.get_context("fork").Process(target=time.sleep, args=(seconds,)).start()
            time.sleep(30)  # TorchRL waits for a pipe

    with pytest.raises(WorkerError, match=f"cannot start: .*{words}.*collector.num_workers"):
        start()
    assert not multiprocessing.active_children()


def test_a_system_that_refuses_processes():
    with pytest.raises(WorkerError, match=r"cannot start: .*Too many open files; give fewer"), started(None):
        raise OSError(24, "Too many open files")


def test_time_in_which_the_training_itself_was_stopped_does_not_count(monkeypatch: pytest.MonkeyPatch):
    now = [0.0]
    monkeypatch.setattr("vusfa.training.workers.time.monotonic", lambda: now[0])

    class Worker:
        pid, exitcode = 1, None

        def kill(self) -> None:
            """It is none."""

    results: queue.Queue[Any] = queue.Queue()
    watched = _WatchedQueue(results, [Worker(), Worker()], 60.0)
    now[0] = 3600.0  # Ctrl-Z, and fg after lunch
    with pytest.raises(queue.Empty):
        watched.get(timeout=0.01)
    results.put((1, 0))
    assert watched.get() == (1, 0)
    results.put(((torch.zeros(1), 0), 0))
    watched.get()
    for _ in range(10):
        now[0] += 10.0
        results.put((1, 0))
        if now[0] > 3660.0:
            with pytest.raises(WorkerError, match=r"worker 0 .* has sent nothing for 60 s"):
                watched.get()
            break
        watched.get()
    else:
        pytest.fail("the silence of worker 0 was not seen")


class Process:
    pid = 1  # which no signal stops


def let_pass(seconds: float, now: list[float], silence: Silence) -> None:
    for _ in range(round(2 * seconds)):
        now[0] += 0.5
        silence.check()


def test_of_workers_that_wait_for_each_other_the_silent_one_is_named(monkeypatch: pytest.MonkeyPatch):
    now = [0.0]
    monkeypatch.setattr("vusfa.training.workers.time.monotonic", lambda: now[0])
    silence = Silence([Process(), Process(), Process()], 5.0, in_rounds=True)
    for index in (0, 1, 2, 0, 2):  # a round, and of the next all but 1
        silence.ends(index)
        silence.check()
    words = r"^worker 1 \(process 1\) of the collector has sent nothing for 5 s"
    with pytest.raises(WorkerError, match=words):
        let_pass(6.0, now, silence)


def test_where_the_silent_one_cannot_be_known_it_is_said(monkeypatch: pytest.MonkeyPatch):
    now = [0.0]
    monkeypatch.setattr("vusfa.training.workers.time.monotonic", lambda: now[0])
    silence = Silence([Process(), Process(), Process()], 5.0)
    let_pass(4.0, now, silence)
    silence.ends(1)
    words = r"^worker 0 .*, 2 .* \(collector.timeout\); which of them the others wait for cannot be known$"
    with pytest.raises(WorkerError, match=words):
        let_pass(2.0, now, silence)


def test_a_suspended_training_with_a_short_limit_does_not_accuse_its_workers(monkeypatch: pytest.MonkeyPatch):
    """Of Ctrl-Z and what follows, as much as a quarter of the limit counts."""
    now = [0.0]
    monkeypatch.setattr("vusfa.training.workers.time.monotonic", lambda: now[0])
    silence = Silence([Process(), Process()], 5.0)
    now[0] = 3600.0
    silence.check()
    let_pass(3.0, now, silence)
    with pytest.raises(WorkerError, match="has sent nothing"):
        let_pass(1.0, now, silence)


@pytest.mark.parametrize("threads", [0, 1])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_to_all_processes_while_workers_start(number: signal.Signals, threads: int):
    """With other threads in this process one of them receives it."""
    ended_thread = threading.Event()
    for _ in range(threads):
        threading.Thread(target=ended_thread.wait, daemon=True).start()
    received: list[int] = []
    pid: list[int] = []
    before = signal.signal(number, lambda *_: received.append(number))
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, [])
    expected = KeyboardInterrupt if number == signal.SIGINT else SystemExit
    child = multiprocessing.get_context("fork").Process(target=time.sleep, args=(60,))

    def start() -> None:
        with started(None):
            child.start()
            pid.append(os.posix_spawnp("sleep", ["sleep", "60"], os.environ))  # in no list of multiprocessing
            os.kill(child.pid or 0, number)
            os.kill(os.getpid(), number)
            assert not received
            time.sleep(30)

    try:
        with pytest.raises(expected) as ended:
            start()
        assert getattr(ended.value, "code", 143) == 143
        assert child.exitcode == -signal.SIGKILL  # not of the signal, which it had not begun to expect
        assert not Path(f"/proc/{pid[0]}").exists()
        assert received == [number]
        assert signal.pthread_sigmask(signal.SIG_BLOCK, []) == blocked
    finally:
        ended_thread.set()
        signal.signal(number, before)


def test_a_worker_that_has_begun_receives_signals():
    def work() -> None:
        time.sleep(1.2)  # the time until the first look at workers
        begin_worker(False)
        time.sleep(60)

    child = multiprocessing.get_context("fork").Process(target=work)

    def start() -> None:
        with started(None):
            child.start()
            os.kill(child.pid or 0, signal.SIGTERM)
            time.sleep(30)

    with pytest.raises(WorkerError, match=r"process \d+\) was ended by SIGTERM"):
        start()
    assert child.exitcode == -signal.SIGTERM
