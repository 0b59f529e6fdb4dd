"""The exporter against a live simulator: MiniWorld's rooms, rendered through EGL."""

from __future__ import annotations

import math
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from vusfa.errors import ConfigError, SceneError
from vusfa.scenes import Scene, validate
from vusfa.sources.backbones import Backbone
from vusfa.sources.crops import Preprocessing
from vusfa.sources.miniworld import MiniWorldController, export_miniworld, open_miniworld

pytestmark = pytest.mark.miniworld

THUMBNAIL = Backbone(
    "thumbnail", "pixels", "0" * 64, Preprocessing(size=4), lambda images: images.flatten(1).clone()
)
WIDTH, HEIGHT = 80, 60
FORWARD = 0


def open_room(name: str = "MiniWorld-OneRoom-v0", **settings: Any) -> Any:
    return open_miniworld(name, **{"seed": 3, "width": WIDTH, "height": HEIGHT, **settings})


def on_floor(env: Any, x: float, z: float, agent: float) -> bool:
    """Whether a disk lies on the floor of rooms, within one or across an opening between two."""
    rims = [(x + agent * math.sin(a), -z + agent * math.cos(a)) for a in np.linspace(0, 2 * math.pi, 16)]
    slack = 1e-6
    return all(
        any(
            room.min_x - slack <= u <= room.max_x + slack and room.min_z - slack <= v <= room.max_z + slack
            for room in env.rooms
        )
        for u, v in rims
    )


def places_of(controller: MiniWorldController) -> list[tuple[float, float]]:
    found = controller.step(action="GetReachablePositions").metadata["actionReturn"]
    return [(place["x"], place["z"]) for place in found]


@pytest.fixture(scope="module")
def box() -> np.ndarray:
    """Where the red box of the exported room is, x and z in the scene's frame."""
    x, _, z = open_room(size=4).box.pos
    return np.array([x, -z])


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """A room of 4 x 4 m with a red box in it, 0.5 m between places."""
    target = tmp_path_factory.mktemp("miniworld") / "room.h5"
    return export_miniworld(open_room(size=4), target, backbone=THUMBNAIL)


def ahead(heading: float) -> np.ndarray:
    return np.array([math.sin(math.radians(heading)), math.cos(math.radians(heading))])


