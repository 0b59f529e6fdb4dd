"""What people really have: damaged, foreign and moved files, and runs that are not seeds of one thing."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from vusfa.errors import CheckpointError, ConfigError, ResultError, SceneError, VusfaError
from vusfa.evaluation import Episodes
from vusfa.experiments.runs import Run, write_run
from vusfa.report import Options, read_run, read_source, write_report
from vusfa.report.command import report_runs
from vusfa.report.content import gather
from vusfa.report.experiment import read_experiment
from vusfa.report.grouping import separate_runs
from vusfa.report.run_scenes import open_scenes
from vusfa.report.runs import LoggedRun
from vusfa.scenes import Scene, SceneSet
from vusfa.training import load_agent
from vusfa.training.checkpoint import save_checkpoint

SETTINGS = {"agent": {"model": "gvf"}, "seed": 0, "scenes": ["hall.h5"], "env": {"goals": "paper"}}


@pytest.fixture
def room(tmp_path: Path, make_scene: Callable[..., Scene]) -> Scene:
    scene = make_scene("hall", 3, 2)
    scene.save(tmp_path / "hall.h5")
    return scene


@pytest.fixture
def folder(tmp_path: Path, room: Scene) -> Path:
    """A run's folder written by hand: settings, a log, an evaluation of every goal from state 0."""
    made = tmp_path / "run"
    made.mkdir()
    settings = {**SETTINGS, "scenes": [str(tmp_path / "hall.h5")]}
    (made / "config.json").write_text(json.dumps(settings))
    (made / "metrics.csv").write_text("frames,success\n10,0.5\n20,0.75\n")
    rows = [{"policy": "gvf", "goals": "all", "scene": "hall", "success_500": 1.0}]
    content = {"settings": {"max_steps": 500, "sample": True}, "rows": rows}
    (made / "evaluation.json").write_text(json.dumps(content))
    goal = torch.arange(1, room.num_states)
    zero, way = torch.zeros_like(goal), room.distance[0, 1:].long()
    table = Episodes(zero, goal, zero, goal > 0, way, way, zero, goal == 3, ("hall",), 500)
    table.write_csv(made / "evaluation_episodes.csv")
    return made


def test_the_folder_is_sound(folder: Path) -> None:
    content, tables = gather([read_run(folder)])
    assert [model["label"] for model in content["models"]] == ["gvf"]
    assert tables["runs"][0]["scenes"] == "hall"


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("config.json", b"{"),
        ("config.json", b"\xff\xfe{\x00}\x00"),
        ("config.json", b'{"architectures": ["BertModel"], "hidden_size": 768}'),
        ("config.json", b'{"agent": "vusfa"}'),
        ("config.json", b'{"agent": {"model": 5}}'),
        ("config.json", b'{"agent": {"model": "gvf", "history": "four"}}'),
        ("config.json", b'{"agent": {"model": "gvf"}, "seed": "one"}'),
        ("config.json", b'{"agent": {"model": "gvf"}, "scenes": {"hall": 1}}'),
        ("config.json", b'{"agent": {"model": "gvf"}, "scenes": [1]}'),
        ("config.json", b'{"agent": {"model": "gvf"}, "env": []}'),
        ("config.json", b'{"agent": {"model": "gvf"}, "algorithm": 3}'),
        ("config.json", b'{"agent": {"model": "gvf"}, "hindsight": "yes"}'),
        ("metrics.csv", "frames,Erfolg\n10,\u00fc\n".encode("latin-1")),
        ("metrics.csv", "frames,success\n10,1\n".encode("utf-16")),
        ("metrics.csv", b"frames,success\n10,\x00\n"),
        ("evaluation.json", b'{"rows": 5}'),
        ("evaluation.json", b'{"rows": ["gvf"]}'),
        ("evaluation.json", b'{"rows": [{"policy": "gvf", "goals": "all", "scene": "hall", "spl": "high"}]}'),
        ("evaluation.json", b'{"settings": {"max_steps": "many"}}'),
        ("evaluation.json", b'{"settings": {"max_steps": true}}'),
        ("evaluation.json", b'{"settings": {"max_steps": 1000000000000}}'),
        ("evaluation.json", b'{"settings": {"max_steps": 0}}'),
        ("evaluation.json", b'{"settings": {"max_steps": -1}}'),
        ("config.json", rb'{"agent": {"model": "\ud800"}}'),
        ("config.json", rb'{"agent": {"model": "gvf"}, "\uDFFF": 1}'),
        ("metrics.csv", b"frames,success\ninf,1\n"),
        ("metrics.csv", b"frames,success\n10,1\n1e400,1\n"),
        ("metrics.csv", b"frames,seconds\n10,-inf\n"),
        ("evaluation_episodes.csv", b""),
        ("evaluation_episodes.csv", b"\xe9,goal\n"),
    ],
)
def test_a_damaged_or_foreign_file_is_named(folder: Path, name: str, text: bytes) -> None:
    (folder / name).write_bytes(text)
    with pytest.raises(ConfigError, match=name) as caught:
        gather([read_run(folder)])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new"), [("hall,1,", "attic,1,"), ("hall,1,", "hall,99,"), ("hall,1,0,1,1,1,", "hall,1,0,1,7,7,")]
)
def test_episodes_of_another_scene(folder: Path, old: str, new: str) -> None:
    table = folder / "evaluation_episodes.csv"
    assert old in table.read_text()
    table.write_text(table.read_text().replace(old, new, 1))
    with pytest.raises(ConfigError, match=r"run: its episodes in '(attic|hall)' are of another scene"):
        gather([read_run(folder)])


