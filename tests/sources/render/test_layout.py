from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

import vusfa.sources.render
from vusfa.errors import SceneError
from vusfa.scenes import Scene, bundled_names
from vusfa.scenes.graph import strong_components
from vusfa.sources.render import Plan, layout, load_plan, poses, to_yaml
from vusfa.sources.render.faults import plan_faults
from vusfa.sources.render.kinds import KINDS
from vusfa.sources.render.layout import best_lamps
from vusfa.sources.render.outline import footprint, overlaps

PLANS = Path(vusfa.sources.render.__file__).parent / "plans"


@pytest.mark.parametrize("name", bundled_names())
def test_the_bundled_rooms_are_drawn_again_from_seed_1(name: str) -> None:
    plan = layout(name, seed=1)
    room, bundled = poses(plan), Scene.bundled(name)
    np.testing.assert_array_equal(room.graph, bundled.graph.numpy())
    np.testing.assert_array_equal(room.location, bundled.location.numpy())
    np.testing.assert_array_equal(room.rotation, bundled.rotation.numpy())
    assert {line.split()[0] for line in bundled.attributes["models"]} == set(plan.models)
    assert load_plan(PLANS / f"{name}.yaml") == plan


SMALL = [
    ("bathroom", 3, None),
    ("hall", 3, 30),
    ("living_room", 5, 250),
    ("kitchen", 2, 60),
    ("bedroom", 4, 120),
]


@pytest.fixture(scope="module", params=SMALL, ids=lambda of: f"{of[0]}-{of[1]}")
def drawn(request: pytest.FixtureRequest) -> tuple[Plan, int]:
    kind, seed, cells = request.param
    return layout(kind, seed, cells), cells or KINDS[kind].cells


def test_a_drawn_room_is_sound_and_as_large_as_asked(drawn: tuple[Plan, int]) -> None:
    plan, cells = drawn
    assert plan_faults(plan) == []
    room = poses(plan)
    assert len(room.cells) == pytest.approx(cells, abs=max(4, 0.05 * cells))
    assert len(strong_components(room.graph)) == 1


def test_furniture_neither_overlaps_nor_stands_in_walls_or_doors(drawn: tuple[Plan, int]) -> None:
    plan, _ = drawn
    standing = [item for item in plan.furniture if item.role == "floor"]
    assert standing
    for a, b in itertools.combinations(standing, 2):
        assert not overlaps(a.rect, b.rect, -2e-4), (a, b)
    for item in standing:
        assert not any(overlaps(item.rect, solid.rect, -2e-4) for solid in plan.solids), item
    doors = [item for item in plan.furniture if item.role == "door"]
    assert len(doors) == 2
    for door in doors:
        assert door.size is not None
        turn = np.radians(door.facing)
        before = (door.at[0] + 0.4 * np.sin(turn), door.at[1] + 0.4 * np.cos(turn))
        clear = footprint(*before, door.size[0], 0.8, door.facing)
        assert not any(overlaps(item.rect, clear, -2e-4) for item in standing), door


def test_pictures_windows_and_doors_hang_on_walls_apart_from_one_another(drawn: tuple[Plan, int]) -> None:
    plan, _ = drawn
    spans = [(item.at, item.facing, item.size[0]) for item in (*plan.pictures, *plan.windows) if item.size]
    spans += [
        (item.at, item.facing, item.size[0]) for item in plan.furniture if item.role == "door" and item.size
    ]
    for (x, z), facing, width in spans:
        on = [wall for wall in plan.walls if wall.facing == facing and _along(wall, x, z, width)]
        assert len(on) == 1
    for a, b in itertools.combinations(spans, 2):
        rects = [footprint(*at, width, 0.001, facing) for at, facing, width in (a, b)]
        assert not overlaps(*rects)
    assert len({picture.seed for picture in plan.pictures}) == len(plan.pictures)


def _along(wall, x: float, z: float, width: float) -> bool:
    dx, dz = x - wall.corner[0], z - wall.corner[1]
    out = dx * wall.normal[0] + dz * wall.normal[1]
    t = dx * wall.along[0] + dz * wall.along[1]
    return abs(out) < 1e-3 and width / 2 - 1e-3 <= t <= wall.length - width / 2 + 1e-3


def test_the_same_seed_gives_the_same_room_and_another_seed_another() -> None:
    one, again, other = (layout("bathroom", seed) for seed in (8, 8, 9))
    assert to_yaml(one) == to_yaml(again)
    assert one.furniture != other.furniture
    assert one.surfaces.seed != other.surfaces.seed


def test_unknown_kinds_and_tiny_rooms_are_errors() -> None:
    with pytest.raises(SceneError, match="no kind of room is called 'attic'"):
        layout("attic")
    with pytest.raises(SceneError, match="cells: 3 is too few"):
        layout("hall", cells=3)


def test_lamps_go_where_they_light_most() -> None:
    row = np.stack([np.arange(5.0), np.zeros(5)], axis=1)
    assert best_lamps(row, []) == [2]
    # A wall that cuts off the last place leaves the other four: the middle of them.
    assert best_lamps(row, [(3.4, -1.0, 3.6, 1.0)]) in ([1], [2])
    long = np.stack([np.arange(64.0) * 0.5, np.zeros(64)], axis=1)
    a, b = sorted(best_lamps(long, []))
    light = 1 / ((long[:, None] - long).__pow__(2).sum(-1) + 2)
    best = max(np.log(light[i] + light[j]).mean() for i in range(64) for j in range(i))
    assert np.log(light[a] + light[b]).mean() == pytest.approx(best, rel=0.02)
    assert a < 32 <= b
