"""vusfa run and vusfa export."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from typer.testing import CliRunner

from vusfa.cli.app import app
from vusfa.deploy import Navigator, navigator


@pytest.fixture
def vusfa(monkeypatch: pytest.MonkeyPatch, world: Any) -> Callable[..., Any]:
    """Runs a command line; the small network stands for the one that the rooms name."""
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv("NO_COLOR", "1")
    find = navigator.find_backbone
    monkeypatch.setattr(
        navigator, "find_backbone", lambda scenes, given: find(scenes, given or world.backbone)
    )
    return lambda *arguments: CliRunner().invoke(app, list(map(str, arguments)))


@pytest.fixture
def walk(world: Any, tmp_path: Path) -> Path:
    """A folder of the pictures of a walk that ends at the goal, and goes on."""
    folder = tmp_path / "walk"
    folder.mkdir()
    for number, state in enumerate((20, 24, 28, 30, 31)):
        Image.fromarray(world.scenes.pictures(state).numpy()).save(folder / f"{number}.png")
    Image.fromarray(world.scenes.pictures(30).numpy()).save(tmp_path / "goal.jpg", quality=90)
    return folder


def test_run_prints_actions_until_it_arrives(vusfa: Any, world: Any, walk: Path, tmp_path: Path) -> None:
    path = world.checkpoint()
    result = vusfa("run", path, "--goal", tmp_path / "goal.jpg", "--camera", walk, "--greedy")
    assert (result.exit_code, result.stderr) == (0, f"next: vusfa export {path} agent.onnx\n")
    one = Navigator.load(path, sample=False)
    one.goal(tmp_path / "goal.jpg")
    expected = [f"room: attic; arrived from similarity {one.threshold:.2f} on"]
    for number in range(1, 5):
        found = one.act(walk / f"{number - 1}.png")
        action = "arrived" if number == 4 else found.name
        expected.append(f"{number:>4}  {action:<12}  {found.confidence:.2f}  similarity {one.similarity:.2f}")
    assert result.stdout.splitlines() == [*expected, "arrived, with picture 4"]


def test_run_says_that_the_pictures_ended(vusfa: Any, world: Any, walk: Path, tmp_path: Path) -> None:
    (walk / "3.png").unlink()
    arguments = ["run", world.checkpoint(), "--goal", tmp_path / "goal.jpg", "--camera", walk]
    ended, stopped = vusfa(*arguments), vusfa(*arguments, "--max-steps", 2)
    assert ended.stdout.splitlines()[-1] == "not arrived: the pictures ended after 4"
    assert stopped.stdout.splitlines()[-1] == "not arrived in 2"
    assert ended.stderr.startswith("next: a camera whose pictures follow the actions")
    assert stopped.stderr.startswith("next: more max_steps=")


def test_bad_input_of_run_is_one_line(
    vusfa: Any, world: Any, walk: Path, tmp_path: Path, stranger: Any
) -> None:
    path, goal = world.checkpoint(), tmp_path / "goal.jpg"
    Image.fromarray(stranger().numpy()).save(tmp_path / "other.png")
    Image.new("RGB", (64, 64)).save(tmp_path / "square.png")
    for arguments, words in [
        ([tmp_path / "none.pt", "--goal", goal, "--camera", walk], "none.pt: no such checkpoint"),
        (
            ["vusfe", "--goal", goal, "--camera", walk],
            "agent of this name; did you mean 'vusfa'?",
        ),
        (["vusfa-hindsight", "--goal", goal, "--camera", walk], "of this name; there are gvf, sfdp, usfa,"),
        ([tmp_path / "runs", "--goal", goal, "--camera", walk], "runs: no such checkpoint"),
        (
            [path, "--goal", tmp_path / "other.png", "--camera", walk],
            "was not taken in the rooms hall, attic",
        ),
        ([path, "--goal", tmp_path / "square.png", "--camera", walk], "is 64 x 64 pixels"),
        ([path, "--goal", tmp_path / "none.jpg", "--camera", walk], "none.jpg: cannot be read"),
        ([path, "--goal", goal, "--camera", "nowhere"], "camera 'nowhere': no such folder or film"),
        ([path, "--goal", goal, "--camera", "http://127.0.0.1:9/"], "cannot be reached"),
        ([path, "--goal", goal, "--camera", walk, "--scene", "cellar"], "no scene is called 'cellar'"),
        ([path, "--goal", goal, "--camera", walk, "--weights", goal], "name it with --backbone"),
        ([path, "--goal", goal, "--camera", walk, "--backbone", "x"], "no backbone is called 'x'"),
    ]:
        result = vusfa("run", *arguments)
        assert (result.exit_code, result.stdout, result.stderr.count("\n")) == (1, "", 1), arguments
        assert result.stderr.startswith("error: ")
        assert words in result.stderr


def test_export_writes_a_file_and_compares_it(vusfa: Any, world: Any, tmp_path: Path) -> None:
    result = vusfa("export", world.checkpoint("gvf", history=1), tmp_path / "agent.onnx", "--scene", "attic")
    assert (result.exit_code, result.stderr.count("\n")) == (0, 1)
    assert result.stderr.startswith(f"next: python run_onnx.py {tmp_path / 'agent.onnx'} goal.jpg")
    first, second = result.stdout.splitlines()
    assert first == f"{tmp_path / 'agent.onnx'}: 0.1 MB, model gvf"
    assert second.startswith("ONNX Runtime and PyTorch differ by ")
    assert float(second.split()[6]) < 1e-4
    assert second.endswith("over 7 pictures of attic")


@pytest.mark.parametrize("command", ["run", "export"])
def test_help_has_examples(vusfa: Any, command: str) -> None:
    assert f"vusfa {command} run/checkpoint.pt" in vusfa(command, "--help").stdout


def test_export_without_its_packages_names_the_extra(
    vusfa: Any, world: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "onnx", None)
    result = vusfa("export", world.checkpoint(), tmp_path / "agent.onnx")
    assert (result.exit_code, result.stderr) == (1, "error: ONNX needs onnx: pip install 'vusfa[deploy]'\n")
    assert not (tmp_path / "agent.onnx").exists()
