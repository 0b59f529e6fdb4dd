"""One grammar for all commands: name=value, names of scenes, --force, help with examples."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from vusfa.cli import FUNCTIONS
from vusfa.cli.app import app
from vusfa.cli.functions import App, Command
from vusfa.deploy import load_pretrained
from vusfa.scenes import Scene
from vusfa.scenes.store import bundled_path

Run = Callable[..., Any]
calls: list[dict[str, Any]] = []
small = App(add_completion=False)


@small.command("walk")
def walk(
    words: list[str],
    max_steps: int = typer.Option(5),
    seeds: list[int] = typer.Option([0]),  # noqa: B008
    greedy: bool = typer.Option(False, "--greedy"),
    crop: bool = typer.Option(True, "--crop/--no-crop"),
    out: str = typer.Option("a", "--out", "-o", "--output"),
) -> None:
    calls.append(locals().copy())


@small.command("other")
def other() -> None: ...


@pytest.mark.parametrize(
    ("line", "changed"),
    [
        ("max_steps=7", {"max_steps": 7}),
        ("max-steps=7", {"words": ["x", "max-steps=7"]}),  # no name of a setting: a word as any other
        ("--max-steps 7", {"max_steps": 7}),
        ("--max-steps=7 y", {"max_steps": 7, "words": ["x", "y"]}),
        ("seeds=[3,4]", {"seeds": [3, 4]}),
        ("seeds=3,4 y", {"seeds": [3, 4], "words": ["x", "y"]}),
        ("--seeds 3 4 out=b", {"seeds": [3, 4], "out": "b"}),
        ("--seeds 3 4 --greedy y", {"seeds": [3, 4], "greedy": True, "words": ["x", "y"]}),
        ("greedy=true crop=false", {"greedy": True, "crop": False}),
        ("greedy=false crop=True", {}),
        ("-o out=b", {"out": "out=b"}),  # the value of an option
        ("--out b=c y", {"out": "b=c", "words": ["x", "y"]}),
        ("output=b", {"out": "b"}),
        ("out=", {"out": ""}),
        ("agent.model=gvf", {"words": ["x", "agent.model=gvf"]}),
        ("-- out=b --greedy", {"words": ["x", "out=b", "--greedy"]}),
    ],
)
def test_options_are_written_as_settings(line: str, changed: dict[str, Any]) -> None:
    done = CliRunner().invoke(small, ["walk", "x", *line.split()])
    assert done.exit_code == 0, done.output
    default = {"words": ["x"], "max_steps": 5, "seeds": [0], "greedy": False, "crop": True, "out": "a"}
    assert calls.pop() == {**default, **changed}


@pytest.mark.parametrize("word", ["max_steps=many", "greedy=perhaps", "seeds=[1,x]"])
def test_values_that_do_not_fit_are_errors(word: str) -> None:
    assert CliRunner().invoke(small, ["walk", "x", word]).exit_code == 2
    assert not calls


def commands(group: Any, path: tuple[str, ...] = ("vusfa",)) -> dict[tuple[str, ...], Any]:
    found: dict[tuple[str, ...], Any] = {}
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            found |= commands(command, (*path, name))
        else:
            found[*path, name] = command
    return found


ALL = commands(typer.main.get_command(app))


@pytest.mark.parametrize("path", ALL, ids=" ".join)
def test_every_command_has_the_grammar_and_examples(path: tuple[str, ...]) -> None:
    command = ALL[path]
    assert isinstance(command, Command)
    if path[1:] == ("train",):  # Hydra's help: tests/cli/test_train.py
        return
    if path[1] in FUNCTIONS:
        assert all(line.startswith(" ".join(path)) for line in FUNCTIONS[path[1]].examples)
        assert FUNCTIONS[path[1]].examples
    else:
        assert " ".join(path) in command.help.partition("Examples:")[2]


@pytest.mark.parametrize("line", [["evaluate", "-h"], ["transfer", "run", "--help"], ["transfer"]])
def test_help_of_a_function_shows_its_examples(line: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    text = CliRunner().invoke(app, line).output
    assert "Usage: vusfa" in text or "Usage: root" in text
    if line != ["transfer"]:
        assert f"vusfa {line[0]} " in text.partition("Examples:")[2]
        assert "vusfa transfer show" not in text.partition("Examples:")[2]


def test_the_program_begins_with_first_steps() -> None:
    text = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "120"}).output
    assert "vusfa train preset=replay_search" in text.partition("First steps:")[2]


@pytest.mark.parametrize("word", ["--seed", "--preset=replay_search", "--total-frames"])
def test_train_says_how_settings_are_written(word: str) -> None:
    done = CliRunner().invoke(app, ["train", word])
    assert done.exit_code == 2
    name, _, value = word.removeprefix("--").replace("-", "_").partition("=")
    assert done.stderr == f"error: {word}: settings are written without dashes, {name}={value or 'VALUE'}\n"


def test_names_that_one_command_takes_all_take(run: Run, tmp_path: Path) -> None:
    assert run("check", "bathroom").stdout.endswith("bathroom.h5: sound\n")
    assert run("compact", "bathroom", tmp_path / "small.h5").exit_code == 0
    assert Scene.load(tmp_path / "small.h5").num_states == 176
    assert run("compact", f"out={tmp_path / 'other.h5'}", tmp_path / "small.h5").exit_code == 0
    assert Scene.load(tmp_path / "other.h5").num_states == 176
    assert "exists" in run("compact", "bathroom", f"target={tmp_path / 'other.h5'}").stderr
    done = run("render", "plan=bathroom", "plan_only=true", f"out={tmp_path / 'plan.yaml'}")
    assert done.exit_code == 0, done.stderr
    assert "176 states" in done.stdout


@pytest.mark.parametrize("command", [["check"], ["compact", "x.h5"], ["encode", "x.h5"], ["show"], ["list"]])
def test_a_name_that_means_nothing_is_one_line(
    run: Run, command: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    done = run(command[0], "attic", *command[1:])
    assert done.exit_code == 1
    assert done.stderr.startswith("error: 'attic' is neither a bundled scene (bathroom, ")
    assert done.stderr.count("\n") == 1


def test_check_looks_into_folders(run: Run, tmp_path: Path, scene_file: Path) -> None:
    done = run("check", scene_file.parent)
    assert (done.exit_code, done.stdout) == (0, f"{scene_file}: sound\n")
    (tmp_path / "empty").mkdir()
    assert "there are no scene files" in run("check", tmp_path / "empty").stderr


WRITING = {
    "encode": ["scenes", "encode", "bathroom", "TARGET"],
    "compact": ["scenes", "compact", "bathroom", "TARGET"],
    "export-thor": ["scenes", "export-thor", "FloorPlan1", "TARGET"],
    "export-miniworld": ["scenes", "export-miniworld", "MiniWorld-OneRoom-v0", "TARGET"],
    "render": ["scenes", "render", "plan=bathroom", "--out", "TARGET"],
    "export": ["export", "vusfa", "TARGET"],
}


@pytest.mark.parametrize("name", WRITING)
def test_what_was_made_is_replaced_only_when_asked(name: str, tmp_path: Path) -> None:
    target = tmp_path / "precious"
    target.write_bytes(b"precious")
    line = [str(target) if word == "TARGET" else word for word in WRITING[name]]
    done = CliRunner().invoke(app, line)
    said = f"error: {target}: exists; choose another name, or replace it with --force\n"
    assert (done.exit_code, done.stderr) == (1, said)
    assert target.read_bytes() == b"precious"
    done = CliRunner().invoke(app, [str(tmp_path) if word == "TARGET" else word for word in WRITING[name]])
    assert done.stderr == f"error: {tmp_path}: is a folder; name the file to write\n"


def test_force_replaces(run: Run, tmp_path: Path) -> None:
    target = tmp_path / "room.h5"
    target.write_bytes(b"old")
    assert run("compact", "bathroom", target, "force=true").exit_code == 0
    assert target.stat().st_size == pytest.approx(bundled_path("bathroom").stat().st_size, rel=0.05)


def test_a_folder_that_cannot_be_written_is_named_before_the_work(run: Run, scene_file: Path) -> None:
    done = run("encode", "bathroom", scene_file / "new.h5")
    assert done.exit_code == 1
    assert f"but {scene_file} is not a folder" in done.stderr
    assert done.stderr.count("\n") == 1


def test_film_writes_a_walk(tmp_path: Path) -> None:
    from PIL import Image

    target = tmp_path / "walk.gif"
    done = CliRunner().invoke(app, ["film", "vusfa", f"out={target}", "scale=1", "scene=kitchen", "start=0"])
    assert done.exit_code == 0, done.output
    goal = int(done.stdout.partition("to ")[2].partition(",")[0])
    assert done.stdout.startswith(f"{target}: kitchen, from state 0 to {goal}, reached in ")
    steps = int(done.stdout.partition("reached in ")[2].split()[0])
    agent = load_pretrained("vusfa")
    assert int(agent.scenes.global_id("kitchen", goal)) in agent.goals.tolist()
    with Image.open(target) as film:
        assert film.n_frames == steps + 1
    assert steps >= int(Scene.bundled("kitchen").distance[0, goal]) > 10


@pytest.mark.parametrize(
    ("word", "fault"),
    [
        ("scene=attic", "no scene is called 'attic'"),
        ("goal=100000", "scene 'bathroom' has no state 100000"),
        ("start=-1", "scene 'bathroom' has no state -1"),
    ],
)
def test_film_of_what_is_not_there(word: str, fault: str, tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["film", "gvf", f"out={tmp_path / 'a.gif'}", word])
    assert (done.exit_code, done.stderr.count("\n")) == (1, 1), done.output
    assert done.stderr.startswith(f"error: {fault}")
    assert not (tmp_path / "a.gif").exists()


@pytest.mark.parametrize(
    ("command", "word", "fault"),
    [
        ("table1", "seed=x", "seed"),
        ("table1", "agent.modle=gvf", "no setting is called 'agent.modle'"),
        ("table1", "optim=sgd", "optim=sgd"),
        ("generalise", "agent.modle=gvf", "no setting is called 'agent.modle'"),
        ("generalise", "optim=sgd", "optim=sgd"),
    ],
)
def test_a_wrong_setting_of_an_experiment_is_one_line(
    command: str, word: str, fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(40):
        (tmp_path / f"room-{number}.h5").symlink_to(bundled_path("bathroom"))
    monkeypatch.chdir(tmp_path)
    line = [command, *([str(tmp_path)] if command == "generalise" else []), word]
    done = CliRunner().invoke(app, line)
    assert done.exit_code in (1, 2), done.output
    assert done.stderr.startswith("error: ")
    assert fault in done.stderr
    assert done.stderr.count("\n") == 1
