"""Run folders and cells, read."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from vusfa.errors import ConfigError, ResultError
from vusfa.evaluation.exact import ExactGoals
from vusfa.experiments.runs import Run, write_run
from vusfa.report import read_run, read_source
from vusfa.report.curve import read_metrics
from vusfa.report.runs import read_episodes


def test_a_run_of_the_recipe(run_folders: list[Path]):
    run = read_run(run_folders[1])
    assert (run.label, run.seed, run.name) == ("vusfa", 1, "vusfa, seed 1")
    assert run.frames == 2000
    assert run.seconds > 0
    assert run.scenes == ["bathroom", "bedroom"]
    assert run.checkpoint == run_folders[1] / "checkpoint.pt"
    assert run.episodes is not None
    assert len(run.episodes) == 176 + 404
    assert run.episodes.max_steps == 20
    assert run.episodes.scene_names == ("bathroom", "bedroom")
    assert int(run.episodes.trained.sum()) == 10
    assert {row["policy"] for row in run.references} == {"random walk", "shortest path"}
    assert all(math.isnan(row["spl"]) for row in run.references if row["policy"] == "random walk")


def test_a_label_of_ones_own(run_folders: list[Path]):
    assert read_run(f"ours={run_folders[0]}").label == "ours"


def test_of_two_evaluations_the_one_of_more_goals(run_folders: list[Path], tmp_path: Path):
    folder = shutil.copytree(run_folders[0], tmp_path / "run")
    for suffix in (".json", "_episodes.csv"):
        shutil.copy(folder / f"evaluation{suffix}", folder / f"zero_shot{suffix}")
    lines = (folder / "evaluation_episodes.csv").read_text().splitlines(keepends=True)
    (folder / "evaluation_episodes.csv").write_text("".join(lines[:11]))
    content = json.loads((folder / "zero_shot.json").read_text())
    content["settings"]["sample"] = False
    (folder / "zero_shot.json").write_text(json.dumps(content))
    run = read_run(folder)
    assert run.episodes is not None
    assert len(run.episodes) == 580
    assert run.variant == "greedy"


def test_episodes_come_back_as_they_were_written(run_folders: list[Path], tmp_path: Path):
    table = read_episodes(run_folders[0] / "evaluation_episodes.csv", 20)
    table.write_csv(tmp_path / "again.csv")
    assert table.equal(read_episodes(tmp_path / "again.csv", 20))
    assert (tmp_path / "again.csv").read_text() == (run_folders[0] / "evaluation_episodes.csv").read_text()


def test_curves_with_gaps(tmp_path: Path):
    (tmp_path / "metrics.csv").write_text("frames,success\n10,\n20,0.5\n")
    curves = read_metrics(tmp_path / "metrics.csv")
    np.testing.assert_array_equal(curves["success"], [np.nan, 0.5])


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("config.json", "{", "config.json: cannot be read"),
        ("config.json", "[]", "holds \\[\\] in place of an object"),
        ("config.json", "{}", "field 'agent.model' is missing"),
        ("metrics.csv", "frames\nmany\n", "row 2 .could not convert string to float: .many."),
        ("evaluation_episodes.csv", "scene,goal\nhall,1\n", "column 'start' is missing"),
        ("evaluation_episodes.csv", "scene,goal\n", "column .start. is missing"),
    ],
)
def test_damaged_files_are_named(run_folders: list[Path], tmp_path: Path, name: str, text: str, message: str):
    folder = shutil.copytree(run_folders[0], tmp_path / "run")
    (folder / name).write_text(text)
    with pytest.raises(ConfigError, match=message) as caught:
        read_run(folder)
    assert str(folder) in str(caught.value)


def test_neither_run_nor_results(tmp_path: Path):
    with pytest.raises(ConfigError, match="holds neither a run"):
        read_source(tmp_path)


@pytest.fixture
def results(run_folders: list[Path], tmp_path: Path) -> Path:
    """An experiment of two cells, with exact chances, and the run of one of them."""
    episodes = read_run(run_folders[0]).episodes
    assert episodes is not None
    every = torch.arange(580)
    exact = ExactGoals(
        (every >= 176).long(),
        torch.where(every < 176, every, every - 176),
        {
            name: torch.full((580,), x)
            for name, x in (("success_100", 0.25), ("success_500", 0.5), ("spl", 0.1))
        },
    )
    for seed in (0, 1):
        info = {
            "row": "vusfa",
            "model": "vusfa",
            "agent_preset": "paper",
            "seed": seed,
            "frames": 7,
            "training_s": 60.0,
        }
        info |= {"checkpoint": "checkpoint-80.pt", "scenes": ["bathroom", "bedroom"]}
        cell = Run("table1", f"vusfa-{seed}", info, {"sampled": episodes, "greedy": episodes}, exact)
        write_run(tmp_path / "results", cell)
    shutil.copytree(run_folders[0], tmp_path / "runs" / "table1" / "vusfa-0")
    shutil.copy(
        run_folders[0] / "checkpoint.pt", tmp_path / "runs" / "table1" / "vusfa-0" / "checkpoint-80.pt"
    )
    return tmp_path / "results" / "table1"


def test_all_cells_of_an_experiment(results: Path):
    first, second = read_source(results, runs=results.parents[1] / "runs")
    assert (first.label, first.seed, second.seed) == ("vusfa (paper)", 0, 1)
    assert first.checkpoint == results.parents[1] / "runs" / "table1" / "vusfa-0" / "checkpoint-80.pt"
    assert second.checkpoint is None
    assert first.curves.keys() >= {"frames", "success"}
    assert not second.curves
    assert (second.frames, second.seconds) == (7, 60)
    assert second.scenes == ["bathroom", "bedroom"]
    assert first.exact is not None
    assert first.exact.metrics["success_100"][0] == 0.25


def test_cells_in_the_papers_order_and_by_seed(results: Path):
    for name, model, seed in (("a", "sfdp", 10), ("b", "sfdp", 9), ("c", "gvf", 0), ("d", "random walk", 0)):
        info = {"model": model, "seed": seed, "scenes": ["bathroom"]}
        write_run(results.parent, Run("table1", name, info, {}))
    found = [(run.label, run.seed) for run in read_source(results)]
    assert found == [
        ("gvf", 0),
        ("sfdp", 9),
        ("sfdp", 10),
        ("vusfa (paper)", 0),
        ("vusfa (paper)", 1),
        ("random walk", 0),
    ]


def test_one_cell_and_its_greedy_episodes(results: Path):
    (run,) = read_source(f"x={results / 'vusfa-1'}", "greedy")
    assert (run.label, run.variant, run.exact) == ("x", "greedy", None)
    with pytest.raises(ConfigError, match="no episodes called 'other'; give sampled or greedy"):
        read_source(results / "vusfa-1", "other")


def test_a_damaged_cell_is_named(results: Path):
    (results / "vusfa-1" / "sampled.npz").write_bytes(b"")
    with pytest.raises(ResultError, match=r"sampled\.npz"):
        read_source(results)