def test_scenes_that_have_moved_and_pairs_of_surrogates(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "hall.h5").rename(tmp_path / "away.h5")
    with pytest.raises(SceneError, match=r"hall\.h5: there is no such file; .*/run have moved, put them"):
        gather([read_run(folder)])
    settings = {**SETTINGS, "scenes": [str(tmp_path / "away.h5")], "name": "\U0001f600"}
    (folder / "config.json").write_text(json.dumps(settings))  # written as a pair, which is a character
    assert read_run(folder).settings["name"] == "\U0001f600"


@pytest.mark.parametrize("wrong", [float("nan"), float("inf")])
def test_a_checkpoint_with_weights_that_are_no_numbers(
    run_folders: list[Path], tmp_path: Path, wrong: float
) -> None:
    run = shutil.copytree(run_folders[2], tmp_path / "run")
    state = torch.load(run / "checkpoint.pt", weights_only=True)
    next(iter(state["agent"].values())).view(-1)[0] = wrong
    torch.save(state, run / "checkpoint.pt")
    with pytest.raises(CheckpointError, match=r"checkpoint\.pt"):
        gather([read_run(run)])


@pytest.mark.parametrize("goal", [-1, 580, 10**9])
def test_a_checkpoint_with_goals_beyond_its_scenes(
    run_folders: list[Path], tmp_path: Path, goal: int
) -> None:
    state = torch.load(run_folders[2] / "checkpoint.pt", weights_only=True)
    state["goals"][0] = goal
    torch.save(state, tmp_path / "a.pt")
    with pytest.raises(CheckpointError, match=r"a\.pt: its entry 'goals' names states beyond the 580"):
        load_agent(tmp_path / "a.pt")


def logged(label: str, seed: int, frames: float = 100.0, **settings: Any) -> LoggedRun:
    log = {"frames": np.array([0.0, frames]), "success": np.array([0.0, 1.0])}
    return LoggedRun(label, seed, Path(f"{label}-{seed}"), {"seed": seed, **settings}, log)


@pytest.mark.parametrize(
    ("runs", "labels"),
    [
        ([logged("a", 0, total_frames=5), logged("a", 1, total_frames=5)], ["a", "a"]),
        ([logged("a", 0, folder="x"), logged("a", 1, folder="y", device="cuda")], ["a", "a"]),
        (
            [
                logged("a", 0, overrides=["preset=fast"]),
                logged("a", 1, overrides=["preset=fast", "optim.lr=1"]),
            ],
            ["a, optim.lr=default", "a, optim.lr=1"],
        ),
        ([logged("a", 0, overrides=["preset=fast"]), logged("a", 1)], ["a", "a"]),
        ([logged("a", 0), logged("a", 1, scenes=["rooms/x.h5"])], ["a, scenes=[]", "a, scenes=['x']"]),
        (
            [logged("a", 0, optim={"lr": 0.1}), logged("b", 0), logged("a", 1, optim={"lr": 0.2})],
            ["a, optim.lr=0.1", "b", "a, optim.lr=0.2"],
        ),
        (
            [logged("a", 0), logged("a", 1, 99.5), logged("a", 2, 40)],
            ["a, frames=100"] * 2 + ["a, frames=40"],
        ),
        (
            [logged("a", i, x=1, y=2, z=i % 2) for i in range(3)] + [logged("a", 4, x=3, y=4, z=5)],
            ["a, x=1, y=2 (1)", "a, x=1, y=2 (2)", "a, x=1, y=2 (1)", "a, x=3, y=4 (3)"],
        ),
    ],
)
def test_unlike_runs_are_not_pooled(runs: list[LoggedRun], labels: list[str]) -> None:
    found, notes = separate_runs(runs)
    assert [run.label for run in found] == labels
    assert bool(notes) == (labels != [run.label for run in runs])


def test_evaluations_of_other_goals_are_not_pooled(folder: Path) -> None:
    run = read_run(folder)
    assert run.episodes is not None
    less = dataclasses.replace(run, episodes=run.episodes.select(run.episodes.goal < 9))
    lines: list[str] = []
    content, tables = gather([run, less], Options(tell=lines.append))
    assert [(row["model"], row["seeds"]) for row in tables["summary"] if row["goals"] == "all"][:2] == [
        ("gvf, evaluated goals=23", 1),
        ("gvf, evaluated goals=8", 1),
    ]
    (note,) = content["notes"]
    assert note == "Runs of gvf differ in evaluated goals; each kind is shown apart."
    assert note in lines


