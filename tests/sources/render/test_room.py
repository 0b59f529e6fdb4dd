"""What needs Mitsuba and the furniture: small rooms rendered for real."""

from __future__ import annotations

import os
import signal
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import vusfa.sources.render
from vusfa.errors import ConfigError, SceneError
from vusfa.scenes import Scene, validate
from vusfa.scenes.provenance import Provenance
from vusfa.sources.backbones import Backbone, load_backbone
from vusfa.sources.render import Catalogue, Variation, from_yaml, load_plan, poses, render_room, room, to_yaml
from vusfa.sources.render.backend import Backend, choose_backend, cores, load_mitsuba
from vusfa.sources.render.geometry import build_scene
from vusfa.sources.render.plan import Camera, Plan
from vusfa.sources.render.renderer import Renderer, tone_map

pytestmark = [
    pytest.mark.render,
    # what imports do in compiled modules of others
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
]

TINY = from_yaml("""
name: niche
size: [1.3, 0.8, 2.6]
seed: 5
surfaces: {floor: tile, seed: 3, walls: [brick, stripe]}
furniture:
- {model: BlendSwap-CC-0#77, at: [0.2, 0.65], blocks: false}
- {model: KatorLegaz#77, at: [0.6, 0.4], role: rug, blocks: false}
pictures:
- {at: [1.3, 0.4], facing: 270, height: 1.4, size: [0.5, 0.4], seed: 1}
windows:
- {model: KatorLegaz#7, at: [0.6, 0.0], facing: 0, view: 2}
lights:
- {at: [0.6, 0.4], side: 0.6}
camera: {resolution: [48, 36], samples: 2}
""")


@pytest.fixture(scope="module")
def network() -> Backbone:
    return load_backbone("efficientnet-lite0")


def test_a_room_renders_alike_twice_and_says_where_it_comes_from(tmp_path: Path, network: Backbone) -> None:
    told: list[tuple[str, int, int]] = []
    said: list[str] = []
    path = tmp_path / "niche.h5"
    made = render_room(TINY, path, lambda *state: told.append(state), backbone=network, say=said.append)
    assert made.states == 8
    assert made.backend in said[0]
    assert told[0] == ("frames", 0, 8)
    assert told[8] == ("frames", 8, 8)
    assert told[-1] == ("features", 8, 8)
    assert validate(path) == []
    scene = Scene.load(path)
    expected = poses(TINY.completed(Catalogue.open()))
    np.testing.assert_array_equal(scene.graph.numpy(), expected.graph)
    pictures = scene.pictures(range(8)).numpy()
    assert pictures.shape == (8, 36, 48, 3)
    assert 40 < pictures.mean() < 200
    assert min(picture.std() for picture in pictures) > 5
    assert made.look_alikes == 0.0

    origin = Provenance.of(scene.attributes)
    assert origin.seed == 5
    assert origin.plan is not None
    assert from_yaml(origin.plan) == TINY.completed(Catalogue.open())
    assert [line.split(" ")[0] for line in origin.credits] == [
        "BlendSwap-CC-0#77",
        "KatorLegaz#7",
        "KatorLegaz#77",
    ]
    assert [line.split(":")[0] for line in origin.licences] == ["BlendSwap-CC-0", "KatorLegaz"]
    assert "mitsuba" in (origin.made_with or "")
    assert scene.attributes["models"][1].startswith("KatorLegaz#7 ")

    again = render_room(TINY, tmp_path / "again.h5", backbone=network)
    assert again.look_alikes == made.look_alikes
    with h5py.File(path) as one, h5py.File(tmp_path / "again.h5") as other:
        for name in ("graph", "location", "rotation", "resnet_feature"):
            np.testing.assert_array_equal(one[name][()], other[name][()])
        apart = one["observation"][()].astype(int) - other["observation"][()]
        assert np.abs(apart).mean() <= 1.0
    assert sorted(file.name for file in tmp_path.iterdir()) == ["again.h5", "niche.h5"]


