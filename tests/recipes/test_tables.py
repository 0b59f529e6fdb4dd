"""recipes/tables.py on runs of recipes/table1.py."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from vusfa.errors import ResultError

SMALL = [
    "agent.hidden_size=8",
    "agent.embedding_size=8",
    "agent.history=1",
    "scenes=[bathroom]",
    "total_frames=160",
    "collector.num_envs=8",
    "collector.rollout=4",
]


def test_all_tables(recipe: Callable[[str], Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    results = tmp_path / "results"
    recipe("table1").table1(
        SMALL, models=["gvf", "vusfa"], seeds=[0], stages=[1.0], results=results, runs=tmp_path / "runs"
    )
    capsys.readouterr()
    recipe("tables").tables(["table1"], results=results, resamples=50)
    out = capsys.readouterr().out
    for title in (
        "Runs",
        "Unseen goals, the likeliest action",
        "All goals, computed, actions drawn",
        "Interquartile mean over seeds and scenes, actions drawn",
        "Paired differences and probabilities of improvement, both in %, actions drawn",
    ):
        assert f"### {title}\n" in out
    assert "soft-SPL" in out
    assert "| random walk |" in out
    assert "Trained goals NOT solved" in out  # after 160 frames
    with open(results / "tables" / "models.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert {row["mode"] for row in rows} == {"sampled", "greedy", "exact"}
    row = next(row for row in rows if (row["model"], row["goals"], row["mode"]) == ("gvf", "all", "sampled"))
    assert float(row["spl_low"]) <= float(row["spl"]) <= float(row["spl_high"])


def test_no_results(recipe: Callable[[str], Any], tmp_path: Path) -> None:
    with pytest.raises(ResultError, match="run vusfa table1 first"):
        recipe("tables").tables(results=tmp_path)
