from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vusfa.sources.render.outline import footprint, gap, overlaps, wall_pieces

coordinates = st.floats(-10, 10).map(lambda value: round(value, 3))


def _faces(walls: list) -> set:
    return {(wall.corner, wall.point(wall.length), wall.normal) for wall in walls}


def test_the_walls_of_an_empty_room_go_round_it() -> None:
    assert _faces(wall_pieces(4.0, 3.0)) == {
        ((4.0, 0.0), (0.0, 0.0), (0, 1)),
        ((0.0, 3.0), (4.0, 3.0), (0, -1)),
        ((0.0, 0.0), (0.0, 3.0), (1, 0)),
        ((4.0, 3.0), (4.0, 0.0), (-1, 0)),
    }


def test_a_partition_shows_both_sides_and_its_end_and_hides_what_it_touches() -> None:
    assert _faces(wall_pieces(4.0, 3.0, [(2.0, 0.0, 2.5, 1.0)])) == {
        ((4.0, 0.0), (2.5, 0.0), (0, 1)),
        ((2.0, 0.0), (0.0, 0.0), (0, 1)),
        ((0.0, 3.0), (4.0, 3.0), (0, -1)),
        ((0.0, 0.0), (0.0, 3.0), (1, 0)),
        ((4.0, 3.0), (4.0, 0.0), (-1, 0)),
        ((2.5, 0.0), (2.5, 1.0), (1, 0)),
        ((2.0, 1.0), (2.0, 0.0), (-1, 0)),
        ((2.5, 1.0), (2.0, 1.0), (0, 1)),
    }


def test_every_wall_has_the_room_before_it_and_its_right_end_on_the_right() -> None:
    for wall in wall_pieces(5.0, 4.0, [(0.0, 3.0, 2.0, 4.0), (3.0, 0.0, 3.2, 2.0)]):
        assert wall.along == (-wall.normal[1], wall.normal[0])
        x, z = wall.point(wall.length / 2, 0.01)
        assert 0 < x < 5
        assert 0 < z < 4
        assert not overlaps((0.0, 3.0, 2.0, 4.0), (x, z, x, z))


def test_solids_that_touch_hide_the_faces_between_them() -> None:
    # A wall across the room with a doorway of 1 m, made of two solids; a third closes half of it.
    solids = [(2.0, 0.0, 2.4, 1.0), (2.0, 2.0, 2.4, 3.0), (2.0, 1.0, 2.4, 1.5)]
    faces = [wall for wall in wall_pieces(5.0, 3.0, solids) if wall.normal in ((0, 1), (0, -1))]
    across = [wall for wall in faces if wall.length == pytest.approx(0.4)]
    assert sorted(wall.corner[1] for wall in across) == [1.5, 2.0]


@given(coordinates, coordinates, st.floats(0.1, 3), st.floats(0.1, 3), st.floats(0, 360))
def test_a_footprint_contains_the_corners_of_what_stands_there(
    x: float, z: float, width: float, depth: float, facing: float
) -> None:
    rect = footprint(x, z, width, depth, facing)
    turn = math.radians(facing)
    for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        across, forward = a * width / 2, b * depth / 2
        corner_x = x + across * math.cos(turn) + forward * math.sin(turn)
        corner_z = z - across * math.sin(turn) + forward * math.cos(turn)
        assert gap(rect, corner_x, corner_z) < 1e-9


@given(*[st.tuples(coordinates, coordinates) for _ in range(3)])
def test_gap_is_zero_inside_and_the_distance_to_the_nearest_point_outside(
    a: tuple[float, float], b: tuple[float, float], point: tuple[float, float]
) -> None:
    rect = (min(a[0], b[0]), min(a[1], b[1]), max(a[0], b[0]), max(a[1], b[1]))
    nearest = (min(max(point[0], rect[0]), rect[2]), min(max(point[1], rect[1]), rect[3]))
    assert gap(rect, *point) == pytest.approx(math.dist(point, nearest))