def test_a_stopped_run_leaves_no_product_and_goes_on(tmp_path: Path, network: Backbone) -> None:
    def stop(what: str, done: int, total: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_room(TINY, tmp_path / "room.h5", stop, backbone=network)
    assert not (tmp_path / "room.h5").exists()
    told: list[tuple[str, int, int]] = []
    render_room(TINY, tmp_path / "room.h5", lambda *state: told.append(state), backbone=network)
    assert told[0] == ("frames", 3, 8)
    render_room(TINY, tmp_path / "at_once.h5", backbone=network)
    one, other = (Scene.load(tmp_path / f"{name}.h5") for name in ("room", "at_once"))
    np.testing.assert_array_equal(one.pictures(range(8)).numpy(), other.pictures(range(8)).numpy())
    np.testing.assert_array_equal(one.features.numpy(), other.features.numpy())


@pytest.mark.usefixtures("needs_llvm")
def test_the_scalar_variant_shows_the_same_room() -> None:
    catalogue = Catalogue.open()
    # With more samples there is less of the noise, in which they differ.
    plan = replace(TINY.completed(catalogue), camera=replace(TINY.camera, samples=64))
    pictures = []
    for backend in (choose_backend(), Backend("scalar_rgb")):
        mi = load_mitsuba(backend)
        renderer = Renderer(mi, build_scene(mi, plan, catalogue), plan.camera)
        pictures.append(tone_map(renderer.frame(0.3, 0.3, 90.0, 0), 2.0).astype(int))
    assert np.abs(pictures[0] - pictures[1]).mean() < 5
    assert np.abs(pictures[0] - pictures[1].mean(axis=(0, 1))).mean() > 16


@pytest.mark.usefixtures("needs_llvm")
def test_a_replayed_frame_is_the_one_that_is_traced_anew() -> None:
    catalogue = Catalogue.open()
    plan = TINY.completed(catalogue)
    mi = load_mitsuba(choose_backend())
    scene = build_scene(mi, plan, catalogue)
    replaying = Renderer(mi, scene, plan.camera)
    for state, heading in enumerate((0.0, 90.0, 180.0)):
        pose = (0.3 + 0.1 * state, 0.3, heading, state)
        np.testing.assert_array_equal(
            replaying.frame(*pose), Renderer(mi, scene, plan.camera).frame(*pose), err_msg=str(state)
        )


class _Painter:
    """In place of the renderer: every frame as bright as the lamps of its plan."""

    def __init__(self, mi: Any, scene: Plan, camera: Camera) -> None:
        self.level, self.size = scene.lights[0].radiance[0], camera.resolution

    def frame(self, x: float, z: float, heading: float, seed: int) -> np.ndarray:
        return np.full((self.size[1], self.size[0], 3), self.level, np.float32)


def test_a_change_leaves_the_states_and_is_written_down(
    tmp_path: Path, network: Backbone, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(room, "Renderer", _Painter)
    monkeypatch.setattr(room, "build_scene", lambda mi, plan, catalogue: plan)
    monkeypatch.setattr(room.backends, "load_mitsuba", lambda backend, threads: None)
    rooms = []
    for name, variation in {"plain": Variation(), "dark": Variation(lamps=0.25, offset=0.1)}.items():
        path = tmp_path / f"{name}.h5"
        render_room(TINY, path, backbone=network, backend=Backend("scalar_rgb"), variation=variation)
        rooms.append(Scene.load(path))
    plain, dark = rooms
    for name in ("graph", "location", "rotation"):
        np.testing.assert_array_equal(getattr(plain, name).numpy(), getattr(dark, name).numpy())
    assert dark.name == plain.name
    assert dark.attributes["exposure"] == plain.attributes["exposure"]
    assert dark.attributes["variation"] == "{lamps: 0.25, offset: 0.1}"
    assert "variation" not in plain.attributes
    assert dark.attributes["plan"] == plain.attributes["plan"]
    bright, dim = (scene.pictures(range(8)).numpy().mean() for scene in rooms)
    assert dim < bright - 10


def test_the_bundled_bathroom_comes_out_of_its_plan_again() -> None:
    bundled = Scene.bundled("bathroom")
    plan = load_plan(Path(vusfa.sources.render.__file__).parent / "plans" / "bathroom.yaml")
    catalogue = Catalogue.open()
    mi = load_mitsuba(choose_backend())
    renderer = Renderer(mi, build_scene(mi, plan, catalogue), plan.camera)
    states = [17, 101, 160]
    for state, expected in zip(states, bundled.pictures(states).numpy(), strict=True):
        x, z = bundled.location[state].tolist()
        frame = renderer.frame(x, z, float(bundled.rotation[state]), state)
        picture = tone_map(frame, bundled.attributes["exposure"])
        # 2 to 4 levels are what JPEG takes from these pictures; another draw of the noise makes 5 of it.
        assert np.abs(picture.astype(int) - expected).mean() < 6, state


def test_ctrl_c_within_a_frame_stops_or_leaves_it_whole() -> None:
    catalogue = Catalogue.open()
    plan = replace(TINY.completed(catalogue), camera=replace(TINY.camera, samples=64))  # half a second
    mi = load_mitsuba(Backend("scalar_rgb"))
    renderer = Renderer(mi, build_scene(mi, plan, catalogue), plan.camera)
    whole = renderer.frame(0.3, 0.3, 90.0, 0)
    before = signal.getsignal(signal.SIGINT)

    def frame_interrupted() -> np.ndarray:
        pressed = threading.Timer(0.05, lambda: os.kill(os.getpid(), signal.SIGINT))
        pressed.start()
        try:
            return renderer.frame(0.3, 0.3, 90.0, 0)
        finally:
            pressed.join()

    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        with pytest.raises(KeyboardInterrupt):
            frame_interrupted()
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # as in a job in the background
        np.testing.assert_array_equal(frame_interrupted(), whole)
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("signaled", [KeyboardInterrupt(), SystemExit(143)])
def test_a_signal_within_the_compiler_is_no_error_of_it(signaled: BaseException) -> None:
    catalogue = Catalogue.open()
    plan = TINY.completed(catalogue)
    mi = load_mitsuba(Backend("scalar_rgb"))
    renderer = Renderer(mi, build_scene(mi, plan, catalogue), plan.camera)

    def layers(*_: Any) -> None:
        raise RuntimeError("FlatVariables::assign(): error encountered") from signaled

    renderer._layers = layers
    with pytest.raises(type(signaled)):
        renderer.frame(0.3, 0.3, 90.0, 0)
    renderer._layers = lambda *_: 1 / 0
    with pytest.raises(ZeroDivisionError):
        renderer.frame(0.3, 0.3, 90.0, 0)


@pytest.mark.parametrize("scalar", [False, True])
def test_pictures_do_not_depend_on_the_threads(scalar: bool) -> None:
    import drjit

    catalogue, backend = Catalogue.open(), Backend("scalar_rgb") if scalar else choose_backend()
    plan = TINY.completed(catalogue)
    pictures = []
    for threads in (1, 3, None):
        mi = load_mitsuba(backend, threads)
        assert drjit.thread_count() == (threads or (1 if scalar else cores()))
        renderer = Renderer(mi, build_scene(mi, plan, catalogue), plan.camera)
        pictures.append(renderer.frame(0.3, 0.3, 90.0, 0))
    np.testing.assert_array_equal(pictures[0], pictures[1])
    np.testing.assert_array_equal(pictures[0], pictures[2])
    with pytest.raises(ConfigError, match="threads: 0 is too few"):
        load_mitsuba(backend, 0)


def test_a_bad_plan_renders_nothing(tmp_path: Path, network: Backbone) -> None:
    text = to_yaml(TINY).replace("BlendSwap-CC-0#77", "BlendSwap-CC-0#7777")
    with pytest.raises(SceneError, match="the furniture catalogue has no BlendSwap-CC-0#7777"):
        render_room(from_yaml(text), tmp_path / "room.h5", backbone=network)
    with pytest.raises(SceneError, match="there is no folder"):
        render_room(TINY, tmp_path / "nowhere" / "room.h5", backbone=network)
    assert list(tmp_path.iterdir()) == []
