"""Data-parallel trainings as processes: ranks make the updates of one learner, and end together."""

from __future__ import annotations

import csv
import os
import signal
import socket
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
import torch
from endings import ended, logged_frames, start, wait_for

from vusfa.modules.bottleneck import LatentSampler
from vusfa.training import Trainer, distributed, load_checkpoint, rendezvous

STEADY = ["optim.horizon=100000", "entropy.horizon=100000", "objective.normalize_advantage=true"]


def ranked(
    folder: Path, size: int, *overrides: str, hook: Callable[[int], object] = lambda rank: None
) -> list[int]:
    """Begin a training of several ranks; the output of rank R goes to ``FOLDER.R``."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]

    def prepare(rank: int) -> None:
        names = {"RANK": rank, "WORLD_SIZE": size, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
        os.environ.update({name: str(value) for name, value in names.items()})
        distributed.BEAT, distributed.MISSED = 0.1, 0.5
        hook(rank)

    return [
        start(folder, *STEADY, *overrides, prepare=partial(prepare, rank), output=said(folder, rank))
        for rank in range(size)
    ]


def said(folder: Path, rank: int) -> Path:
    return folder.with_suffix(f".{rank}")


def trained(folder: Path, size: int, *overrides: str, hook: Callable[[int], object] = lambda _: None) -> dict:
    processes = ranked(folder, size, *overrides, hook=hook)
    assert [ended(process) for process in processes] == [0] * size, said(folder, 0).read_text()
    assert [said(folder, rank).read_text() for rank in range(1, size)] == [""] * (size - 1)
    return load_checkpoint(folder)


def without_noise(rank: int = 0) -> None:
    """The goal's latent is its mean: noise is drawn per distinct row, of which each rank has its own."""
    LatentSampler.noise = lambda self, loc: torch.zeros_like(loc)  # type: ignore[method-assign]


def after(updates: int, what: Callable[[], object], on: int) -> Callable[[int], None]:
    """A hook: on one rank something happens after so many updates."""

    def hook(rank: int) -> None:
        update = Trainer.update

        def updated(self: Trainer, batches: object) -> object:
            if rank == on and self.updates == updates:
                what()
            return update(self, batches)  # type: ignore[arg-type]

        Trainer.update = updated  # type: ignore[method-assign,assignment]

    return hook


def numbers(state: dict) -> list:
    draws = [{**each, "rng": each["rng"]["torch"]} for each in state["ranks"]]
    learned = [state[name] for name in ("agent", "optimizer", "algorithm", "collector")]
    return [*learned, state["meter"]["episodes"], state["meter"]["terms"]["sum"], draws]


