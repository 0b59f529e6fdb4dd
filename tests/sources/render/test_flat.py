from __future__ import annotations

import itertools

import numpy as np
import pytest

from vusfa.errors import SceneError
from vusfa.scenes.graph import strong_components
from vusfa.sources.render.faults import plan_faults
from vusfa.sources.render.flat import flat
from vusfa.sources.render.grid import poses
from vusfa.sources.render.outline import overlaps
from vusfa.sources.render.plan import Plan

KINDS = ["kitchen", "hall", "bathroom"]


@pytest.fixture(scope="module")
def plan() -> Plan:
    return flat(KINDS, seed=3, cells=150)


def _extents(plan: Plan) -> list[tuple[float, float]]:
    """Where the rooms begin and end along X, by the walls between them."""
    dividing = sorted({(solid.rect[0], solid.rect[2]) for solid in plan.solids if solid.bottom > 0})
    edges = [0.0, *itertools.chain(*dividing), plan.size[0]]
    return list(zip(edges[::2], edges[1::2], strict=True))


def test_all_rooms_are_one_connected_scene(plan: Plan) -> None:
    assert plan_faults(plan) == []
    room = poses(plan)
    assert len(strong_components(room.graph)) == 1
    assert len(room.cells) == pytest.approx(150, rel=0.25)
    extents = _extents(plan)
    assert len(extents) == 3
    for low, high in extents:
        inside = (room.location[:, 0] > low) & (room.location[:, 0] < high)
        assert inside.sum() > 4 * 20


def test_one_place_lies_in_each_doorway_and_joins_its_rooms(plan: Plan) -> None:
    room = poses(plan)
    lintels = [solid.rect for solid in plan.solids if solid.bottom > 0]
    assert len(lintels) == 2
    for x0, z0, x1, z1 in lintels:
        x, z = room.location.T
        there = np.flatnonzero((x > x0) & (x < x1) & (z > z0) & (z < z1))
        assert len(there) == 4
        ahead = [state for state in there if room.rotation[state] == 90.0]
        row = room.graph[ahead[0]]
        assert row[0] >= 0
        assert row[3] >= 0
        # Everything on the left is reached through this place alone.
        assert ((x > x0) & (x < x1)).sum() == 4


def test_furniture_stays_in_its_room(plan: Plan) -> None:
    standing = [item for item in plan.furniture if item.role == "floor"]
    for a, b in itertools.combinations(standing, 2):
        assert not overlaps(a.rect, b.rect, -2e-4)
    for item in standing:
        assert not any(overlaps(item.rect, solid.rect, -2e-4) for solid in plan.solids if not solid.bottom)


def test_the_same_seed_gives_the_same_flat() -> None:
    assert flat(["bathroom", "hall"], 2, 60) == flat(["bathroom", "hall"], 2, 60)
    assert flat(["bathroom", "hall"], 2, 60) != flat(["bathroom", "hall"], 4, 60)


def test_too_few_and_too_many_rooms_are_errors() -> None:
    for kinds in (["hall"], ["hall"] * 6):
        with pytest.raises(SceneError, match="a flat has 2 to 5 rooms"):
            flat(kinds)
    with pytest.raises(SceneError, match="no kind of room is called 'attic'"):
        flat(["hall", "attic"])