def test_two_experiments_are_not_seeds(folder: Path, room: Scene, tmp_path: Path) -> None:
    table = read_run(folder).episodes
    assert table is not None
    for experiment in ("a", "b"):
        write_run(tmp_path, Run(experiment, "gvf-0", {"model": "gvf", "seed": 0}, {"sampled": table}))
    with pytest.raises(ResultError, match=r"a/gvf-0 and b/gvf-0 are both seed 0 of gvf; show .* apart"):
        read_experiment(tmp_path, ["a", "b"], SceneSet([room]))


@pytest.mark.parametrize("fact", [{"seed": "one"}, {"model": ["gvf"]}, {"overrides": "seed=0"}])
def test_results_with_facts_of_another_type(tmp_path: Path, fact: dict[str, Any]) -> None:
    folder = write_run(tmp_path, Run("a", "gvf-0", {"model": "gvf", **fact}, {}))
    with pytest.raises(ResultError, match=rf"cell\.json: field '{next(iter(fact))}'"):
        read_source(folder)


def test_a_sweep_given_by_its_folder_or_by_a_star(folder: Path, tmp_path: Path) -> None:
    sweep = tmp_path / "sweep"
    for seed in (0, 1):
        shutil.copytree(folder, sweep / str(seed))
    (sweep / "multirun.yaml").write_text("hydra: {}")
    starred = [run for path in sorted(sweep.iterdir()) for run in read_source(path)]
    assert [run.folder.name for run in starred] == ["0", "1"]
    assert [run.folder.name for run in read_source(sweep)] == ["0", "1"]
    assert [run.label for run in read_source(f"ours={sweep}")] == ["ours", "ours"]
    (tmp_path / "other.yaml").write_text("a: 1")
    with pytest.raises(ConfigError, match=r"other\.yaml is not a folder"):
        read_source(tmp_path / "other.yaml")


@pytest.fixture
def moved(
    train_run: Callable[[Path, list[str]], Path], tmp_path: Path, make_scene: Callable[..., Scene]
) -> Path:
    """A run whose scene is no longer where it was: it lies in ``elsewhere``."""
    (tmp_path / "rooms").mkdir()
    make_scene("hall", 3, 2).save(tmp_path / "rooms" / "hall.h5")
    scenes = [f"scenes=[{tmp_path / 'rooms/hall.h5'}]", "env.goals=random:2", "agent.model=gvf"]
    run = train_run(tmp_path / "runs" / "a", [*scenes, "total_frames=200", "log_every=100"])
    (tmp_path / "rooms").rename(tmp_path / "elsewhere")
    return run


def test_a_scene_that_has_moved(moved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(VusfaError, match=r"hall\.h5.*have moved, put them beside it or give them as scenes"):
        load_agent(moved / "checkpoint.pt")
    room = tmp_path / "elsewhere" / "hall.h5"
    assert load_agent(moved / "checkpoint.pt", SceneSet.open([room]))[1].names == ("hall",)
    report_runs([str(moved)], out=tmp_path / "page.html", scenes=[str(room)], walks=1, goals_per_scene=2)
    # a page tells no absolute path of its author's machine
    text = (tmp_path / "page.html").read_text()
    assert str(tmp_path) not in text
    assert "vusfa report .../a --out .../page.html" in text
    shutil.copy(room, moved / "hall.h5")
    assert load_agent(moved / "checkpoint.pt")[1].names == ("hall",)
    # another room of that name, in the present folder or beside the checkpoint, is not taken for it
    other = Scene.open(room)
    Scene("hall", other.graph.flip(1), other.features, other.location, other.rotation).save(moved / "hall.h5")
    monkeypatch.chdir(moved)
    with pytest.raises(CheckpointError, match="have changed since"):
        open_scenes([read_run(moved)])


def test_scenes_move_with_their_checkpoint(moved: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").rename(tmp_path / "rooms")
    state = torch.load(moved / "checkpoint.pt", weights_only=True)
    assert state["scenes"]["sources"] == ["../../rooms/hall.h5"]
    (tmp_path / "there").mkdir()
    for part in ("rooms", "runs"):
        (tmp_path / part).rename(tmp_path / "there" / part)
    assert load_agent(tmp_path / "there/runs/a/checkpoint.pt")[1].names == ("hall",)
    # as version 0.1 and before wrote it
    state["scenes"]["sources"] = [str(tmp_path / "there/rooms/hall.h5")]
    del state["format"]
    old = save_checkpoint(tmp_path / "old.pt", state)
    assert load_agent(old)[1].names == ("hall",)
    assert write_report([read_run(tmp_path / "there/runs/a")], tmp_path / "page.html")[0]
