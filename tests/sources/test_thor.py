"""The exporter, driven by a stand-in for the simulator that serves a bundled room through the same calls."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from vusfa.errors import SceneError
from vusfa.scenes import Scene, validate
from vusfa.sources.backbones import Backbone
from vusfa.sources.crops import Preprocessing
from vusfa.sources.thor import export, successors

THUMBNAIL = Backbone(
    "thumbnail", "pixels", "0" * 64, Preprocessing(size=4), lambda images: images.flatten(1).clone()
)
MOVES = {"MoveAhead": 0, "RotateRight": 1, "RotateLeft": 2, "MoveBack": 3}


class StandIn:
    """Answers as ``ai2thor.controller.Controller`` does, with a rendered room's places, pictures and graph.

    Args:
        room: the scene that is served.
        small: only every so many rows and columns of the pictures.
        sink: places at which Teleport fails in one heading, though they are said to be reachable.
        slides: poses (state) from which MoveAhead "succeeds" and ends between two places.
        dies_after: calls after which the process is gone.
    """

    def __init__(
        self,
        room: Scene,
        small: int = 5,
        sink: tuple[int, ...] = (),
        slides: tuple[int, ...] = (),
        dies_after: int | None = None,
    ) -> None:
        self.room, self.sink, self.slides, self.left = room, sink, slides, dies_after
        self.pictures = room.pictures(torch.arange(room.num_states))[:, ::small, ::small].numpy()
        self.calls: dict[str, int] = {}
        self.state = 5
        self.noise = np.random.default_rng(0)
        self.away = 0.0

    def step(self, *, action: str, **arguments: Any) -> SimpleNamespace:
        if self.left is not None:
            self.left -= 1
            if self.left < 0:
                raise TimeoutError("Unity is gone")
        self.calls[action] = self.calls.get(action, 0) + 1
        success, found, self.away = True, None, 0.0
        if action == "GetReachablePositions":
            assert not arguments
            places = sorted({tuple(place) for place in self.room.location.tolist()}, key=lambda p: -p[1])
            found = [{"x": x + self._tiny(), "y": 0.9 + self._tiny(), "z": z} for x, z in places]
        elif action == "Teleport":
            success = self._teleport(**arguments)
        else:
            if action.startswith("Rotate"):
                assert arguments == {"degrees": 90}
            else:
                assert arguments == {"moveMagnitude": 0.5}
            target = int(self.room.graph[self.state, MOVES[action]])
            if action == "MoveAhead" and self.state in self.slides:
                self.away = 0.2
            elif target < 0:
                success = False
            else:
                self.state = target
        x, z = self.room.location[self.state].tolist()
        # The simulator's angles may come as 359.9999.
        heading = (float(self.room.rotation[self.state]) - abs(self._tiny())) % 360
        agent = {
            "position": {"x": x + self._tiny() + self.away, "y": 0.9, "z": z + self._tiny()},
            "rotation": {"x": 0.0, "y": heading, "z": 0.0},
        }
        metadata = {
            "lastActionSuccess": success,
            "actionReturn": found,
            "errorMessage": "" if success else f"{action} blocked",
            "agent": agent,
        }
        return SimpleNamespace(metadata=metadata, frame=self.pictures[self.state])

    def _tiny(self) -> float:
        return float(self.noise.uniform(-1e-5, 1e-5))

    def _teleport(self, position: dict[str, float], rotation: dict[str, float], horizon: float) -> bool:
        assert set(position) == {"x", "y", "z"}
        assert rotation["x"] == rotation["z"] == 0
        gap = (self.room.location - torch.tensor([position["x"], position["z"]])).abs().sum(1)
        gap = gap + (self.room.rotation - rotation["y"]).abs()
        state = int(gap.argmin())
        assert gap[state] < 1e-3
        if state in self.sink:
            return False
        self.state = state
        return True


@pytest.fixture(scope="module")
def room() -> Scene:
    return Scene.bundled("bathroom")


def same_states(exported: Scene, room: Scene) -> torch.Tensor:
    """For each exported state, the state of the room with the same pose."""
    gap = (exported.location[:, None] - room.location).abs().sum(-1)
    gap = gap + (exported.rotation[:, None] - room.rotation).abs()
    assert bool((gap.min(1).values < 1e-3).all())
    return gap.argmin(1)


def test_a_room_comes_out_as_it_is_served(room: Scene, tmp_path: Path) -> None:
    controller, visited, encoded = StandIn(room), [], []
    exported = export(
        controller,
        tmp_path / "room.h5",
        name="FloorPlan401",
        backbone=THUMBNAIL,
        attributes={"simulator_settings": ["gridSize=0.5"]},
        versions={"ai2thor": "5.0.0"},
        visited=lambda done, total: visited.append((done, total)),
        encoded=lambda done, total: encoded.append((done, total)),
    )
    assert validate(tmp_path / "room.h5") == []
    same = same_states(exported, room)
    assert sorted(same.tolist()) == list(range(room.num_states))
    back = torch.empty_like(same)
    back[same] = torch.arange(len(same))
    expected = room.graph[same]
    assert torch.equal(exported.graph, torch.where(expected < 0, -1, back[expected]))
    assert torch.equal(exported.distance, room.distance[same][:, same])
    assert exported.actions == room.actions
    shown = exported.pictures(torch.arange(exported.num_states))
    assert np.array_equal(shown.numpy(), controller.pictures[same])
    assert exported.features.shape == (176, 1, 48)
    assert controller.calls["Teleport"] == 4 * 176
    assert visited == [(done, 176) for done in range(177)]
    assert encoded[-1] == (176, 176)
    told = exported.attributes
    assert told["made_with"].endswith("scenes export-thor, ai2thor 5.0.0")
    assert (told["places_left_out"], told["moves_astray"], told["cell_m"]) == (0, 0, 0.5)
    assert told["simulator_settings"] == ["gridSize=0.5"]
    assert told["feature_backbone"] == "thumbnail"
    assert [path.name for path in tmp_path.iterdir()] == ["room.h5"]


def test_an_export_that_dies_goes_on_and_gives_the_same(
    room: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1000000000")
    whole = export(StandIn(room), tmp_path / "whole.h5", name="x", backbone=THUMBNAIL)
    dying = StandIn(room, dies_after=500)
    with pytest.raises(SceneError, match=r"failed at .*TimeoutError: Unity is gone.*goes on where it was"):
        export(dying, tmp_path / "room.h5", name="x", backbone=THUMBNAIL)
    assert not (tmp_path / "room.h5").exists()
    second, visited = StandIn(room), []
    second.noise = np.random.default_rng(1)  # the last digits differ from run to run
    resumed = export(
        second,
        tmp_path / "room.h5",
        name="x",
        backbone=THUMBNAIL,
        visited=lambda done, total: visited.append(done),
    )
    assert visited[0] == 499 // 8  # one call for the places, eight for each pose
    assert second.calls["Teleport"] == 4 * (176 - visited[0])
    assert torch.equal(resumed.graph, whole.graph)
    assert torch.equal(resumed.features, whole.features)
    assert (tmp_path / "room.h5").read_bytes() == (tmp_path / "whole.h5").read_bytes()


def test_another_room_does_not_go_on_from_the_first(room: Scene, tmp_path: Path) -> None:
    with pytest.raises(SceneError):
        export(StandIn(room, dies_after=200), tmp_path / "room.h5", name="x", backbone=THUMBNAIL)
    visited: list[int] = []
    with pytest.raises(SceneError):
        export(
            StandIn(room, dies_after=200),
            tmp_path / "room.h5",
            name="y",
            backbone=THUMBNAIL,
            visited=lambda done, total: visited.append(done),
        )
    assert visited[0] == 0


def test_places_that_cannot_be_stood_at_are_left_out_and_lead_nowhere(room: Scene, tmp_path: Path) -> None:
    sink = (42, 43)  # two headings of one place
    exported = export(StandIn(room, sink=sink), tmp_path / "room.h5", name="x", backbone=THUMBNAIL)
    assert exported.num_states == 172
    assert exported.attributes["places_left_out"] == 1
    same = same_states(exported, room).tolist()
    assert not set(same) & {40, 41, 42, 43}
    into = sum(int(target) in (40, 41, 42, 43) for state in same for target in room.graph[state])
    assert exported.attributes["moves_astray"] == into > 0


def test_a_move_that_ends_between_places_is_blocked_and_counted(room: Scene, tmp_path: Path) -> None:
    free = torch.nonzero(room.graph[:, 0] >= 0).flatten()[:3].tolist()
    exported = export(StandIn(room, slides=tuple(free)), tmp_path / "room.h5", name="x", backbone=THUMBNAIL)
    same = same_states(exported, room).tolist()
    assert exported.attributes["moves_astray"] == 3
    assert all(exported.graph[same.index(state), 0] == -1 for state in free)


def test_a_teleport_that_lies_is_not_believed(room: Scene, tmp_path: Path) -> None:
    class Stuck(StandIn):
        def _teleport(self, **arguments: Any) -> bool:
            before = self.state
            found = super()._teleport(**arguments)
            if self.state // 4 == 7:
                self.state = before
            return found

    exported = export(Stuck(room), tmp_path / "room.h5", name="x", backbone=THUMBNAIL)
    assert not set(same_states(exported, room).tolist()) & {28, 29, 30, 31}


def answering(metadata: dict[str, Any]) -> Any:
    event = SimpleNamespace(metadata=metadata, frame=np.zeros((2, 2, 3), np.uint8))
    return SimpleNamespace(step=lambda **arguments: event)


@pytest.mark.parametrize(
    ("metadata", "fault"),
    [
        ({"lastActionSuccess": False, "errorMessage": "no scene", "actionReturn": None}, r"\(no scene\)"),
        ({"lastActionSuccess": True, "actionReturn": []}, "none found"),
        (
            {
                "lastActionSuccess": False,
                "actionReturn": [{"x": 0, "y": 0, "z": 0}],
                "agent": {"position": {"x": 0, "z": 0}, "rotation": {"y": 0}},
            },
            "reachable positions",
        ),
    ],
)
def test_a_simulator_without_places_is_told(metadata: dict[str, Any], fault: str, tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=fault):
        export(answering(metadata), tmp_path / "room.h5", name="x", backbone=THUMBNAIL)


def test_nowhere_to_stand(room: Scene, tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="stand nowhere"):
        export(StandIn(room, sink=tuple(range(176))), tmp_path / "room.h5", name="x", backbone=THUMBNAIL)


@pytest.mark.parametrize(
    ("landing", "expected"),
    [
        ((1, 0.5, 0.0, 0.0), 1),  # there
        ((1, 0.42, 0.08, 359.0), 1),  # near enough, the heading across 0
        ((1, 0.5, 0.0, 3.0), -1),  # no such heading
        ((1, 0.3, 0.0, 0.0), -1),  # 0.2 m away: more than a quarter of the step
        ((0, 0.5, 0.0, 0.0), -1),  # failed, wherever it ended
        ((1, 0.0, 0.0, 0.0), -1),  # did nothing
        ((1, 0.0, 0.0, 90.0), 2),
    ],
)
def test_where_a_landing_is(landing: tuple[float, ...], expected: int) -> None:
    places = np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 0.0]])
    graph, _ = successors(
        places, np.array([0.0, 0.0, 90.0]), np.array([[landing], [[0] * 4], [[0] * 4]]), 0.5
    )
    assert graph.tolist() == [[expected], [-1], [-1]]


def test_a_frame_that_changes_its_size(room: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    controller = StandIn(room)
    step: Callable[..., Any] = controller.step

    def other(**arguments: Any) -> Any:
        event = step(**arguments)
        event.frame = event.frame[1:] if arguments["action"] == "Teleport" else event.frame
        return event

    monkeypatch.setattr(controller, "step", other)
    with pytest.raises(SceneError, match="frames change"):
        export(controller, tmp_path / "room.h5", name="x", backbone=THUMBNAIL)
