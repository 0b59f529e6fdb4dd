"""vusfa scenes export-miniworld, with the simulator itself where it is not said to be missing."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch

from vusfa.scenes import Scene

pytestmark = pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")


@pytest.fixture
def options(tmp_path: Path) -> list[Any]:
    class Mean(torch.nn.Module):
        def forward(self, images: torch.Tensor) -> torch.Tensor:
            return images.mean((2, 3))

    torch.jit.save(torch.jit.script(Mean()), tmp_path / "mean.pt")
    return ["width=40", "height=30", "grid=1", f"backbone={tmp_path / 'mean.pt'}", "crops=ten"]


@pytest.mark.miniworld
def test_a_scene_is_made(
    run: Callable[..., Any], options: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vusfa.cli.progress._BRIEF", 0.0)  # what is done within a moment is told, too
    target = tmp_path / "maze.h5"
    name = "MiniWorld-MazeS2-v0"
    result = run("export-miniworld", name, target, *options, "seed=3", "settings=[num_rows=1,room_size=3]")
    assert result.exit_code == 0, result.stderr
    scene = Scene.load(target)
    total = scene.num_states
    assert result.stdout == (
        f"{target}: {total} states; 0 places left out because the agent could not be put there,"
        f" 0 moves taken for blocked because they ended at no known pose\n"
    )
    assert f"{total} of {total} poses" in result.stderr
    assert f"{total} of {total} pictures" in result.stderr
    assert f"{scene.attributes['places_cut_off']} places that no move on this grid leads to" in result.stderr
    assert (scene.name, scene.num_crops, scene.picture_shape) == ("maze", 10, (30, 40, 3))
    assert scene.islands == ()
    assert scene.attributes["environment"] == name
    assert set(scene.attributes["simulator_settings"]) >= {"num_rows=1", "room_size=3", "obs_width=40"}
    assert run("check", target).exit_code == 0


@pytest.mark.miniworld
@pytest.mark.parametrize(
    ("name", "words", "fault"),
    [
        ("MiniWorld-OneRom-v0", [], "called 'MiniWorld-OneRom-v0'; did you mean 'MiniWorld-OneRoom-v0'?"),
        ("kitchen", [], "no environment of MiniWorld is called 'kitchen'; there are MiniWorld-Coll"),
        ("MiniWorld-OneRoom-v0", ["settings=[size=1]"], "does not take the settings {'size': 1}"),
        ("MiniWorld-OneRoom-v0", ["grid=9"], "a grid of 9.0 m has no two places that a move connects"),
    ],
)
def test_what_cannot_be_exported(
    run: Callable[..., Any], options: list[Any], tmp_path: Path, name: str, words: list[str], fault: str
) -> None:
    result = run("export-miniworld", name, tmp_path / "out.h5", *options, *words)
    assert (result.exit_code, result.stdout, result.stderr.count("\n")) == (1, "", 1)
    assert fault in result.stderr
    assert not (tmp_path / "out.h5").exists()


def test_settings_are_numbers(run: Callable[..., Any], options: list[Any], tmp_path: Path) -> None:
    result = run("export-miniworld", "MiniWorld-OneRoom-v0", tmp_path / "out.h5", *options, "settings=big")
    assert result.exit_code == 1
    assert result.stderr == "error: settings has 'big'; give NAME=NUMBER, settings=[size=6]\n"


def test_without_the_simulator(
    run: Callable[..., Any], options: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyglet", None)
    result = run("export-miniworld", "MiniWorld-OneRoom-v0", tmp_path / "out.h5", *options)
    assert result.exit_code == 1
    assert result.stderr == "error: MiniWorld is missing: pip install 'vusfa[miniworld]'\n"


def test_without_opengl(
    run: Callable[..., Any], options: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Options(dict[str, Any]):
        def __setitem__(self, name: str, value: Any) -> None:
            raise ImportError('Library "EGL" not found.')

    pyglet: Any = ModuleType("pyglet")
    pyglet.options = Options()
    monkeypatch.setitem(sys.modules, "pyglet", pyglet)
    result = run("export-miniworld", "MiniWorld-OneRoom-v0", tmp_path / "out.h5", *options)
    assert result.exit_code == 1
    assert result.stderr == (
        'error: MiniWorld cannot render without a display (ImportError: Library "EGL" not found.); install'
        " EGL and Mesa: apt-get install libegl1 libgl1 libglu1-mesa libfontconfig1\n"
    )