def rows(folder: Path) -> list[dict[str, str]]:
    with open(folder / "metrics.csv", newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("algorithm", ["usf", "replay_search"])
def test_two_ranks_make_the_updates_of_one_learner_with_as_many_environments(tmp_path: Path, algorithm: str):
    """Weights, moments, multiplier and log; before the first search, which draws pairs for itself."""
    chosen = ["total_frames=240", f"algorithm={algorithm}", "agent.model=vusfa"]
    chosen += ["agent.history=4"] if algorithm == "usf" else ["algorithm.learning_starts=239"]
    workers = ["collector=multi_sync", "collector.num_workers=2"]
    one = start(tmp_path / "one", *STEADY, *chosen, *workers, prepare=without_noise)
    two = trained(tmp_path / "two", 2, *chosen, hook=without_noise)
    assert ended(one) == 0, (tmp_path / "one.txt").read_text()
    whole = load_checkpoint(tmp_path / "one")
    assert two["frames"] == whole["frames"] == 240
    assert two["updates"] == 10
    torch.testing.assert_close(two["agent"], whole["agent"], rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(two["optimizer"]["state"], whole["optimizer"]["state"], rtol=1e-3, atol=1e-7)
    torch.testing.assert_close(two["algorithm"], whole["algorithm"], rtol=1e-4, atol=1e-6)
    for found, expected in zip(rows(tmp_path / "two"), rows(tmp_path / "one"), strict=True):
        for name, value in expected.items():  # the share of the variance is the mean of the ranks'
            if name not in ("seconds", "explained_variance"):
                assert float(found[name] or 0) == pytest.approx(float(value or 0), rel=1e-3, abs=1e-6), name


def test_a_resumed_run_goes_on_number_for_number_or_with_the_rows_of_another_number_of_ranks(tmp_path: Path):
    through = trained(tmp_path / "through", 2, "total_frames=144")
    half = trained(tmp_path / "half", 2, "total_frames=72")
    path = tmp_path / "half" / "checkpoint.pt"
    resumed = trained(tmp_path / "again", 2, f"resume={path}", "total_frames=144")
    assert resumed["frames"] == through["frames"] == 144
    for found, expected in zip(numbers(resumed), numbers(through), strict=True):
        torch.testing.assert_close(found, expected, rtol=0, atol=0)
    assert half["collector"]["batch_size"] == [6]
    alone = start(tmp_path / "alone", *STEADY, f"resume={path}", "total_frames=96")
    three = trained(tmp_path / "three", 3, f"resume={path}", "total_frames=96")
    assert ended(alone) == 0, (tmp_path / "alone.txt").read_text()
    for state in (three, load_checkpoint(tmp_path / "alone")):
        assert (state["updates"], state["collector"]["batch_size"]) == (4, [6])
        assert torch.equal(state["collector"]["carrier"]["goal_id"], half["collector"]["carrier"]["goal_id"])


@pytest.mark.parametrize("late", [0, 1])
def test_a_rank_that_begins_late_is_waited_for(tmp_path: Path, late: int):
    """Longer than for an address that does not answer: where nobody listens yet, somebody will."""

    def hook(rank: int) -> None:
        rendezvous.REACH = 0.5
        if rank == late:
            time.sleep(2.0)

    assert trained(tmp_path / "run", 2, "total_frames=24", hook=hook)["frames"] == 24


@pytest.mark.parametrize(
    ("number", "gone", "words"),
    [
        (signal.SIGKILL, 1, "has ended, or does not answer; all 48 frames are in"),
        (signal.SIGSTOP, 1, "has ended, or does not answer; all 48 frames are in"),
        (signal.SIGKILL, 0, "rank 0 has ended, or its machine is gone; resume from"),
    ],
)
def test_a_rank_that_is_gone_ends_all_with_one_error_and_a_checkpoint(
    tmp_path: Path, number: int, gone: int, words: str
):
    folder = tmp_path / "run"
    hook = after(2, lambda: os.kill(os.getpid(), number), on=gone)
    processes = ranked(folder, 2, "total_frames=1000000", "collector.timeout=1", hook=hook)
    assert ended(processes[1 - gone], 20.0) == 1
    os.kill(processes[gone], signal.SIGKILL)
    assert ended(processes[gone]) == -signal.SIGKILL
    error = said(folder, 1 - gone).read_text().splitlines()[-1]
    if gone:
        assert error.startswith(f"error: rank {gone} (process {processes[gone]} on ")
    assert f"{words} {folder / 'checkpoint.pt'}" in error
    assert load_checkpoint(folder)["frames"] == 48
    assert trained(folder, 2, "resume=auto", "total_frames=72")["updates"] == 3


def test_a_signal_to_one_rank_ends_all_after_the_same_update(tmp_path: Path):
    folder = tmp_path / "run"
    hook = after(2, lambda: os.kill(os.getpid(), signal.SIGTERM), on=1)
    processes = ranked(folder, 2, "total_frames=1000000", hook=hook)
    assert [ended(process) for process in processes] == [128 + signal.SIGTERM] * 2
    assert "error" not in said(folder, 0).read_text() + said(folder, 1).read_text()
    assert load_checkpoint(folder)["frames"] == 72
    assert logged_frames(folder) == [24, 48, 72]


def test_an_error_of_one_rank_before_the_first_batch_is_said_once(tmp_path: Path):
    folder = tmp_path / "run"
    held = start(folder, "total_frames=1000000")
    assert wait_for(folder / "config.json", held)
    processes = ranked(folder, 2, "total_frames=240")
    os.kill(held, signal.SIGTERM)
    assert [ended(process) for process in processes] == [2, 1]
    assert said(folder, 0).read_text().count("error: folder is ") == 1
    assert said(folder, 1).read_text() == ""
    ended(held)


@pytest.mark.parametrize(
    ("setting", "words"),
    [("collector.num_envs=1", "num_envs=1 is fewer than"), ("collector=multi_sync", "kind=multi_sync has")],
)
def test_what_ranks_cannot_share_is_said_by_the_first(tmp_path: Path, setting: str, words: str):
    folder = tmp_path / "run"
    processes = ranked(folder, 2, setting)
    assert [ended(process) for process in processes] == [2, 1]
    assert said(folder, 0).read_text().startswith(f"error: collector.{words}")
    assert said(folder, 0).read_text().count("\n") == 1
    assert said(folder, 1).read_text() == ""
    assert not folder.exists()
