"""What used to be found only after the training, or ended in a traceback, is one line before any work."""

from __future__ import annotations

import csv
import signal
from pathlib import Path

import pytest
import torch

from vusfa.cli.launch import launch
from vusfa.conf import FOLDER as CONF
from vusfa.errors import CheckpointError, ConfigError, GoalError
from vusfa.evaluation import check_comparison
from vusfa.files import check_folder
from vusfa.scenes import Scene, SceneSet
from vusfa.training import load_checkpoint, make_loggers

RECIPES = Path(__file__).parents[2] / "recipes"


@pytest.fixture
def work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder to stand in."""
    folder = tmp_path / "work"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


@pytest.fixture
def run(recipe, work: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]):
    """A recipe's command line; gives exit code and standard error."""

    def launched(name: str, *arguments: str) -> tuple[int, str]:
        monkeypatch.setattr("sys.argv", [f"{name}.py", *arguments])
        module = recipe(name)
        with pytest.raises(SystemExit) as end:
            launch(module.main if name == "train" else module.demo, CONF, name)
        return end.value.code, capfd.readouterr().err

    return launched


@pytest.mark.parametrize(
    ("argument", "words"),
    [
        ("evaluation.goals=foo", "evaluation: goals are 'foo'; give 'paper', 'all'"),
        ("evaluation.goals=[99]", "evaluation: goal 99 is out of range"),
        ("evaluation.episodes_per_goal=0", "evaluation: episodes_per_goal is 0; it must be 1 or more"),
        ("evaluation.max_steps=0", "evaluation: max_steps is 0; it must be 1 or more"),
        ("evaluation.max_steps=1000000000", "evaluation: max_steps is 1000000000; give at most 100,000"),
        ("evaluation.interval=0", "evaluation.interval is 0; it must be auto, a number of frames such as"),
        ("evaluation.interval=often", "evaluation.interval is 'often'; it must be auto"),
        ("evaluation.interval=0.05", "evaluation.interval is 0.05; it must be auto"),
        ("lazy_scenes=on", "lazy_scenes is 'on'; it must be auto, true or false"),
        ("lazy_scenes=1", "lazy_scenes is 1; it must be auto, true or false"),
        ("lazy_scenes=null", "lazy_scenes is null; it must be auto, true or false"),
        ("env.goals=[paper]", "goals: ['paper'] are no state ids; give integers"),
        ("env.goals=[3,true]", "goals: [3, True] are no state ids"),
        ("env.goals={hall:[a]}", "scene 'hall': ['a'] are no state ids"),
        ("env.goals={hall:3}", "scene 'hall' has 3; give a list of state ids"),
        ("env.goals={hall:[1.5]}", "scene 'hall' has [1.5]; give a list of state ids"),
        ("env.goals={hall:null}", "scene 'hall': None are no state ids"),
        ("resume=/etc/passwd", "/etc/passwd: not a whole checkpoint"),
        ("folder=/etc/passwd", "folder is '/etc/passwd', but /etc/passwd is not a folder"),
        ("folder=/etc/passwd/run", "folder is '/etc/passwd/run', but /etc/passwd is not a folder"),
        ("logger=wandb logger.mode=foo", "logger.mode is 'foo'; it must be one of online, offline, disabled"),
    ],
)
def test_refused_before_the_training(run, small, work: Path, argument: str, words: str):
    keys = {item.partition("=")[0] for item in argument.split()}
    kept = [item for item in small if item != "evaluation=none" and item.partition("=")[0] not in keys]
    code, text = run("train", *kept, *argument.split())
    assert (code, text.count("\n")) == (2, 1), text
    assert text.startswith("error: ")
    assert words in text
    assert list(work.rglob("*")) == []


def test_a_training_shorter_than_a_line_of_the_log(run, small, work: Path):
    small.remove("evaluation=none")
    more = ["total_frames=24", "evaluation.episodes_per_goal=1", "evaluation.max_steps=20", "folder=run"]
    code, text = run("demo", *small, *more)
    assert code == 0, text
    with open(work / "run" / "metrics.csv", newline="") as file:
        assert [row["frames"] for row in csv.DictReader(file)] == ["24"]
    assert (work / "run" / "curve.png").is_file()


def test_train_goes_on_with_what_demo_began(run, small, work: Path):
    demo = [*small, "total_frames=48", "folder=demo"]
    assert run("demo", *demo)[0] == 0
    path = work / "demo" / "checkpoint.pt"
    for frames in (96, 144):  # what is resumed can be resumed
        code, text = run("train", f"resume={path}", f"total_frames={frames}")
        assert code == 0, text
        state = load_checkpoint(path)
        assert (state["frames"], state["config"]["log_every"]) == (frames, 48)


