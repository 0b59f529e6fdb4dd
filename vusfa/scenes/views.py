"""What is in view from a pose: places within the camera's angle, along free places of the grid."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from vusfa.errors import SceneError
from vusfa.limits import brief
from vusfa.scenes.poses import step_length

if TYPE_CHECKING:
    from vusfa.scenes.scene import Scene

__all__ = ["FIELD_OF_VIEW", "cells_between", "grid_cells", "places_in_view"]

#: Degrees, of scenes whose attributes have no ``hfov_deg``: that of AI2-THOR's camera and of rendered rooms.
FIELD_OF_VIEW = 90.0
#: Cells along a side of the smallest square around a room: poses that lie farther apart are on no grid.
MOST_CELLS = 1024


def grid_cells(scene: Scene) -> np.ndarray:
    """The cell (N, 2) int64 of each state: its place in steps from the room's corner.

    Raises:
        SceneError: the nearest two places are so near that the room has more than :data:`MOST_CELLS` cells
            along a side.
    """
    location, step = scene.location.double().numpy(), step_length(scene.location)
    cell = np.rint((location - location.min(0)) / step)
    if cell.max() > MOST_CELLS:
        raise SceneError(
            f"scene {brief(scene.name)}: its nearest places are {step:.3g} m apart, so that its poses lie on"
            f" no grid of at most {MOST_CELLS} cells; correct dataset 'location'"
        )
    return cell.astype(np.int64)


def cells_between(right: int, ahead: int) -> np.ndarray:
    """Cells of a grid that the straight line between the middles of two cells crosses, the ends among them.

    A cell counts when the line passes through its inside; touching a corner does not count.

    Args:
        right, ahead: the last cell, relative to the first.

    Returns:
        (n, 2) int64, relative to the first.

    >>> cells_between(2, 1).tolist(), cells_between(-1, -1).tolist()
    ([[0, 0], [1, 0], [1, 1], [2, 1]], [[0, 0], [-1, -1]])
    """
    # the line is (right t, ahead t); it enters another cell where a coordinate is a half
    crossings = [(np.arange(abs(side)) + 0.5) / abs(side) for side in (right, ahead) if side]
    at = np.unique(np.concatenate([[0.0, 1.0], *crossings]).round(12))
    within = (at[1:] + at[:-1]) / 2
    return np.rint(np.outer(within, [right, ahead])).astype(np.int64)


def places_in_view(scene: Scene) -> Tensor:
    """Whether the place of one state is in view from another.

    It is when it lies within half of the camera's horizontal angle to either side of the heading
    (attribute ``hfov_deg``, otherwise :data:`FIELD_OF_VIEW`; both edges count) and every cell of the grid
    on the straight line to it is a place of the scene. The state's own place counts as in view. Low
    furniture, over which a camera sees, therefore hides what is behind it, as a wall does. Heights are not
    considered. In a scene whose poses are not known, all at one place, everything is in view.

    Returns:
        (N, N) bool, ``[s, t]`` for the place of t from s.

    Raises:
        SceneError: see :func:`grid_cells`.

    >>> from vusfa.scenes import Scene
    >>> view = places_in_view(Scene.bundled("bathroom"))
    >>> view.shape, round(view.double().mean().item(), 2)
    (torch.Size([176, 176]), 0.17)
    """
    cells, place = np.unique(grid_cells(scene), axis=0, return_inverse=True)
    place = place.reshape(-1)
    apart = cells[None] - cells[:, None]  # (P, P, 2)
    clear = _clear(cells, apart)[place][:, place]
    bearing = np.degrees(np.arctan2(apart[..., 0], apart[..., 1]))[place][:, place]
    off = np.abs((bearing - scene.rotation.double().numpy()[:, None] + 180) % 360 - 180)
    given = scene.attributes.get("hfov_deg")
    angle = given if isinstance(given, int | float) else FIELD_OF_VIEW
    return torch.from_numpy((clear & (off <= angle / 2 + 1e-6)) | (place[:, None] == place))


def _clear(cells: np.ndarray, apart: np.ndarray) -> np.ndarray:
    """Whether all cells on the line between each two of P places are places, (P, P) bool."""
    free = np.zeros(cells.max(0) + 1, bool)
    free[tuple(cells.T)] = True
    clear = np.zeros(apart.shape[:2], bool)
    for right, ahead in np.unique(apart.reshape(-1, 2), axis=0).tolist():
        one, other = np.nonzero((apart == (right, ahead)).all(-1))
        line = cells[one][:, None] + cells_between(right, ahead)  # (pairs, n, 2)
        clear[one, other] = free[tuple(np.moveaxis(line, -1, 0))].all(1)
    return clear
