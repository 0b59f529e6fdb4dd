"""recipes/zero_shot.py on checkpoints of all models."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
import torch

from vusfa.envs import resolve_goals
from vusfa.errors import ResultError
from vusfa.experiments.manifest import make_manifest, write_manifest
from vusfa.experiments.runs import read_run
from vusfa.scenes import SceneSet


@pytest.mark.parametrize("model", ["gvf", "usfa", "sfdp", "vusfa"])
def test_every_state_is_a_goal(
    recipe, settings, small, tmp_path: Path, capsys: pytest.CaptureFixture[str], model: str
):
    options = [f"agent.model={model}", "total_frames=48", f"folder={tmp_path / 'run'}"]
    recipe("train").train(settings(*small, *options), options)
    recipe("zero_shot").zero_shot(tmp_path / "run" / "checkpoint.pt", episodes=2, max_steps=30, seed=1)
    printed = capsys.readouterr().out
    for word in (
        "trained goals",
        "unseen goals",
        "all goals",
        model,
        "untrained",
        "random walk",
        "shortest path",
    ):
        assert word in printed
    for suffix in (".csv", ".json", "_episodes.csv"):
        assert f"zero_shot{suffix}" in printed.replace("\n", "")
    with open(tmp_path / "run" / "zero_shot_episodes.csv", newline="") as file:
        episodes = list(csv.DictReader(file))
    assert len(episodes) == 16 * 2
    assert {row["goal"] for row in episodes if row["trained"] == "1"} == {"3", "9", "12"}
    read = json.loads((tmp_path / "run" / "zero_shot.json").read_text())
    assert read["settings"]["max_steps"] == 30
    assert read["note"] == "Every goal can be reached from every start."
    success = {(row["policy"], row["goals"]): row["success_30"] for row in read["rows"]}
    assert success["shortest path", "all"] == 1.0
    assert success["random walk", "all"] < success["shortest path", "all"]
    assert success[model, "all"] != success["untrained", "all"] or model == "gvf"


def test_same_seed_same_table(recipe, settings, small, tmp_path: Path):
    recipe("train").train(settings(*small, "total_frames=48", f"folder={tmp_path}"), [])
    found = []
    for name in ("one", "two"):
        torch.manual_seed(len(found))
        recipe("zero_shot").zero_shot(
            tmp_path / "checkpoint.pt", episodes=1, max_steps=20, out=tmp_path / name
        )
        found.append([(tmp_path / f"{name}{suffix}").read_text() for suffix in (".csv", "_episodes.csv")])
    assert found[0] == found[1]


def test_the_episodes_of_a_manifest(recipe, tmp_path: Path):
    """Those of recipes/table1.py, number for number."""
    options = [
        "agent.model=vusfa", "agent.hidden_size=8", "agent.embedding_size=8", "agent.history=1",
        "scenes=[bathroom]", "total_frames=32", "collector.num_envs=8", "collector.rollout=4",
    ]  # fmt: skip
    rooms = SceneSet.bundled(["bathroom"])
    drawn = make_manifest(rooms, resolve_goals(rooms, "paper"), episodes_per_goal=2, validation_goals=3)
    manifest = write_manifest(tmp_path / "episodes.npz", drawn)
    results, runs = tmp_path / "results", tmp_path / "runs"
    recipe("table1").table1(
        options, models=["vusfa"], seeds=[0], stages=[1.0], results=results, runs=runs, manifest=manifest
    )
    checkpoint = runs / "table1" / "vusfa-0" / "checkpoint-100.pt"
    recipe("zero_shot").zero_shot(checkpoint, manifest=str(manifest), seed=5)
    table = read_run(results, "table1", "vusfa-0").episodes["sampled"]
    with open(checkpoint.with_name("zero_shot_episodes.csv"), newline="") as file:
        assert list(csv.DictReader(file)) == [
            {key: str(int(value) if isinstance(value, bool) else value) for key, value in row.items()}
            for row in table.rows()
        ]
    settings = json.loads(checkpoint.with_name("zero_shot.json").read_text())["settings"]
    assert settings["manifest"] == str(manifest)
    assert len(settings["goals"]) == 176 - 3
    with pytest.raises(ResultError, match="of other scenes"):
        recipe("zero_shot").zero_shot(checkpoint, manifest="bundled")


def test_as_a_command(tmp_path: Path, program):
    done = program("recipes/zero_shot.py", "none.pt", folder=tmp_path)
    assert done.returncode == 1
    assert done.stderr.startswith("error: none.pt: no such checkpoint")
    assert done.stderr.count("\n") == 1
