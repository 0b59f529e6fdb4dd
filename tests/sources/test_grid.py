"""Poses to moves: exact grids, measured ones, turned ones, and what does not fit."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vusfa.errors import SceneError
from vusfa.scenes import Scene
from vusfa.sources.grid import GridPoses, fit_offset, fit_step, fit_turn, put_on_grid


def named(count: int) -> list[str]:
    return [f"line {index + 2}" for index in range(count)]


def turned(location: np.ndarray, degrees: float) -> np.ndarray:
    """Clockwise from above: what was at heading 0 is at heading ``degrees``."""
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    x, z = location.T
    return np.stack([x * cos + z * sin, z * cos - x * sin], 1)


def rectangle(width: int, height: int, headings: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Poses of every heading at every place (x, z) of a grid of 1 m, by place."""
    location = [[x, z] for x in range(width) for z in range(height) for _ in headings]
    return np.array(location, float), np.array(headings * (width * height), float)


@settings(max_examples=40)
@given(
    noise=st.sampled_from([0.0, 0.02]),
    frame=st.floats(-180, 180),
    step=st.sampled_from([0.25, 0.5, 1.0, 0.333]),
    shift=st.floats(-50, 50),
    seed=st.integers(0, 100),
)
def test_a_room_comes_out_of_its_poses(
    noise: float, frame: float, step: float, shift: float, seed: int
) -> None:
    """A bundled room, scaled, turned, shifted and measured badly; its states shuffled."""
    room = Scene.bundled("bathroom")
    rng = np.random.default_rng(seed)
    order = rng.permutation(room.num_states)
    exact = turned(room.location.double().numpy() * step / 0.5, frame) + shift
    headings = room.rotation.double().numpy() + frame
    location = exact + rng.normal(0, noise * step, exact.shape)
    rotation = headings + rng.normal(0, 100 * noise, headings.shape)
    found = put_on_grid(location[order], rotation[order], named(len(order)))
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    graph = room.graph.numpy()[order]
    assert np.array_equal(found.graph, np.where(graph >= 0, place[graph], -1))
    assert found.step == pytest.approx(step, rel=0.005)
    assert found.turn == 90
    assert np.abs(found.location - exact[order]).max() < (0.3 * step if noise else 0.02 * step)
    off = (found.rotation - headings[order] + 180) % 360 - 180
    assert np.abs(off).max() <= (3.0 if noise else 2.01)


def test_moves_by_hand() -> None:
    """Three places in an L, looking along +Z (0) and +X (90) only."""
    location = np.array([[0.0, 0.0], [0.0, 0.0], [0.0, 2.0], [0.0, 2.0], [2.0, 0.0]])
    rotation = np.array([0.0, 90.0, 0.0, 90.0, 90.0])
    found = put_on_grid(location, rotation, named(5), turn=90)
    forward, right, left, backward = found.graph.T.tolist()
    assert forward == [2, 4, -1, -1, -1]
    assert backward == [-1, -1, 0, -1, 1]
    assert right == [1, -1, 3, -1, -1]
    assert left == [-1, 0, -1, 2, -1]
    assert (found.step, found.turn) == (2.0, 90)
    assert np.array_equal(found.location, location)
    assert np.array_equal(found.rotation, rotation)


def test_diagonal_headings_lead_to_diagonal_neighbours() -> None:
    location, rotation = rectangle(3, 3, [45.0 * k for k in range(8)])
    found = put_on_grid(location, rotation, named(72))
    assert found.turn == 45
    middle = 8 * 4  # x = 1, z = 1
    for heading, (x, z) in enumerate(
        [(1, 2), (2, 2), (2, 1), (2, 0), (1, 0), (0, 0), (0, 1), (0, 2)],
    ):
        assert found.graph[middle + heading, 0] == 8 * (3 * x + z) + heading
        assert found.graph[middle + heading, 1] == middle + (heading + 1) % 8
        assert found.graph[middle + heading, 2] == middle + (heading - 1) % 8
        assert found.graph[middle + heading, 3] == 8 * (3 * (2 - x) + 2 - z) + heading


def test_one_heading_cannot_turn() -> None:
    location, rotation = rectangle(1, 3, [30.0])
    found = put_on_grid(turned(location, 30), rotation, named(3))
    assert found.turn == 360
    assert found.graph.tolist() == [[1, -1, -1, -1], [2, -1, -1, 0], [-1, -1, -1, 1]]


def test_two_headings_turn_round() -> None:
    location, rotation = rectangle(1, 2, [0.0, 180.0])
    found = put_on_grid(location, rotation, named(4))
    assert found.graph.tolist() == [[2, 1, 1, -1], [-1, 0, 0, 3], [-1, 3, 3, 0], [1, 2, 2, -1]]


