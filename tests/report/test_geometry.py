"""Floor plans: slices that share a square between them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from vusfa.report.geometry import blocked_edges, floor_plan, outline, slices
from vusfa.report.packing import unpack
from vusfa.report.room_plan import plan_of
from vusfa.scenes import Scene, bundled_names
from vusfa.sources.render import Plan, poses, to_yaml


@pytest.mark.parametrize(
    "headings", [[0, 90, 180, 270], [30, 45, 200], [350, 10], [0, 45, 90, 135, 180, 225, 270, 315]]
)
def test_slices_go_once_around_and_hold_their_headings(headings: list[float]):
    rotation = np.array(headings, dtype=float)
    centre, first, last = slices(np.tile([2.0, 3.0], (len(headings), 1)), rotation)
    assert (centre == [2.0, 3.0]).all()
    assert (last - first).sum() == pytest.approx(360)
    for angle in np.arange(0.3, 360, 1.0):
        inside = np.mod(angle - first, 360) < last - first
        assert inside.sum() == 1
        nearest = np.abs((rotation - angle + 180) % 360 - 180).argmin()
        assert inside[nearest]


def test_one_heading_has_the_whole_square():
    _, first, last = slices(np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([90.0, 0.0]))
    assert (last - first).tolist() == [360, 360]


def test_the_same_pose_twice_is_laid_out():
    centre, first, last = slices(np.zeros((5, 2)), np.zeros(5))
    assert len(np.unique(centre, axis=0)) == 5
    assert ((last - first) == 360).all()


def test_a_plan_is_the_scene(make_scene):
    scene: Scene = make_scene("hall", 3, 2)
    plan = floor_plan(scene)
    assert (plan["name"], plan["states"], plan["metre"]) == ("hall", 24, 2.0)
    assert (plan["width"], plan["height"]) == (3, 2)
    corner = scene.location - torch.tensor([0.0, 0.5])  # upper left, +z up
    corner -= scene.location.amin(0)
    assert torch.allclose(torch.tensor([plan["x"], plan["y"]]).T - 0.5, corner * torch.tensor([2.0, -2.0]))
    assert plan["heading"] == scene.rotation.tolist()
    leads = torch.from_numpy(unpack(plan["next"]))
    blocked = scene.graph < 0
    assert (leads[~blocked] == scene.graph[~blocked]).all()
    assert (leads == torch.arange(24)[:, None])[blocked].all()


def test_a_scene_without_places(make_scene):
    plan = floor_plan(Scene("nowhere", make_scene().graph, make_scene().features))
    assert plan["metre"] is None
    assert len(set(zip(plan["x"], plan["y"], strict=True))) == 16


def test_outlines_fill_the_square():
    """Their areas sum to it, whatever the headings, and the middle of each lies inside."""

    def area(path: str) -> float:
        points = np.array([point.split() for point in path[1:-1].split("L")], dtype=float)
        x, y = points.T
        return 0.5 * abs(float(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1))))

    for headings in ([0, 90, 180, 270], [30, 45, 200], [350, 10], [5]):
        _, first, last = slices(np.zeros((len(headings), 2)), np.array(headings, dtype=float))
        parts = [area(outline(1.5, 0.5, a, b)) for a, b in zip(first, last, strict=True)]
        assert sum(parts) == pytest.approx(0.94**2, abs=0.01)


@pytest.mark.parametrize("name", bundled_names())
def test_bundled_rooms_have_their_walls_and_furniture(name: str):
    """Whatever blocks lies outside of the places, and all of it within the room."""
    room = Scene.bundled(name)
    plan = floor_plan(room)
    x, y, width, height = plan["room"]
    assert "edges" not in plan
    blocking = [thing["rect"] for thing in plan["things"] if thing["kind"] == "furniture"]
    assert len(blocking) > 8
    places = np.array([plan["x"], plan["y"]]).T
    assert ((places > [x, y]) & (places < [x + width, y + height])).all()
    for left, top, wide, high in [*blocking, *plan["solids"]]:
        inside = (places > [left, top]) & (places < [left + wide, top + high])
        assert not inside.all(1).any()
    assert all("#" not in thing["name"] for thing in plan["things"])


def test_a_dump_with_another_plan_has_none():
    """A plan is drawn where the scene's own graph and poses follow from it, and nowhere else."""
    plan = Plan("cell", size=(1.6, 1.1, 2.6))
    room = poses(plan)
    arrays = (torch.from_numpy(room.graph), torch.rand(len(room.graph), 1, 2))

    def cell(text: object, location: np.ndarray = room.location) -> Scene:
        where = {"location": torch.from_numpy(location), "rotation": torch.from_numpy(room.rotation)}
        return Scene("cell", *arrays, **where, attributes={"plan": text})

    assert plan_of(cell(to_yaml(plan))) == plan
    for wrong in (
        "a sheet in the office",
        "plan.yaml",
        "name: [",
        to_yaml(Plan("x", size=(2.1, 1.1, 2.6))),
        7,
    ):
        assert plan_of(cell(wrong)) is None
    assert plan_of(cell(to_yaml(plan), room.location + 0.1)) is None
    drawn = floor_plan(cell(to_yaml(plan)))
    assert drawn["room"] == pytest.approx([-0.1, -0.1, 3.2, 2.2])
    assert floor_plan(cell("elsewhere"))["edges"]


def test_blocked_steps_are_the_edges_of_an_empty_room(make_scene):
    scene: Scene = make_scene("hall", 3, 2)
    plan = floor_plan(scene)
    assert sum(abs(x1 - x0) + abs(y1 - y0) for x0, y0, x1, y1 in plan["edges"]) == pytest.approx(10)
    assert {min(edge[1], edge[3]) for edge in plan["edges"]} == {0, 1, 2}
    turned = Scene("turned", scene.graph, scene.features, scene.location, scene.rotation + 45)
    assert blocked_edges(turned, np.array(plan["x"]), np.array(plan["y"])) == []