def test_train_takes_the_scenes_of_an_older_demo(run, work: Path):
    """One that does not say of which recipe it is."""
    small = ["agent.hidden_size=8", "agent.embedding_size=8", "evaluation=none", "collector.num_envs=5"]
    small += ["agent.history=2", "collector.rollout=4"]
    assert run("demo", *small, "total_frames=20")[0] == 0
    path = work / "demo" / "checkpoint.pt"
    state = load_checkpoint(path)
    state["overrides"] = [item for item in state["overrides"] if not item.startswith("--")]
    torch.save(state, path)
    code, text = run("train", f"resume={path}", "total_frames=40")
    assert code == 0, text
    assert load_checkpoint(path)["scenes"]["names"] == ["bathroom"]


def test_scenes_are_found_from_another_folder(
    run, small, work: Path, scene_file: Path, monkeypatch: pytest.MonkeyPatch
):
    home = work / "it's home"
    home.mkdir()
    scene_file.rename(home / "hall.h5")
    monkeypatch.chdir(home)
    code, text = run("train", "scenes=[hall.h5]", *small[1:], "total_frames=48", "folder=run")
    assert code == 0, text
    monkeypatch.chdir(work)
    code, text = run("train", *_resume(home / "run" / "checkpoint.pt"), "total_frames=96")
    assert code == 0, text
    assert "resumed with scenes" not in text
    assert load_checkpoint(home / "run" / "checkpoint.pt")["frames"] == 96


def _resume(path: Path) -> list[str]:
    link = Path("run.pt")  # Hydra wants an apostrophe quoted, and the folder is the file's
    link.symlink_to(path)
    return [f"resume={link}", "folder='" + str(path.parent).replace("'", r"\'") + "'"]


@pytest.mark.filterwarnings("default")  # wandb's own
def test_wandb_without_a_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("NETRC", str(tmp_path / "none"))
    monkeypatch.setenv("WANDB_DATA_DIR", str(tmp_path / "data"))
    monkeypatch.delenv("WANDB_API_KEY", raising=False)
    run = tmp_path / "runs" / "deep" / "run"
    with pytest.raises(ConfigError, match=r"wandb cannot begin .*logger\.mode=offline"):
        make_loggers(["csv", "tensorboard", "wandb"], run, {}, run_id="a")
    assert not (tmp_path / "runs").exists()
    run.mkdir(parents=True)
    (run / "mine.txt").touch()
    with pytest.raises(ConfigError):
        make_loggers(["wandb"], run, {}, run_id="a")
    assert [path.name for path in run.iterdir()] == ["mine.txt"]


def test_zero_shot_looks_first_where_to_write(recipe, tmp_path: Path):
    zero_shot = recipe("zero_shot").zero_shot
    with pytest.raises(ConfigError, match="but /etc/passwd is not a folder"):
        zero_shot(tmp_path / "none.pt", out=Path("/etc/passwd/x"))
    with pytest.raises(CheckpointError, match="/etc/passwd: not a whole checkpoint"):
        zero_shot(Path("/etc/passwd"), out=tmp_path / "x")


def test_zero_shot_interrupted(recipe, settings, small, tmp_path: Path, program):
    recipe("train").train(settings(*small, "total_frames=24", f"folder={tmp_path / 'run'}"), [])
    code = """
import vusfa.evaluation.comparison
from vusfa.cli.functions import run_functions
def interrupt(*_, **__): raise KeyboardInterrupt
vusfa.evaluation.comparison.evaluate = interrupt
from zero_shot import zero_shot
run_functions(zero_shot)
"""
    path = tmp_path / "run" / "checkpoint.pt"
    done = program("recipes/zero_shot.py", path, folder=tmp_path, code=code)
    assert done.returncode == 128 + signal.SIGINT
    assert done.stderr.splitlines()[-1] == "error: interrupted; nothing has been written"
    assert "Traceback" not in done.stderr
    assert not list((tmp_path / "run").glob("zero_shot*"))


def test_a_folder_must_be_one(tmp_path: Path):
    assert check_folder(tmp_path / "a" / "b", "folder") == tmp_path / "a" / "b"
    (tmp_path / "lost").symlink_to(tmp_path / "nowhere")
    with pytest.raises(ConfigError, match="lost is not a folder"):
        check_folder(tmp_path / "lost" / "b", "folder")
    with pytest.raises(ConfigError, match="folder is None"):
        check_folder(None, "folder")  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == [tmp_path / "lost"]


def test_goals_that_nothing_can_reach_are_refused(make_scene):
    trap = SceneSet([Scene("trap", torch.tensor([[1, -1], [0, -1], [0, -1]]), torch.rand(3, 1, 4))])
    with pytest.raises(GoalError, match="evaluation: none of the 1 goals can be reached"):
        check_comparison(trap, [2])
    before = torch.get_rng_state()
    check_comparison(SceneSet([make_scene("hall")]), "all", episodes_per_goal=3, max_steps=2)
    assert torch.equal(before, torch.get_rng_state())  # a training's numbers stay as they were
