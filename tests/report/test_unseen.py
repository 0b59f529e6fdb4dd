from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from vusfa.errors import ResultError
from vusfa.evaluation import Episodes
from vusfa.evaluation.exact import ExactGoals
from vusfa.experiments.runs import Run
from vusfa.report.unseen import unseen_table


def cell(seed: int, lengths: list[int]) -> Run:
    """Two goals of two episodes each, five actions away; 500 is a failure."""
    length = torch.tensor(lengths)
    goal = torch.tensor([3, 3, 8, 8])
    zero = torch.zeros(4, dtype=torch.int64)
    table = Episodes(zero, goal, zero, length < 500, length, zero + 5, zero, zero > 0, ("hall",), 500)
    half = torch.tensor([0.25, 0.5], dtype=torch.float64)
    walk = ExactGoals(
        torch.zeros(2).long(),
        torch.tensor([3, 8]),
        {"success_100": half, "success_500": 2 * half, "spl": half / 5},
    )
    return Run("generalise", f"vusfa-{seed}", {"tested_in": ["hall"]}, {"agent": table}, walk)


def test_by_hand() -> None:
    lines = unseen_table([cell(0, [5, 10, 200, 500]), cell(1, [5, 50, 20, 100])]).splitlines()
    agent, walk = ([part.strip().split(" ")[0] for part in line.split("|")[1:-1]] for line in lines[2:])
    spl = 100 * (1 + 0.5 + 0.025 + 0 + 1 + 0.1 + 0.25 + 0.05) / 8
    assert agent == ["agent", "2", "87.5", "75.0", f"{spl:.1f}", "37.5"]
    assert walk == ["random", "–", "75.0", "37.5", "7.5", "–"]


def test_other_rooms_have_a_table_of_their_own_and_other_names_rows() -> None:
    """Searchers stand once, below the agents."""
    runs = [cell(0, [5, 10, 200, 500]), cell(1, [5, 50, 20, 100]), cell(0, [5, 5, 5, 5])]
    runs[2] = replace(runs[2], name="more-test-0", info={"tested_in": ["hall"], "part": "test"})
    for run in runs:
        run.episodes["shortest-path"] = cell(0, [5, 5, 5, 5]).episodes["agent"]
    alone = replace(runs[1], info={"tested_in": ["attic"], "part": "large"}, name="vusfa-large-1")
    first, second = unseen_table([*runs, alone]).split("\n\n**")
    rows = [[part.strip() for part in line.split("|")[1:3]] for line in first.splitlines()[4:]]
    assert first.startswith("**Tested in 1 rooms**")
    assert rows == [["vusfa: agent", "2"], ["more: agent", "1"], ["shortest-path", "1"], ["random walk", "–"]]
    assert second.startswith("Tested in 1 rooms (large)**")
    assert [line.split("|")[1].strip() for line in second.splitlines()[4:]] == [
        "agent",
        "shortest-path",
        "random walk",
    ]


def test_what_cannot_be_shown() -> None:
    with pytest.raises(ResultError, match="run it first"):
        unseen_table([])
    other = cell(1, [5, 5, 5, 5])
    other.episodes["agent"].goal[0] = 4
    with pytest.raises(ResultError, match="different goals"):
        unseen_table([cell(0, [5, 5, 5, 5]), other])


def test_searchers_that_one_seed_alone_was_tested_beside() -> None:
    runs = [cell(0, [5, 10, 200, 500]), cell(1, [5, 50, 20, 100])]
    runs[1].episodes["shortest-path"] = cell(0, [5, 5, 5, 5]).episodes["agent"]
    lines = unseen_table(runs).splitlines()[2:]
    rows = [[part.strip().split(" ")[0] for part in line.split("|")[1:4]] for line in lines]
    assert rows == [["agent", "2", "87.5"], ["shortest-path", "1", "100.0"], ["random", "–", "75.0"]]
