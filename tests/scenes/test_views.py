from __future__ import annotations

import pytest
import torch

from vusfa.errors import SceneError
from vusfa.scenes import Scene
from vusfa.scenes.views import cells_between, places_in_view


def test_cells_on_a_line_by_a_dense_walk() -> None:
    """Points close together along the line are in the same cells; corners are left out."""
    for right in range(-5, 4):
        for ahead in range(-5, 4):
            crossed = set()
            for step in range(4001):
                x, z = right * step / 4000, ahead * step / 4000
                if abs(abs(x % 1) - 0.5) > 1e-3 and abs(abs(z % 1) - 0.5) > 1e-3:
                    crossed.add((round(x), round(z)))
            assert {tuple(cell) for cell in cells_between(right, ahead).tolist()} == crossed | {(0, 0)}


def test_what_is_in_view_by_hand() -> None:
    """A corridor along X that turns at its end: places (0, 0), (1, 0), (2, 0), (2, 1), one heading each.

    No place is at (1, 1), which hides the last one from the first; from the second its corner is passed.
    """
    location = torch.tensor([[0.0, 0], [1, 0], [2, 0], [2, 1]]) / 2 + 3
    graph = torch.full((4, 4), -1)
    heading = torch.tensor([90.0, 270, 45, 180])  # along +X, along -X, between +X and +Z, along -Z

    def seen(angle: float) -> list[list[int]]:
        scene = Scene("l", graph, torch.rand(4, 1, 2), location, heading, attributes={"hfov_deg": angle})
        return places_in_view(scene).int().tolist()

    assert seen(90.0) == [[1, 1, 1, 0], [1, 1, 0, 0], [0, 0, 1, 1], [0, 1, 1, 1]]
    assert seen(60.0)[2] == [0, 0, 1, 0]  # (2, 1) lies 45 degrees to the left


def test_poses_that_are_not_known_and_poses_on_no_grid() -> None:
    graph = torch.tensor([[1, -1, -1, -1], [0, -1, -1, -1]])
    assert places_in_view(Scene("blind", graph, torch.rand(2, 1, 2))).all()
    apart = torch.tensor([[0.0, 0], [0.01, 0]] + [[50.0, 0]] * 2)
    with pytest.raises(SceneError, match=r"'far'.*0\.01 m apart"):
        places_in_view(Scene("far", torch.full((4, 1), -1), torch.rand(4, 1, 2), apart, actions=("stay",)))
