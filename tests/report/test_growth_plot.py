"""Results by the number of rooms trained in."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from vusfa.errors import ResultError
from vusfa.evaluation import Episodes
from vusfa.evaluation.exact import ExactGoals
from vusfa.experiments.runs import Run
from vusfa.report.growth_plot import draw_growth, growth


def cell(name: str, trained: int, lengths: list[int], part: str | None = "validation") -> Run:
    """Two goals of two episodes each, five actions away; 500 is a failure."""
    length, goal = torch.tensor(lengths), torch.tensor([3, 3, 8, 8])
    zero = torch.zeros(4, dtype=torch.int64)
    table = Episodes(zero, goal, zero, length < 500, length, zero + 5, zero, zero > 0, ("hall",), 500)
    half = torch.tensor([0.25, 0.5], dtype=torch.float64)
    numbers = {"success_100": half, "success_500": 2 * half, "spl": half / 5}
    walk = ExactGoals(torch.zeros(2).long(), torch.tensor([3, 8]), numbers)
    info = {"tested_in": ["hall"], "trained_in": [f"room{i}" for i in range(trained)]}
    info |= {} if part is None else {"part": part}
    return Run("generalise", name, info, {"agent": table}, walk)


RUNS = [
    cell("rooms8-validation-0", 8, [5, 500, 200, 500]),
    cell("rooms8-validation-1", 8, [5, 500, 50, 500]),
    cell("rooms120-validation-0", 120, [5, 5, 10, 10]),
    cell("other-validation-0", 8, [5, 5, 5, 5]),
]


def test_a_series_is_of_one_name_and_goes_by_the_number_of_rooms() -> None:
    found = growth(RUNS, "success_100")
    assert list(found) == ["rooms (validation)", "random walk (validation)"]
    assert {number: round(one.value, 4) for number, one in found["rooms (validation)"].items()} == {
        8: 0.375,
        120: 1.0,
    }
    assert found["random walk (validation)"][0].value == pytest.approx(0.375)
    spl = growth(RUNS, "spl")["rooms (validation)"]
    assert spl[8].value == pytest.approx((1 + 5 / 200 + 1 + 5 / 50) / 8)
    assert spl[120].value == pytest.approx(0.75)
    assert spl[8].low < spl[8].value < spl[8].high


def test_rooms_that_were_tested_apart_are_drawn_apart() -> None:
    moved = [replace(run, info={**run.info, "part": "test", "tested_in": ["attic"]}) for run in RUNS[:3]]
    moved = [replace(run, name=run.name.replace("validation", "test")) for run in moved]
    assert list(growth([*RUNS, *moved], "spl")) == [
        "rooms (validation)", "rooms (test)", "random walk (validation)", "random walk (test)",
    ]  # fmt: skip


def test_the_figure_is_written_whole(tmp_path: Path) -> None:
    path = draw_growth(RUNS, tmp_path / "growth.png")
    assert path.read_bytes().startswith(b"\x89PNG")
    assert [each.name for each in tmp_path.iterdir()] == ["growth.png"]


def test_one_number_of_rooms_is_no_growth(tmp_path: Path) -> None:
    with pytest.raises(ResultError, match="give vusfa generalise names that end in the number of rooms"):
        draw_growth([RUNS[0], RUNS[1], RUNS[3]], tmp_path / "growth.png")
    assert not list(tmp_path.iterdir())