@pytest.mark.parametrize(
    ("headings", "turn"),
    [([5, 5, 6], 360), ([0, 180], 180), ([0, 90], 90), ([359, 91, 181], 90), ([0, 45], 45), ([12, 57], 45)],
)
def test_the_widest_turn_that_fits(headings: list[float], turn: int) -> None:
    assert fit_turn(np.array(headings, float)) == turn


def test_one_odd_heading_does_not_make_a_finer_grid() -> None:
    location, rotation = rectangle(3, 3, [0.0, 90.0, 180.0, 270.0])
    rotation[5] = 135.0
    with pytest.raises(SceneError, match=r"line 7: heading 135 is 45 degrees off the nearest of 0, 90, "):
        put_on_grid(location, rotation, named(36))


@pytest.mark.parametrize("period", [0.5, 90.0])
def test_an_offset_does_without_outliers(period: float) -> None:
    values = np.concatenate([period * (np.arange(20) + 0.1), [period * 3.6]])
    assert fit_offset(values, period) == pytest.approx(0.1 * period, abs=1e-9)


def test_steps_and_turns_are_exact_over_a_long_way() -> None:
    """Headings that are 1.5 degrees wrong throughout, and a first step that is 3 % wrong, add up over 80."""
    rng = np.random.default_rng(0)
    location = np.array([[x, z] for x in (0, 1) for z in range(80)]) * 0.3333
    location = turned(location, 1.5) + rng.normal(0, 0.01, (160, 2))
    found = put_on_grid(location, rng.normal(0, 1, 160), named(160))
    assert found.step == pytest.approx(0.3333, rel=0.001)
    assert found.graph[:, 0].tolist() == [*range(1, 80), -1, *range(81, 160), -1]
    assert np.abs(found.location - location).max() < 0.05


def test_the_rough_step_needs_no_pose_twice() -> None:
    """The heading tells apart what is measured at one place; a near-duplicate among many changes nothing."""
    location = np.array([[0.0, 0.0], [0.01, 0.0], [0.0, 1.0], [0.01, 1.0], [0.0, 2.0], [0.02, 2.0]])
    assert fit_step(location, np.array([0, 1, 0, 1, 0, 1])) == pytest.approx(1.0, rel=0.01)
    assert fit_step(location[:2], np.array([0, 1])) == 1.0


def test_poses_off_the_grid_are_all_listed() -> None:
    location, rotation = rectangle(4, 4, [0.0, 90.0, 180.0, 270.0])
    location[7] += 0.4
    location[9, 0] -= 0.3
    with pytest.raises(SceneError) as caught:
        put_on_grid(location, rotation, named(64), source="poses.csv")
    lines = str(caught.value).splitlines()
    assert lines[0] == "poses.csv: 2 faults"
    assert lines[1].startswith(
        "  - line 9: lies 0.57 m from (0.00, 1.00), the nearest place of a grid of 1 m;"
    )
    assert lines[2].startswith("  - line 11: lies 0.30 m from (0.00, 2.00)")


def test_a_pose_can_be_there_only_once() -> None:
    location, rotation = rectangle(3, 3, [0.0, 90.0, 180.0, 270.0])
    location[4:6] = location[0]
    rotation[4:6] = [1.0, 20.0]
    with pytest.raises(SceneError) as caught:
        put_on_grid(location, rotation, named(36))
    assert "line 6: is the same pose as line 2, within a grid of 1 m; take one of them out" in str(
        caught.value
    )
    assert "line 7: heading 20 is 20 degrees off" in str(caught.value)


def test_what_is_given_is_not_inferred() -> None:
    location = np.array([[0.0, 0.0], [0.0, 2.0], [0.0, 4.0]])
    assert put_on_grid(location, np.zeros(3), named(3)).graph[0, 0] == 1
    assert put_on_grid(location, np.zeros(3), named(3), step=1.0).graph[0, 0] == -1
    assert put_on_grid(location, np.zeros(3), named(3), turn=45).turn == 45


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"turn": 30}, "a turn is 30 degrees; it must be one of 45, 90, 180, 360"),
        ({"step": 0.0}, "a step is 0.0 metres; it must be more than 0"),
        ({"step": math.nan}, "a step is nan metres"),
    ],
)
def test_impossible_grids(options: dict[str, float], message: str) -> None:
    with pytest.raises(SceneError, match=message):
        put_on_grid(np.zeros((1, 2)), np.zeros(1), ["a"], **options)  # type: ignore[arg-type]


def test_a_single_pose_is_a_grid() -> None:
    found = put_on_grid(np.array([[3.0, 4.0]]), np.array([77.0]), ["a"])
    assert isinstance(found, GridPoses)
    assert found.graph.tolist() == [[-1] * 4]
    assert np.allclose(found.location, [[3.0, 4.0]], atol=1e-3)
    assert found.rotation == pytest.approx([77.0])
