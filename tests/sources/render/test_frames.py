"""Frames and pictures without a renderer: stops, brightness, credits, the choice of LLVM."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vusfa.errors import SceneError
from vusfa.sources.render import backend as backends
from vusfa.sources.render import poses
from vusfa.sources.render.backend import Backend, choose_backend, llvm_libraries
from vusfa.sources.render.frames import Frames
from vusfa.sources.render.plan import Camera, Plan
from vusfa.sources.render.renderer import exposure_of, look_at, tone_map
from vusfa.sources.render.room import credits

PLAN = Plan("a", (2.6, 2.1, 2.6), camera=Camera(resolution=(4, 3)))
ROOM = poses(PLAN)


class Stopped(Exception):
    pass


class Painter:
    """Gives every pose a picture of its own, and stops after some."""

    def __init__(self, stop_after: int | None = None) -> None:
        self.painted: list[int] = []
        self.stop_after = stop_after

    def __call__(self, x: float, z: float, heading: float, seed: int) -> np.ndarray:
        if len(self.painted) == self.stop_after:
            raise Stopped
        self.painted.append(seed)
        return np.random.default_rng(seed).random((3, 4, 3)).astype(np.float32) * (1 + x + z + heading)


def _all(folder: Path, *stops: int | None) -> tuple[np.ndarray, list[int]]:
    painted = []
    for stop in stops:
        frames = Frames(PLAN, ROOM, folder / "a.h5", {"version": 1})
        painter = Painter(stop)
        done: list[int] = []
        try:
            frames.measure(painter, lambda frames=frames, done=done: done.append(frames.done))
            frames.render(painter, lambda frames=frames, done=done: done.append(frames.done))
        except Stopped:
            assert not frames.complete
        painted += painter.painted
        assert done == sorted(set(done))
    assert frames.complete
    assert frames.done == ROOM.num_states
    pictures = frames.read(0, ROOM.num_states)
    frames.remove()
    assert list(folder.iterdir()) == []
    return pictures, painted


@pytest.mark.parametrize("stops", [(3, None), (24, 2, 0, None), (40, None)])
def test_a_stop_costs_no_frame_and_changes_none(tmp_path: Path, stops: tuple[int | None, ...]) -> None:
    at_once, painted = _all(tmp_path, None)
    assert sorted(painted) == list(range(ROOM.num_states))
    in_parts, painted = _all(tmp_path, *stops)
    assert sorted(painted) == list(range(ROOM.num_states))
    np.testing.assert_array_equal(in_parts, at_once)


def test_frames_of_other_work_are_thrown_away(tmp_path: Path) -> None:
    frames = Frames(PLAN, ROOM, tmp_path / "a.h5", {"version": 1})
    with pytest.raises(Stopped):
        frames.measure(Painter(5), lambda: None)
    assert Frames(PLAN, ROOM, tmp_path / "a.h5", {"version": 1}).done == 5
    assert Frames(PLAN, ROOM, tmp_path / "a.h5", {"version": 2}).done == 0


def test_a_given_exposure_needs_no_frames_to_measure(tmp_path: Path) -> None:
    plan = Plan("a", (2.6, 2.1, 2.6), camera=Camera(resolution=(4, 3), exposure=0.5))
    frames = Frames(plan, ROOM, tmp_path / "a.h5", {})
    painter = Painter()
    frames.render(painter, lambda: None)
    assert painter.painted == list(range(ROOM.num_states))
    x, z = ROOM.location[5]
    expected = tone_map(Painter()(float(x), float(z), float(ROOM.rotation[5]), 5), 0.5)
    np.testing.assert_array_equal(frames.read(5, 6)[0], expected)


def test_a_dark_room_is_an_error() -> None:
    with pytest.raises(SceneError, match="the room is dark"):
        exposure_of(np.zeros((2, 3, 4, 3)))


def test_brightness_grows_and_its_ends_are_black_and_white() -> None:
    values = tone_map(np.array([-1.0, np.nan, 0.0, 0.001, 0.01, 0.1, 0.5, 1.0, 1.25, 100.0]), 1.0).tolist()
    assert values[:3] == [0, 0, 0]
    assert values == sorted(values)
    # 0.5 / 1.1 = 0.4545..., as sRGB 0.7046..., of 255: 179.7
    assert values[6] == 180
    assert values[8:] == [255, 255]


@pytest.mark.parametrize(
    ("heading", "way"), [(0.0, (0, 1)), (90.0, (-1, 0)), (180.0, (0, -1)), (270.0, (1, 0))]
)
def test_the_camera_looks_along_its_heading_and_down(heading: float, way: tuple[int, int]) -> None:
    origin, target = look_at(2.0, 3.0, heading, Camera(height=1.0, pitch=45.0))
    assert origin == [-2.0, 1.0, 3.0]
    np.testing.assert_allclose(np.subtract(target, origin), [way[0], -1.0, way[1]], atol=1e-12)


def test_credits_name_every_model_with_its_author_and_licence() -> None:
    from vusfa.sources.render import Catalogue, layout

    plan = layout("bathroom", 1)
    licences, thanks = credits(plan, Catalogue.bundled())
    assert [line.split(":")[0] for line in licences] == [
        "BlendSwap-CC-0",
        "BlendSwap-CC-BY",
        "KatorLegaz",
        "Scopia",
    ]
    assert len(thanks) == len(plan.models)
    assert any("BlendSwap-CC-BY#3 Bath, by Jay-Artist (CC BY 3.0" in line for line in thanks)


def test_the_newest_llvm_that_works_is_chosen_and_none_means_scalar(monkeypatch: pytest.MonkeyPatch) -> None:
    files = {
        f"/usr/lib/{name}" for name in ("libLLVM-15.so", "libLLVM.so.19.1", "libLLVM-9.so", "libLLVM-21.so")
    }
    monkeypatch.setattr(
        backends.glob, "glob", lambda pattern: sorted(files) if "/usr/lib/*" in pattern else []
    )
    monkeypatch.setattr(backends.os.path, "realpath", lambda path: path)
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    assert [path[9:] for path in llvm_libraries()] == [
        "libLLVM-21.so",
        "libLLVM.so.19.1",
        "libLLVM-15.so",
        "libLLVM-9.so",
    ]
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "/opt/mine.so")
    assert llvm_libraries()[0] == "/opt/mine.so"
    tried: list[str] = []
    monkeypatch.setattr(backends, "works", lambda path: tried.append(path) or path.endswith("19.1"))
    choose_backend.cache_clear()
    try:
        assert choose_backend() == Backend("llvm_ad_rgb", "/usr/lib/libLLVM.so.19.1")
        assert tried == ["/opt/mine.so", "/usr/lib/libLLVM-21.so", "/usr/lib/libLLVM.so.19.1"]
        monkeypatch.setattr(backends, "works", lambda path: False)
        choose_backend.cache_clear()
        assert choose_backend() == Backend("scalar_rgb")
        assert "without LLVM" in str(choose_backend())
    finally:
        choose_backend.cache_clear()
