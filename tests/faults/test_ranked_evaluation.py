"""Evaluations of data-parallel trainings: ranks share them out, and the numbers are those of one process."""

from __future__ import annotations

import csv
import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from endings import ended, start
from test_ranks import ranked, said, trained

from vusfa.evaluation import parts
from vusfa.experiments import measure
from vusfa.training import load_checkpoint

#: Two rooms; the rate is so small that no weight moves: all trainings have the same agent.
CHOSEN = ["scenes=[bathroom,bedroom]", "env.goals=[3,9,12,200,300]", "optim.lr=1e-30", "total_frames=72"]
CHOSEN += ["evaluation=trained", "evaluation.interval=24", "evaluation.max_steps=30"]


def counted(folder: Path) -> Callable[[int], None]:
    """A hook: each rank writes down the goals of the parts that it evaluates."""

    def hook(rank: int) -> None:
        evaluate, walks_within = parts.evaluate, measure.walks_within

        def note(kind: str, goals: object) -> None:
            with open(folder / f"goals.{rank}.csv", "a") as file:
                csv.writer(file).writerow([kind, *goals.unique().tolist()])  # type: ignore[attr-defined]

        def evaluated(*given, **options):
            note("walked", options["episodes"][1])
            return evaluate(*given, **options)

        def within(probabilities, scenes, goals, max_steps):
            note("exact", goals)
            return walks_within(probabilities, scenes, goals, max_steps)

        parts.evaluate, measure.walks_within = evaluated, within

    return hook


def goals_of(folder: Path, rank: int) -> list[tuple[str, ...]]:
    return [tuple(line.split(",")) for line in (folder / f"goals.{rank}.csv").read_text().split()]


def evaluations(folder: Path) -> list[list[str]]:
    """Columns of the evaluations in the log."""
    with open(folder / "metrics.csv", newline="") as file:
        log = list(csv.DictReader(file))
    return [[row[name] for name in row if "eval/" in name] for row in log]


@pytest.mark.parametrize(
    "agent",
    [["agent.model=gvf"], ["agent.model=vusfa", "agent.history=2"], ["agent.model=gvf", "agent.memory=lstm"]],
    ids=["one frame", "two frames", "lstm"],
)
def test_ranks_share_out_evaluations_whose_numbers_are_those_of_one_process(
    tmp_path: Path, agent: list[str], monkeypatch: pytest.MonkeyPatch
):
    for name in ("one", "two", "three"):
        (tmp_path / f"count {name}").mkdir()
    one = start(
        tmp_path / "one", *CHOSEN, *agent, prepare=lambda: counted(tmp_path / "count one")(0)
    )  # as ranks without torchrun
    for name, size in (("two", 2), ("three", 3)):
        trained(tmp_path / name, size, *CHOSEN, *agent, hook=counted(tmp_path / f"count {name}"))
    assert ended(one) == 0, (tmp_path / "one.txt").read_text()
    whole = goals_of(tmp_path / "count one", 0)
    assert evaluations(tmp_path / "one")[-1]
    tables = sorted(path.name for path in (tmp_path / "one").glob("*.csv") if path.name != "metrics.csv")
    assert {"evaluation.csv", "evaluation_episodes.csv", "validation.csv"} <= set(tables)
    for name, size in (("two", 2), ("three", 3)):
        assert evaluations(tmp_path / name) == evaluations(tmp_path / "one")
        for table in tables:
            assert (tmp_path / name / table).read_bytes() == (tmp_path / "one" / table).read_bytes(), table
        shares = [goals_of(tmp_path / f"count {name}", rank) for rank in range(size)]
        assert sorted(goals for share in shares for goals in share) == sorted(whole)
        # three evaluations of two parts during the training, one of three at its end
        assert [len(share) for share in shares] == ([5, 4] if size == 2 else [4, 4, 1])


@pytest.mark.parametrize(
    ("gone", "number", "words"),
    [
        (1, signal.SIGKILL, "has ended, or does not answer; all 24 frames are in"),
        (1, signal.SIGSTOP, "has ended, or does not answer; all 24 frames are in"),
        (0, signal.SIGKILL, "rank 0 has ended, or its machine is gone; there is no checkpoint yet"),
    ],
)
def test_a_rank_that_is_gone_during_an_evaluation_ends_all(
    tmp_path: Path, gone: int, number: int, words: str
):
    def hook(rank: int) -> None:
        if rank == gone:
            measure.walks_within = lambda *_: os.kill(os.getpid(), number)

    folder = tmp_path / "run"
    processes = ranked(folder, 2, *CHOSEN, "collector.timeout=1", hook=hook)
    assert ended(processes[1 - gone], 20.0) == 1
    os.kill(processes[gone], signal.SIGKILL)
    assert ended(processes[gone]) == -signal.SIGKILL
    error = said(folder, 1 - gone).read_text().splitlines()[-1]
    assert words in error
    if gone:
        assert error.startswith(f"error: rank 1 (process {processes[gone]} on ")
        assert load_checkpoint(folder)["frames"] == 24


@pytest.mark.parametrize("gone", [0, 1])
def test_after_the_training_the_checkpoint_stays(tmp_path: Path, gone: int):
    folder = tmp_path / "run"

    def hook(rank: int) -> None:
        if rank == gone:
            parts.evaluate = lambda *_, **__: os.kill(os.getpid(), signal.SIGKILL)  # type: ignore[assignment]

    processes = ranked(folder, 2, *CHOSEN, hook=hook)
    assert ended(processes[1 - gone], 20.0) == 1
    assert ended(processes[gone]) == -signal.SIGKILL
    error = said(folder, 1 - gone).read_text().splitlines()[-1]
    assert error.startswith(f"error: rank {gone}")
    assert error.endswith(f"; the agent is in {folder / 'checkpoint.pt'}: evaluate it")
    assert load_checkpoint(folder)["frames"] == 72
    assert not (folder / "evaluation.csv").exists()
    trained(folder, 2, *CHOSEN, "resume=auto")
    assert (folder / "evaluation.csv").exists()


def test_an_error_during_a_share_ends_all(tmp_path: Path):
    def hook(rank: int) -> None:
        if rank == 1:
            measure.walks_within = lambda *_: measure.read_manifest(Path("nothing.npz"))  # type: ignore[assignment]

    folder = tmp_path / "run"
    processes = ranked(folder, 2, *CHOSEN, hook=hook)
    assert [ended(process, 20.0) for process in processes] == [1, 1]
    whole, own = (said(folder, rank).read_text().splitlines()[-1] for rank in (0, 1))
    assert own.startswith("error: ")
    assert "nothing.npz" in own
    assert whole.startswith(f"error: rank 1 (process {processes[1]} on ")
    assert f" has ended: {own.removeprefix('error: ')}; all 24 frames are in" in whole