def red(scene: Scene, state: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the red pixels of a state's picture."""
    picture = scene.pictures([state])[0].numpy().astype(int)
    return np.nonzero((picture[..., 0] > 100) & (picture[..., 1:].max(-1) < 40))


def test_the_places_are_those_where_the_agent_touches_nothing(room: Scene, box: np.ndarray) -> None:
    assert validate(room.path) == []
    assert (room.islands, room.picture_shape) == ((), (HEIGHT, WIDTH, 3))
    # A box of 0.8 x 0.8 m has a radius of 0.57 m, the agent one of 0.4 m.
    reach = 0.4 + math.hypot(0.8, 0.8) / 2
    grid = [0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5]  # 0 and 4 are walls; z of MiniWorld is -z of the scene
    free = [(x, -z) for x in grid for z in grid if math.dist((x, -z), box) >= reach]
    assert sorted({tuple(place) for place in room.location.tolist()}) == sorted(free)
    assert room.num_states == 4 * len(free) < 4 * 49
    told = room.attributes
    assert (told["places_left_out"], told["moves_astray"], told["places_cut_off"]) == (0, 0, 0)


def test_moves_end_at_the_next_place_or_are_blocked(room: Scene) -> None:
    """Every move by arithmetic: forward along the heading, right adds 90 degrees."""
    poses = [
        (*place, turn) for place, turn in zip(room.location.tolist(), room.rotation.tolist(), strict=True)
    ]
    state = {pose: number for number, pose in enumerate(poses)}
    for (x, z, heading), found in zip(poses, room.graph.tolist(), strict=True):
        right, up = np.round(ahead(heading)) * 0.5
        assert found == [
            state.get((x + right, z + up, heading), -1),
            state[x, z, (heading + 90) % 360],
            state[x, z, (heading - 90) % 360],
            state.get((x - right, z - up, heading), -1),
        ]


def test_pictures_are_taken_from_where_the_state_is(room: Scene, box: np.ndarray) -> None:
    """The box is where a pinhole camera of 60 degrees sees it: on the right, if it is on the right."""
    focal, seen = HEIGHT / 2 / math.tan(math.radians(30)), []
    for state, (place, heading) in enumerate(zip(room.location.numpy(), room.rotation.tolist(), strict=True)):
        away = box - place
        depth, right = away @ ahead(heading), away @ ahead(heading + 90)
        _, columns = red(room, state)
        if depth < -0.6:
            assert not len(columns)
        elif depth > 1.2 and abs(right) < 0.4 * depth:
            assert columns.mean() == pytest.approx(WIDTH / 2 + focal * right / depth, abs=4)
            seen.append((heading, right > 0))
    assert {on_the_right for _, on_the_right in seen} == {True, False}
    assert len({heading for heading, _ in seen}) > 1


def test_forward_brings_the_box_nearer(room: Scene) -> None:
    """The camera is above the box: the nearer, the lower is its upper end in the picture."""
    compared = 0
    for state, following in enumerate(room.graph[:, FORWARD].tolist()):
        (rows, columns), (rows_then, columns_then) = red(room, state), red(room, max(following, 0))
        both = np.concatenate([columns, columns_then])
        if following >= 0 and len(rows) and len(rows_then) and both.min() > 0 and both.max() < WIDTH - 1:
            assert rows_then.min() > rows.min()
            compared += 1
    assert compared > 5


def test_one_seed_is_one_file_even_after_a_simulator_that_died(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1000000000")
    whole, resumed = tmp_path / "whole" / "room.h5", tmp_path / "resumed" / "room.h5"
    for target in (whole, resumed):
        target.parent.mkdir()
    given = {"grid": 1.0, "backbone": THUMBNAIL}
    scene = export_miniworld(open_room(size=4), whole, **given)
    assert scene.attributes["seed"] == 3
    assert "size=4" in scene.attributes["simulator_settings"]
    made_with = f"scenes export-miniworld, miniworld {version('miniworld')}, pyglet {version('pyglet')}"
    assert scene.attributes["made_with"].endswith(made_with)

    step, left = MiniWorldController.step, [100]

    def dying(self: MiniWorldController, **arguments: Any) -> Any:
        left[0] -= 1
        if left[0] < 0:
            raise TimeoutError("gone")
        return step(self, **arguments)

    monkeypatch.setattr(MiniWorldController, "step", dying)
    with pytest.raises(SceneError, match=r"failed at .*TimeoutError: gone.*goes on where it was"):
        export_miniworld(open_room(size=4), resumed, **given)
    left[0], visited = 10**6, []
    export_miniworld(open_room(size=4), resumed, **given, visited=lambda done, _: visited.append(done))
    assert visited[0] == 99 // 8  # one call for the places, eight for each pose
    assert resumed.read_bytes() == whole.read_bytes()

    other = export_miniworld(open_room(size=4, seed=4), tmp_path / "room.h5", **given)
    first = scene.pictures(torch.arange(4)), other.pictures(torch.arange(4))
    assert not torch.equal(*first)


def test_an_environment_of_ones_own(tmp_path: Path) -> None:
    env = import_module("miniworld.envs").OneRoom(size=3, obs_width=16, obs_height=12)
    env.reset(seed=5)
    scene = export_miniworld(env, tmp_path / "own.h5", grid=0.5, backbone=THUMBNAIL)
    assert (scene.name, scene.attributes["environment"], scene.attributes["seed"]) == ("own", "OneRoom", 5)
    assert scene.picture_shape == (12, 16, 3)


def test_domain_randomization_changes_pictures_and_not_the_room() -> None:
    events = []
    for drawn in (False, True, True):
        controller = MiniWorldController(open_room(size=4, domain_rand=drawn))
        place = {"x": 3.5, "y": 0.0, "z": -3.5}
        horizon = -controller.env.agent.cam_pitch
        event = controller.step(action="Teleport", position=place, rotation={"y": 0.0}, horizon=horizon)
        assert event.metadata["lastActionSuccess"]
        events.append((event.frame, places_of(controller)))
    (plain, _), (one, places), (same, same_places) = events
    assert not np.array_equal(plain, one)
    assert np.array_equal(one, same)
    assert places == same_places


def test_an_event_shows_what_was_seen_then() -> None:
    controller = MiniWorldController(open_room(size=4))
    place = {"x": 3.5, "y": 0.0, "z": -3.5}
    before = controller.step(action="Teleport", position=place, rotation={"y": 270.0}, horizon=0.0)
    frame = before.frame
    turned = controller.step(action="RotateRight", degrees=90)
    assert np.array_equal(before.frame, frame)
    assert not np.array_equal(turned.frame, frame)
    pose = turned.metadata["agent"]
    assert pose["position"] == place
    assert pose["rotation"]["y"] % 360 == pytest.approx(0, abs=1e-9)
    for _ in range(3):
        turned = controller.step(action="RotateRight", degrees=90)
    assert np.array_equal(turned.frame, frame)


def test_what_fails_leaves_the_agent_where_it_is() -> None:
    controller = MiniWorldController(open_room(size=4))
    corner = {"x": 3.5, "y": 0.0, "z": -3.5}
    controller.step(action="Teleport", position=corner, rotation={"y": 90.0}, horizon=0.0)
    for wrong in (
        {"action": "MoveAhead", "moveMagnitude": 0.5},
        {"action": "MoveBack", "moveMagnitude": 5.0},
        {"action": "Teleport", "position": {"x": 9.0, "y": 0.0, "z": 0.0}, "rotation": {"y": 0.0}},
    ):
        event = controller.step(**wrong)
        assert not event.metadata["lastActionSuccess"]
        assert event.metadata["agent"]["position"] == corner
    with pytest.raises(ValueError, match="no action is called 'Fly'"):
        controller.step(action="Fly")


@pytest.mark.parametrize(("grid", "count"), [(1.0, 4 * 4 + 3 * 2), (1.25, 4 * 4)])
def test_walls_between_places_block_however_long_a_step_is(grid: float, count: int) -> None:
    """A maze of 2 x 2 rooms of 3 m, 0.25 m apart, three of them open to the next.

    A grid of 1 m has two places within each opening; one of 1.25 m has none, but places beside each other on
    both sides of a wall.
    """
    env = open_room("MiniWorld-MazeS2-v0")
    env.entities.remove(env.box)
    controller = MiniWorldController(env, grid)
    places = places_of(controller)
    assert (len(places), controller.cut_off) == (count, 0)
    blocked = 0
    for x, z in places:
        here = {"x": x, "y": 0.0, "z": z}
        for heading in (0.0, 90.0):
            controller.step(action="Teleport", position=here, rotation={"y": heading}, horizon=0.0)
            moved = controller.step(action="MoveAhead", moveMagnitude=grid).metadata["lastActionSuccess"]
            way = [np.array([x, z]) + ahead(heading) * along for along in np.linspace(0, grid, 50)]
            assert moved == all(on_floor(env, *point, agent=0.4) for point in way)
            blocked += not moved and tuple(np.round(way[-1], 6)) in places
    assert blocked == (0 if grid == 1.0 else 2)


@pytest.mark.parametrize(
    ("grid", "fault"),
    [
        (
            1.9,
            r"no two places that a move connects \(places where the agent can stand: 1\); take a shorter one",
        ),
        (9.0, "places where the agent can stand: 0"),
        (0.01, "a grid of 0.01 m makes over 100,000 states; take a longer one"),
        (0.0, "it must be above 0"),
        (math.nan, "it must be above 0"),
    ],
)
def test_a_grid_that_does_not_suit_the_room(grid: float, fault: str) -> None:
    with pytest.raises(SceneError, match=fault):
        MiniWorldController(open_room(size=3), grid)


@pytest.mark.parametrize(
    ("name", "settings", "fault"),
    [
        ("MiniWorld-OneRoom-v9", {}, "called 'MiniWorld-OneRoom-v9'; did you mean 'MiniWorld-OneRoom-v0'?"),
        ("CartPole-v1", {}, "called 'CartPole-v1'; there are MiniWorld-CollectHealth-v0, .*, ...$"),
        ("MiniWorld-OneRoom-v0", {"size": 1}, r"not take the settings {'size': 1} \(AssertionError"),
        ("MiniWorld-Maze-v0", {"num_rows": 1000}, r"not take the settings .* \(RecursionError"),
        ("MiniWorld-OneRoom-v0", {"sise": 5}, r"not take the settings {'sise': 5} \(TypeError.*'sise'"),
    ],
)
def test_an_environment_that_cannot_be_made(name: str, settings: dict[str, Any], fault: str) -> None:
    with pytest.raises(ConfigError, match=fault):
        open_miniworld(name, **settings)
