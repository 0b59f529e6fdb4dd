"""The examples for Habitat, Matterport3D and ProcTHOR, each with a stand-in for its simulator.

A stand-in answers the calls that the example makes, from a small world that the test knows.
"""

from __future__ import annotations

import importlib.util
import json
import math
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from vusfa.scenes import validate
from vusfa.sources.backbones import Backbone
from vusfa.sources.crops import Preprocessing

FOLDER = Path(__file__).parents[2] / "examples" / "sources"
TINY = Backbone(
    "mean colour", "mean", "0" * 64, Preprocessing(size=4), lambda images: images.mean((2, 3)), mixed=False
)


def example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"example_{name}", FOLDER / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Habitat:
    """A floor of 1 m by 1.5 m whose corner (x > 0.75, z < 0.75) is a wall; pictures say place and heading."""

    def __init__(self) -> None:
        self.agents, self.pathfinder = [self], self
        self.state = SimpleNamespace(position=np.array([0.0, 0.2, 0.0]), rotation=None)

    def free(self, x: float, z: float) -> bool:
        return -0.01 <= x <= 1.01 and -0.01 <= z <= 1.51 and not (x > 0.75 and z < 0.75)

    def get_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        return np.array([0.0, 0.0, 0.0]), np.array([1.2, 2.0, 1.7])

    def snap_point(self, point: np.ndarray) -> np.ndarray:
        if self.free(point[0], point[2]):
            return np.array([point[0], 0.2, point[2]], np.float32)
        return (
            np.full(3, np.nan, np.float32) if point[0] > 1.1 else np.array([0.7, 0.2, point[2]], np.float32)
        )

    def try_step(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        return end if self.free(end[0], end[2]) else start

    def get_state(self) -> SimpleNamespace:
        return SimpleNamespace(**vars(self.state))

    def set_state(self, state: SimpleNamespace) -> None:
        self.state = state

    def get_sensor_observations(self) -> dict[str, np.ndarray]:
        x, y, z, w = self.state.rotation
        assert x == z == 0
        ahead = -2 * y * w, -(1 - 2 * y * y)  # of the camera's -z, turned by the quaternion
        colors = [
            100 * self.state.position[0],
            100 * self.state.position[2],
            100 + 50 * ahead[0] + 20 * ahead[1],
            255,
        ]
        return {"color_sensor": np.full((6, 8, 4), np.round(colors), np.uint8)}


def test_habitat(tmp_path: Path) -> None:
    target = tmp_path / "flat.h5"
    scene = example("habitat").export(Habitat(), target, backbone=TINY)
    assert validate(target) == []
    places = {(0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (0.5, 0.5), (0.0, 1.0), (0.5, 1.0), (1.0, 1.0)}
    places |= {(0.0, 1.5), (0.5, 1.5), (1.0, 1.5)}
    assert scene.num_states == 4 * len(places)
    assert {(x, -z) for x, z in scene.location.tolist()} == places
    state = {
        (x, -z, h): n
        for n, ((x, z), h) in enumerate(zip(scene.location.tolist(), scene.rotation.tolist(), strict=True))
    }
    # forward at heading 0 is Habitat's -z; a quarter to the right of it is +x
    assert scene.graph[state[0.5, 1.0, 0.0]].tolist() == [
        state[0.5, 0.5, 0.0],
        state[0.5, 1.0, 90.0],
        state[0.5, 1.0, 270.0],
        state[0.5, 1.5, 0.0],
    ]
    assert scene.graph[state[0.5, 1.0, 90.0], 0] == state[1.0, 1.0, 90.0]
    assert scene.graph[state[0.5, 0.5, 90.0], 0] == -1  # the wall
    assert scene.graph[state[1.0, 1.0, 0.0], 0] == -1
    assert scene.islands == ()
    # the camera looked where the heading says: ahead is (sin h, -cos h) in Habitat's x and z
    for (x, z, heading), number in state.items():
        radians = math.radians(heading)
        expected = [100 * x, 100 * z, 100 + 50 * math.sin(radians) - 20 * math.cos(radians)]
        assert scene.pictures(number)[0, 0].tolist() == pytest.approx(expected, abs=1)


class Matterport:
    """Answers with the viewpoint and the heading as a BGR picture."""

    def newEpisode(
        self, scans: list[str], viewpoints: list[str], headings: list[float], elevations: list[float]
    ) -> None:
        assert (scans, elevations) == (["scan"], [0.0])
        self.picture = np.zeros((6, 8, 3), np.uint8)
        self.picture[...] = [0, ord(viewpoints[0]), round(math.degrees(headings[0])) // 2]

    def getState(self) -> list[SimpleNamespace]:
        return [SimpleNamespace(rgb=self.picture)]


def test_matterport(tmp_path: Path) -> None:
    # b is north of a, c east of a and left out of d's sight; x is not included
    places = {"a": (0, 0), "b": (0, 2), "x": (9, 9), "c": (2, 0.2), "d": (2, 2)}
    clear = {"ab", "ac", "bd", "ax", "bx"}
    entries = [
        {
            "image_id": name,
            "pose": [1, 0, 0, x, 0, 1, 0, y, 0, 0, 1, 1.5, 0, 0, 0, 1],
            "included": name != "x",
            "visible": [True] * 5,
            "unobstructed": [name + other in clear or other + name in clear for other in places],
            "height": 1.5,
        }
        for name, (x, y) in places.items()
    ]
    (tmp_path / "scan_connectivity.json").write_text(json.dumps(entries))
    target = tmp_path / "house.h5"
    scene = example("matterport").export(Matterport(), "scan", tmp_path, target, backbone=TINY)
    assert validate(target) == []
    assert (scene.name, scene.num_states) == ("scan", 4 * 12)
    a, b, c, d = 0, 12, 24, 36
    assert scene.graph[a + 0].tolist() == [b, a + 1, a + 11, -1]  # north; east; ...; nothing behind
    assert scene.graph[a + 3].tolist() == [c + 3, a + 4, a + 2, -1]  # 84 degrees is within half a turn of 90
    assert scene.graph[a + 6, 3] == b + 6  # backward while looking south
    assert scene.graph[a + 1, 0] == -1
    assert scene.graph[c + 0, 0] == -1  # d is there, but obstructed
    assert scene.graph[b + 3, 0] == d + 3
    assert scene.islands == ()
    assert scene.location[c].tolist() == pytest.approx([2, 0.2])
    assert scene.pictures(b + 3)[0, 0].tolist() == [45, ord("b"), 0]  # red, green, blue


class Thor:
    """One room of two places; counts what was asked of it."""

    def __init__(self, **settings: Any) -> None:
        self.settings, self.x, self.heading, self.stopped = settings, 0.0, 0.0, False
        made.append(self)

    def step(self, *, action: str, **arguments: Any) -> SimpleNamespace:
        success, found = True, None
        if action == "GetReachablePositions":
            found = [{"x": x, "y": 0.9, "z": 0.0} for x in (0.0, 0.5)]
        elif action == "Teleport":
            self.x, self.heading = arguments["position"]["x"], arguments["rotation"]["y"]
        elif action.startswith("Rotate"):
            self.heading = (self.heading + (90 if action == "RotateRight" else -90)) % 360
        else:
            along = {90.0: 0.5, 270.0: -0.5}.get(self.heading, 9.0) * (1 if action == "MoveAhead" else -1)
            success = 0 <= self.x + along <= 0.5
            self.x += along if success else 0
        agent = {"position": {"x": self.x, "y": 0.9, "z": 0.0}, "rotation": {"y": self.heading}}
        metadata = {"lastActionSuccess": success, "actionReturn": found, "agent": agent}
        return SimpleNamespace(metadata=metadata, frame=np.full((6, 8, 3), self.heading // 2, np.uint8))

    def stop(self) -> None:
        self.stopped = True


made: list[Thor] = []
HOUSE = {"rooms": [{"roomType": "Kitchen"}, {"roomType": "Bathroom"}], "walls": [], "metadata": {}}


def test_procthor(tmp_path: Path) -> None:
    made.clear()
    target = tmp_path / "procthor-7.h5"
    scene = example("procthor").export_house(HOUSE, target, Thor, backbone=TINY)
    assert validate(target) == []
    assert (scene.name, scene.num_states) == ("procthor-7", 8)
    assert scene.attributes["rooms"] == "1 Bathroom, 1 Kitchen"
    (controller,) = made
    assert controller.settings["scene"] == HOUSE
    assert controller.stopped
    looking_east = 1
    assert scene.rotation[looking_east] == 90
    assert scene.graph[looking_east].tolist() == [5, 2, 0, -1]


@pytest.mark.parametrize("name", ["habitat", "matterport", "procthor"])
def test_they_are_short_and_import_their_simulator_when_they_run(name: str) -> None:
    path = FOLDER / f"{name}.py"
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 115
    for library in ("habitat_sim", "MatterSim", "ai2thor", "prior"):
        assert not hasattr(example(name), library)
