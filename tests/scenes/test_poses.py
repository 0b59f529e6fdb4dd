"""Places and poses, measured and shown."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch

from vusfa.scenes import Scene
from vusfa.scenes.poses import places, spread_poses, step_length
from vusfa.sources.sheet import draw_floor, draw_sheet, save_sheet
from vusfa.sources.summary import summarize


@pytest.mark.parametrize(("width", "height"), [(1, 1), (5, 1), (3, 4)])
def test_places_and_their_step(make_scene: Callable[..., Scene], width: int, height: int) -> None:
    scene = make_scene("hall", width, height)
    assert len(places(scene.location)) == width * height
    assert step_length(scene.location) == (0.5 if width * height > 1 else 1.0)


def test_the_step_of_a_bundled_room() -> None:
    assert step_length(Scene.bundled("living_room").location) == pytest.approx(0.5, abs=1e-5)


def test_poses_are_spread_over_the_room(make_scene: Callable[..., Scene]) -> None:
    scene = make_scene("hall", 9, 9)
    chosen = spread_poses(scene.location, scene.rotation, 9)
    assert len(set(chosen)) == 9
    assert scene.location[chosen[0]].tolist() == [2.0, 2.0], "the middle"
    at = scene.location[chosen].double()
    apart = torch.cdist(at, at) + 9 * torch.eye(9)
    corners = torch.tensor([[0.0, 0.0], [4.0, 0.0], [0.0, 4.0], [4.0, 4.0]]).double()
    assert torch.cdist(corners, at).amin(1).max() <= 1.0, "every corner is shown"
    assert apart.min() > 0 or len({scene.rotation[state].item() for state in chosen}) > 1


def test_headings_are_spread_where_all_poses_are_in_one_place() -> None:
    rotation = torch.tensor([350.0, 0.0, 10.0, 90.0, 180.0, 270.0])
    chosen = spread_poses(torch.zeros(6, 2), rotation, 4)
    assert sorted(rotation[chosen].tolist()) in ([0, 90, 180, 270], [90, 180, 270, 350])


def test_more_than_there_are_is_all(make_scene: Callable[..., Scene]) -> None:
    scene = make_scene("hall", 1, 1)
    assert sorted(spread_poses(scene.location, scene.rotation, 9)) == [0, 1, 2, 3]
    assert sorted(spread_poses(torch.zeros(3, 2), torch.zeros(3), 9)) == [0, 1, 2], (
        "even where all are the same"
    )


def test_a_summary_by_hand() -> None:
    """right, left on a line of three, and an island of one."""
    graph = torch.tensor([[1, -1], [2, 0], [-1, 1], [-1, -1]])
    location = torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [9.0, 0.0]])
    found = summarize(Scene("line", graph, torch.rand(4, 2, 3), location), walk_steps=2)
    assert (found.name, found.states, found.cells, found.actions) == ("line", 4, 4, 2)
    assert (found.crops, found.features, found.islands, found.picture_shape) == (2, 3, 1, None)
    # 0-1, 1-2 both ways are 1; 0-2 both ways are 2
    assert (found.mean_path, found.longest_path) == (pytest.approx(8 / 6), 2)
    # Goal 0: 1/2 from state 1, 1/4 from state 2; goal 2 is its mirror. Goal 1: 1/2 + 1/2 * 1/2 from both.
    assert found.random_walk == pytest.approx((0.375 + 0.75 + 0.375) / 3)


def test_a_summary_without_any_path_is_json_all_the_same() -> None:
    found = summarize(Scene("spot", torch.tensor([[-1]]), torch.rand(1, 1, 2)))
    assert math.isnan(found.mean_path)
    assert found.plain()["mean_path"] is None
    assert found.plain()["random_walk"] is None
    assert found.longest_path == 0


def test_sheets_are_drawn_of_every_kind_of_scene(
    make_scene: Callable[..., Scene], scene_file, tmp_path
) -> None:
    no_pictures = make_scene("hall", 3, 2)
    islands = Scene("two", torch.tensor([[1], [0], [2]]), torch.rand(3, 1, 2), torch.eye(3)[:, :2])
    spot = Scene("spot", torch.tensor([[1], [0]]), torch.rand(2, 1, 2))
    for scene in (no_pictures, islands, spot, Scene.load(scene_file)):
        assert draw_sheet(scene, 3).startswith(b"\x89PNG")
    target = tmp_path / "folder" / "a.png"
    target.parent.mkdir()
    assert save_sheet(spot, target) == target
    assert [path.name for path in target.parent.iterdir()] == ["a.png"]


def test_a_sheet_shows_the_scenes_pictures(make_scene: Callable[..., Scene], tmp_path) -> None:
    """Pictures of one colour each: those chosen, and no others, are on the sheet."""
    import io

    import numpy as np
    from PIL import Image

    scene = make_scene("hall", 2, 2)
    colours = np.array([[10 * state, 255 - 10 * state, 128] for state in range(16)], np.uint8)
    scene.save(tmp_path / "hall.h5", np.broadcast_to(colours[:, None, None], (16, 30, 40, 3)).copy())
    with Image.open(io.BytesIO(draw_sheet(Scene.load(tmp_path / "hall.h5"), 5))) as image:
        pixels = np.asarray(image.convert("RGB")).reshape(-1, 3)
    seen = [state for state in range(16) if (pixels == colours[state]).all(1).sum() > 1000]
    ahead = scene.graph[:, 0] >= 0
    candidates = ahead.nonzero().squeeze(1)
    chosen = candidates[spread_poses(scene.location[ahead], scene.rotation[ahead], 5)]
    assert seen == sorted(chosen.tolist())


def test_the_floor_has_every_place_and_pose_where_it_is() -> None:
    """Two places half a metre apart, two headings at the first; the second is an island."""
    from matplotlib.colors import to_hex
    from matplotlib.figure import Figure

    location = torch.tensor([[1.0, 2.0], [1.0, 2.0], [1.5, 2.0]])
    scene = Scene(
        "two", torch.tensor([[1], [0], [2]]), torch.rand(3, 1, 2), location, torch.tensor([0, 90, 180])
    )
    axis = Figure().subplots()
    draw_floor(axis, scene, shown=[1])
    squares, darts = axis.collections
    corners = sorted(path.get_extents().extents.tolist() for path in squares.get_paths())
    assert corners == [pytest.approx([0.75, 1.75, 1.25, 2.25]), pytest.approx([1.25, 1.75, 1.75, 2.25])]
    # Darts lie within their place, ahead of its middle, and point where the pose looks: +Z, +X, -Z.
    ahead = torch.tensor([[0.0, 1.0], [1.0, 0.0], [0.0, -1.0]]).double()
    tails, points = (
        torch.tensor(darts.get_offsets()),
        torch.stack([torch.tensor(darts.U), torch.tensor(darts.V)], 1),
    )
    assert torch.allclose(tails - location, ahead * 0.06, atol=1e-6)
    assert torch.allclose(points, ahead * 0.13, atol=1e-6)
    grey, blue, red = (to_hex(colour) for colour in darts.get_facecolors())
    assert len({grey, blue, red}) == 3
    assert (blue, red) == ("#1f61b2", "#d6452c"), "shown; cut off"
    (number,) = axis.texts
    assert number.get_text() == "1"
    assert number.get_position() == pytest.approx((1.15, 2.0))
    assert axis.get_xlim() == pytest.approx((0.5, 2.0))
    assert axis.get_ylim() == pytest.approx((1.5, 2.5))
