from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from vusfa.errors import ResultError
from vusfa.evaluation import Episodes
from vusfa.evaluation.exact import ExactGoals
from vusfa.experiments.runs import Run, read_run, read_runs, write_run


@pytest.fixture
def cell() -> Run:
    n = torch.arange(300)
    table = Episodes(n % 2, n, n + 3, n % 3 == 0, n * 2, n, n % 5, n < 9, ("hall", "attic"), 700)
    half = torch.linspace(0, 1, 4, dtype=torch.float64)
    exact = ExactGoals(torch.zeros(4).long(), torch.arange(4), {"success_500": half, "spl": half})
    return Run("table1", "vusfa-0", {"model": "vusfa", "seed": 0}, {"sampled": table, "greedy": table}, exact)


def test_comes_back_as_it_was(tmp_path: Path, cell: Run) -> None:
    folder = write_run(tmp_path, cell)
    assert sorted(path.name for path in folder.iterdir()) == [
        "cell.json", "exact.npz", "greedy.npz", "sampled.npz",
    ]  # fmt: skip
    again = read_run(tmp_path, "table1", "vusfa-0")
    assert again.info == cell.info
    assert list(again.episodes) == ["sampled", "greedy"]
    assert again.episodes["sampled"].equal(cell.episodes["sampled"])
    assert again.episodes["sampled"].remaining is None
    assert again.exact is not None
    assert cell.exact is not None
    torch.testing.assert_close(dict(again.exact.metrics), dict(cell.exact.metrics))


def test_what_remained_comes_back(tmp_path: Path, cell: Run) -> None:
    table = cell.episodes["sampled"]
    kept = Episodes(**{**vars(table), "remaining": table.shortest - 1})
    write_run(tmp_path, Run("a", "b", {}, {"sampled": kept}))
    again = read_run(tmp_path, "a", "b").episodes["sampled"]
    assert again.equal(kept)
    assert not again.equal(table)


def test_numbers_are_small_on_disk(tmp_path: Path, cell: Run) -> None:
    with np.load(write_run(tmp_path, cell) / "sampled.npz") as content:
        assert {name: content[name].dtype.name for name in ("scene", "length", "success")} == {
            "scene": "uint8",
            "length": "uint16",
            "success": "bool",
        }


def test_a_column_below_zero(tmp_path: Path, cell: Run) -> None:
    """-1 is the shortest path to a goal that cannot be reached."""
    table = cell.episodes["sampled"]
    odd = Episodes(**{**vars(table), "shortest": table.shortest - 1})
    write_run(tmp_path, Run("a", "b", {}, {"sampled": odd}))
    assert read_run(tmp_path, "a", "b").episodes["sampled"].shortest[0].item() == -1


def test_the_new_one_replaces_the_old(tmp_path: Path, cell: Run) -> None:
    write_run(tmp_path, cell)
    write_run(tmp_path, Run("table1", "vusfa-0", {"seed": 5}, {}))
    assert read_run(tmp_path, "table1", "vusfa-0").info == {"seed": 5}
    assert [path.name for path in (tmp_path / "table1").iterdir()] == ["vusfa-0"]


def test_nothing_is_left_of_one_that_could_not_be_written(tmp_path: Path, cell: Run) -> None:
    with pytest.raises(TypeError):
        write_run(tmp_path, Run("table1", "odd", {"seed": object()}, {}))
    with pytest.raises(ResultError, match="'exact'"):
        write_run(tmp_path, Run("table1", "odd", {}, {"exact": cell.episodes["sampled"]}))
    assert list((tmp_path / "table1").iterdir()) == []


def test_all_cells_by_name(tmp_path: Path, cell: Run) -> None:
    assert read_runs(tmp_path, "table1") == []
    for name in ("b", "a"):
        write_run(tmp_path, Run("table1", name, {}, {}))
    assert [cell.name for cell in read_runs(tmp_path, "table1")] == ["a", "b"]


@pytest.mark.parametrize("name", ["cell.json", "sampled.npz", "exact.npz"])
def test_a_damaged_file_is_named(tmp_path: Path, cell: Run, name: str) -> None:
    path = write_run(tmp_path, cell) / name
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(ResultError, match=name):
        read_run(tmp_path, "table1", "vusfa-0")


def test_json_is_plain(tmp_path: Path, cell: Run) -> None:
    content = json.loads((write_run(tmp_path, cell) / "cell.json").read_text())
    assert content["scenes"] == ["hall", "attic"]
    assert content["max_steps"] == 700


@pytest.mark.parametrize("limit", [0, -1, 10**12])
def test_limits_that_no_episode_has(tmp_path: Path, cell: Run, limit: int) -> None:
    path = write_run(tmp_path, cell) / "cell.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "max_steps": limit}))
    with pytest.raises(ResultError, match=f"cell.json: field 'max_steps' is {limit}"):
        read_run(tmp_path, "table1", "vusfa-0")


@pytest.mark.parametrize("name", ["a/b", "..", "", "../x-0", "x\0", "x" * 300])
def test_names_that_no_folder_has(tmp_path: Path, cell: Run, name: str) -> None:
    with pytest.raises(ResultError, match="a run cannot be called"):
        write_run(tmp_path, dataclasses.replace(cell, name=name))
    assert list(tmp_path.iterdir()) == []
