from __future__ import annotations

import numpy as np
import pytest

from vusfa.sources.render.paintings import painting, view
from vusfa.sources.render.plan import Plan, Solid, Surfaces, Zone
from vusfa.sources.render.surfaces import draw_textures
from vusfa.sources.render.textures import FLOORS, WALLS, floor, random_stream, wall


@pytest.mark.parametrize("pattern", WALLS)
def test_a_wall_is_drawn_alike_from_the_same_stream_and_has_its_skirting_board(pattern: str) -> None:
    one, again, other = (wall(pattern, 0.3, 1.5, 2.6, random_stream(seed)) for seed in (4, 4, 5))
    assert one.shape == (338, 195, 3)
    assert one.dtype == np.float32
    np.testing.assert_array_equal(one, again)
    assert np.abs(one - other).mean() > 0.01
    assert one.min() >= 0.02
    assert one.max() <= np.float32(0.97)
    assert np.ptp(one[-10:], axis=(0, 1)).max() == 0  # the board, one colour
    assert np.ptp(one[:300], axis=(0, 1)).max() > 0.05


def test_two_patterns_differ_and_a_stripe_repeats() -> None:
    drawn = [wall(pattern, 0.3, 1.5, 2.6, random_stream(4)) for pattern in WALLS]
    for k, one in enumerate(drawn):
        for other in drawn[:k]:
            assert np.abs(one - other).mean() > 0.01
    # Brightness along a row of stripes changes at least as often as their period of 34 cm says.
    stripe = drawn[WALLS.index("stripe")][100].mean(axis=-1)
    assert (np.abs(np.diff(stripe)) > 0.1).sum() >= 2 * 1.5 / 0.34 - 2


@pytest.mark.parametrize("pattern", FLOORS)
def test_floors(pattern: str) -> None:
    one, again = (floor(pattern, 2.0, 1.5, random_stream(1)) for _ in range(2))
    assert one.shape == (150, 200, 3)
    np.testing.assert_array_equal(one, again)
    assert one.std() > 0.02


def test_paintings_have_frames_and_views_have_none() -> None:
    pictures = [painting(seed, 0.5, 0.4) for seed in range(12)]
    for picture in pictures:
        assert picture.shape == (104, 130, 3)
        border = np.concatenate([picture[:7].reshape(-1, 3), picture[:, -7:].reshape(-1, 3)])
        assert np.ptp(border, axis=0).max() == 0
    for k, one in enumerate(pictures):
        assert all(np.abs(one - other).mean() > 0.02 for other in pictures[:k])
    assert np.ptp(view(3, 0.5, 0.4)[:, 0], axis=0).max() > 0.05
    np.testing.assert_array_equal(view(3, 0.5, 0.4), view(3, 0.5, 0.4))


def test_a_plans_walls_take_the_patterns_that_it_names_and_hues_of_their_own() -> None:
    size = (2.0, 2.0, 2.6)
    one = draw_textures(Plan("a", size, surfaces=Surfaces("tile", 7, ("plain",)))).walls
    assert [texture.shape for texture in one] == [(338, 260, 3)] * 4
    hues = [texture[50:250].mean(axis=(0, 1)) / texture[50:250].mean() for texture in one]
    assert all(np.abs(a - b).max() > 0.01 for k, a in enumerate(hues) for b in hues[:k])
    other = draw_textures(Plan("a", size, surfaces=Surfaces("tile", 7, ("brick",)))).walls
    assert np.abs(one[0] - other[0]).mean() > 0.01


def test_zones_and_lintels_change_no_other_surface() -> None:
    size = (3.0, 2.0, 2.6)
    plain = draw_textures(Plan("a", size, surfaces=Surfaces("tile", 7)))
    zone = Zone((1.0, 0.0, 3.0, 2.0), "wood")
    both = draw_textures(
        Plan("a", size, solids=(Solid((1.0, 0.0, 1.2, 2.0), 2.1),), surfaces=Surfaces("tile", 7, (), (zone,)))
    )
    for a, b in zip(plain.walls, both.walls, strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(plain.floors[0][1], both.floors[0][1])
    assert both.floors[1][1].shape == (200, 200, 3)
    assert len(both.lintels) == 1
