"""vusfa scenes export-thor, with stand-ins for ai2thor's modules."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from vusfa.scenes import Scene

pytestmark = pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")


@pytest.fixture(autouse=True)
def _progress_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is done within a moment is told, too."""
    monkeypatch.setattr("vusfa.cli.progress._BRIEF", 0.0)


class TwoPlaces:
    """Two places side by side along +X; answers as ai2thor's controller does."""

    made: list[TwoPlaces] = []  # noqa: RUF012
    dies_after = 10**9

    def __init__(self, **settings: Any) -> None:
        self.settings, self.x, self.heading, self.stopped = settings, 0.0, 0.0, False
        self.left = self.dies_after
        self.made.append(self)

    def step(self, *, action: str, **arguments: Any) -> SimpleNamespace:
        self.left -= 1
        if self.left < 0:
            raise TimeoutError("no answer")
        success, found = True, None
        if action == "GetReachablePositions":
            found = [{"x": x, "y": 0.9, "z": 0.0} for x in (0.25, 0.0)]
        elif action == "Teleport":
            assert arguments["horizon"] == 10
            self.x, self.heading = arguments["position"]["x"], arguments["rotation"]["y"]
        elif action.startswith("Rotate"):
            self.heading = (self.heading + (90 if action == "RotateRight" else -90)) % 360
        else:
            along = {90.0: 0.25, 270.0: -0.25}.get(self.heading, 9.0) * (1 if action == "MoveAhead" else -1)
            success = 0 <= self.x + along <= 0.25
            self.x += along if success else 0
        frame = np.full((self.settings["height"], self.settings["width"], 3), self.heading // 2, np.uint8)
        agent = {"position": {"x": self.x, "y": 0.9, "z": 0.0}, "rotation": {"y": self.heading}}
        metadata = {"lastActionSuccess": success, "actionReturn": found, "agent": agent}
        return SimpleNamespace(metadata=metadata, frame=frame)

    def stop(self) -> None:
        self.stopped = True


@pytest.fixture
def simulator(monkeypatch: pytest.MonkeyPatch) -> type[TwoPlaces]:
    for name, content in {
        "ai2thor": {"__version__": "5.0.0"},
        "ai2thor.controller": {"Controller": TwoPlaces},
        "ai2thor.platform": {"CloudRendering": "the class CloudRendering"},
    }.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(TwoPlaces, "made", [])
    return TwoPlaces


@pytest.fixture
def options(tmp_path: Path) -> list[Any]:
    class Mean(torch.nn.Module):
        def forward(self, images: torch.Tensor) -> torch.Tensor:
            return images.mean((2, 3))

    torch.jit.save(torch.jit.script(Mean()), tmp_path / "mean.pt")
    size = ["--width", 8, "--height", 6, "--grid", 0.25, "--horizon", 10]
    return [*size, "--backbone", tmp_path / "mean.pt", "--crops", "ten"]


def test_a_scene_is_made(
    run: Callable[..., Any], simulator: type[TwoPlaces], options: list[Any], tmp_path: Path
) -> None:
    target = tmp_path / "out.h5"
    result = run("export-thor", "FloorPlan212", target, *options, "--headless", "--field-of-view", 60)
    assert result.exit_code == 0, result.stderr
    assert result.stdout.startswith(f"{target}: 8 states; 0 places left out")
    assert "8 of 8 poses" in result.stderr
    assert "8 of 8 pictures" in result.stderr
    (controller,) = simulator.made
    assert controller.stopped
    assert controller.settings == {
        "scene": "FloorPlan212",
        "snapToGrid": True,
        "rotateStepDegrees": 90,
        "fieldOfView": 60,
        "gridSize": 0.25,
        "width": 8,
        "height": 6,
        "platform": "the class CloudRendering",
    }
    scene = Scene.load(target)
    # By hand: forward, right, left, backward; state = 4 * place + heading.
    assert scene.graph.tolist() == [
        [-1, 1, 3, -1],
        [5, 2, 0, -1],
        [-1, 3, 1, -1],
        [-1, 0, 2, 7],
        [-1, 5, 7, -1],
        [-1, 6, 4, 1],
        [-1, 7, 5, -1],
        [3, 4, 6, -1],
    ]
    assert scene.location[:, 0].tolist() == [0.0] * 4 + [0.25] * 4
    assert (scene.name, scene.num_crops, scene.picture_shape) == ("FloorPlan212", 10, (6, 8, 3))
    assert scene.attributes["simulator_settings"][:2] == ["fieldOfView=60.0", "gridSize=0.25"]
    assert scene.attributes["made_with"].endswith("ai2thor 5.0.0")
    assert run("check", target).exit_code == 0


def test_a_simulator_that_dies_is_stopped_and_the_export_goes_on(
    run: Callable[..., Any],
    simulator: type[TwoPlaces],
    options: list[Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(TwoPlaces, "dies_after", 30)
    result = run("export-thor", "FloorPlan212", tmp_path / "out.h5", *options)
    assert result.exit_code == 1
    assert "error: the simulator failed at" in result.stderr
    assert simulator.made[0].stopped
    monkeypatch.setattr(TwoPlaces, "dies_after", 10**9)
    result = run("export-thor", "FloorPlan212", tmp_path / "out.h5", *options)
    assert result.exit_code == 0
    assert "visiting (some was there already): 5 of 5 poses" in result.stderr


def test_without_the_simulator(
    run: Callable[..., Any], options: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ai2thor", None)
    result = run("export-thor", "FloorPlan212", tmp_path / "out.h5", *options)
    assert result.exit_code == 1
    assert result.stderr == "error: AI2-THOR is missing: pip install 'vusfa[thor]'\n"
