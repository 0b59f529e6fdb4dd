"""Changes of a room's pictures, without a renderer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import vusfa.sources.render
from vusfa.errors import SceneError
from vusfa.sources.render import VARIATIONS, Catalogue, Plan, Variation, load_plan, load_variation, poses
from vusfa.sources.render.frames import Frames
from vusfa.sources.render.plan import Camera, Furniture, Light
from vusfa.sources.render.renderer import exposure_of, tone_map
from vusfa.sources.render.variation import vary_picture, vary_plan, vary_poses

PLANS = Path(vusfa.sources.render.__file__).parent / "plans"
ROOM = Plan("room", (2.6, 2.1, 2.6), camera=Camera(resolution=(4, 3)), lights=(Light((1.0, 1.0)),))


def test_no_change_is_the_room_itself() -> None:
    plain, states = Variation(), poses(ROOM)
    assert vary_plan(ROOM, plain, Catalogue.bundled()) is ROOM
    places, headings = vary_poses(states, plain)
    np.testing.assert_array_equal(places, states.location)
    np.testing.assert_array_equal(headings, states.rotation)
    picture = np.random.default_rng(0).integers(0, 256, (3, 4, 3), np.uint8)
    assert vary_picture(picture, plain) is picture


def test_lamps_are_brighter_or_dimmer_and_warmer_and_the_view_is_wider() -> None:
    varied = vary_plan(ROOM, Variation(lamps=0.5, warmth=0.25, fov=1.05), Catalogue.bundled())
    assert varied.lights[0].radiance == pytest.approx((14.0 * 0.625, 13.4 * 0.5, 12.2 * 0.375))
    assert varied.camera.fov == pytest.approx(94.5)
    assert ROOM.lights[0].radiance == (14.0, 13.4, 12.2)


def test_the_camera_is_off_its_place_by_the_distance_and_the_angle() -> None:
    states = poses(ROOM)
    places, headings = vary_poses(states, Variation(offset=0.1, turn=5.0))
    away = places - states.location
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), 0.1, atol=1e-6)
    assert len(np.unique(away.round(6), axis=0)) == states.num_states
    assert set(np.round(headings - states.rotation, 6)) == {-5.0, 5.0}
    again, _ = vary_poses(states, Variation(offset=0.1, turn=5.0))
    np.testing.assert_array_equal(places, again)
    other, _ = vary_poses(states, Variation(offset=0.1, noise_seed=1))
    assert np.abs(other - places).max() > 0.05


@pytest.mark.parametrize(
    ("room", "title"),
    [("bathroom", "Shelves"), ("bedroom", "chair"), ("living_room", "Chair"), ("kitchen", "Chair")],
)
def test_a_chair_moves_and_no_state_comes_or_goes(room: str, title: str) -> None:
    catalogue, plan = Catalogue.bundled(), load_plan(PLANS / f"{room}.yaml")
    varied = vary_plan(plan, Variation(moved=0.3), catalogue)
    pairs = [(a, b) for a, b in zip(plan.furniture, varied.furniture, strict=True) if a != b]
    assert len(pairs) == 1
    before, after = pairs[0]
    assert np.hypot(*np.subtract(before.at, after.at)) == pytest.approx(0.3, abs=1e-3)
    assert title in catalogue[before.model].title
    np.testing.assert_array_equal(poses(varied).graph, poses(plan).graph)
    np.testing.assert_array_equal(poses(varied).location, poses(plan).location)


def test_what_carries_something_stays_and_nothing_that_can_move_is_an_error() -> None:
    box = Furniture("Scopia#5", (0.6, 0.6), size=(0.5, 0.5, 0.5), elevation=0.0)
    plan = Plan(
        "store",
        (2.6, 2.6, 2.6),
        furniture=(box, Furniture("Scopia#5", (0.6, 0.6), 0.0, 0.5, (0.1,) * 3, "top", False)),
    )
    for room in (plan, ROOM):
        with pytest.raises(SceneError, match=r"moved: no piece of furniture can stand 0.3 m from its place"):
            vary_plan(room, Variation(moved=0.3), Catalogue.bundled())


def test_the_exposure_is_that_of_the_room_without_the_change(tmp_path: Path) -> None:
    states = poses(ROOM)

    def brightness(level: float):  # type: ignore[no-untyped-def]
        return lambda x, z, heading, seed: np.full((3, 4, 3), level, np.float32)

    dimmer = Frames(ROOM, states, tmp_path / "a.h5", {}, Variation(lamps=0.5))
    told: list[int] = []
    dimmer.measure(brightness(0.8), lambda: told.append(dimmer.done))
    dimmer.render(brightness(0.4), lambda: told.append(dimmer.done))
    assert told == list(range(1, dimmer.total + 1))
    assert dimmer.complete
    expected = tone_map(np.full((3, 4, 3), 0.4), exposure_of(np.full((1, 3, 4, 3), 0.8)))
    np.testing.assert_array_equal(dimmer.read(0, 1)[0], expected)
    # Frames of another change are rendered anew.
    assert Frames(ROOM, states, tmp_path / "a.h5", {}, Variation(lamps=0.6)).done == 0


def test_blur_keeps_brightness_and_mixes_along_rows_only() -> None:
    picture = np.zeros((2, 100, 3), np.uint8)
    picture[0, 50] = 200
    blurred = vary_picture(picture, Variation(blur=0.05))
    assert blurred.shape == picture.shape
    assert sorted(np.flatnonzero(blurred[0, :, 0])) == [48, 49, 50, 51, 52]
    assert set(blurred[0, 48:53, 0]) == {40}
    assert not blurred[1].any()


def test_jpeg_changes_what_its_quality_takes() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (16, 16, 3), np.uint8)
    apart = [np.abs(vary_picture(noise, Variation(jpeg=q)).astype(int) - noise).mean() for q in (95, 60, 10)]
    assert 0 < apart[0] < apart[1] < apart[2]


def test_noise_seeds_share_no_seed_of_a_state() -> None:
    apart = [v.noise_seed for name, v in VARIATIONS.items() if name.startswith(("train", "validate"))]
    assert len({0, 1, *apart}) == 2 + len(apart) == 10
    seeds = {Variation(noise_seed=k).seed(state) for k in (0, 1, 42_948) for state in (0, 1, 99_999)}
    assert len(seeds) == 9
    assert max(seeds) < 2**32


def test_a_file_of_changes_and_all_its_faults(tmp_path: Path) -> None:
    file = tmp_path / "night.yaml"
    file.write_text("lamps: 0.2\nwarmth: 0.4\njpeg: 30\n")
    assert load_variation(file) == Variation(lamps=0.2, warmth=0.4, jpeg=30)
    file.write_text("lamps: -1\njpeg: 96\nblur: .nan\nfov: .inf\nnoise_seed: 42949\n")
    with pytest.raises(SceneError, match="5 faults") as caught:
        load_variation(file)
    assert all(f"- {name}: " in str(caught.value) for name in ("lamps", "jpeg", "blur", "fov", "noise_seed"))
    file.write_text("lamp: 1")
    with pytest.raises(SceneError, match="lamp: there is no such key; the keys are noise_seed, lamps"):
        load_variation(file)
    file.write_text("- 1")
    with pytest.raises(SceneError, match="the variation: must be a mapping"):
        load_variation(file)
    with pytest.raises(SceneError, match=r"darker: .* one of noise, brighter"):
        load_variation("darker")


@pytest.mark.parametrize(
    ("variation", "message"),
    [
        (Variation(offset=0.3), "offset: 0.3 must be at most the plan's grid.radius, 0.25"),
        (Variation(fov=2.0), r"fov: 2.0 makes camera.fov 180, which must lie in 1..170"),
    ],
)
def test_a_camera_that_leaves_the_free_space_or_the_lens_is_an_error(
    variation: Variation, message: str
) -> None:
    with pytest.raises(SceneError, match=message):
        vary_plan(ROOM, variation, Catalogue.bundled())
