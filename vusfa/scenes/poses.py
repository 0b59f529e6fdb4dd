"""Geometry of a scene's poses: distances between places, and poses spread over the room."""

from __future__ import annotations

import math

import torch
from torch import Tensor

__all__ = ["dart", "places", "spread_poses", "step_length"]


def places(location: Tensor) -> Tensor:
    """The distinct places (P, 2) among the locations (N, 2) of poses."""
    return location.unique(dim=0)


def dart(heading: float = 0.0) -> list[tuple[float, float]]:
    """Corners of the dart that marks a pose on maps, relative to its centre; y downwards, at most 1 away.

    Args:
        heading: degrees, 0 = up, 90 = right.

    >>> dart(90.0)[0]
    (1.0, -0.0)
    """
    corners = []
    for turn, reach in ((0.0, 1.0), (140.0, 1.0), (180.0, 0.35), (220.0, 1.0)):
        angle = math.radians(heading + turn)
        corners.append((math.sin(angle) * reach, round(-math.cos(angle) * reach, 12)))
    return corners


def step_length(location: Tensor) -> float:
    """Distance between neighbouring places, in the unit of ``location`` (N, 2); 1 if there is only one place.

    >>> step_length(torch.tensor([[0.0, 0.0], [0.0, 0.5], [1.0, 0.5], [0.0, 0.5]]))
    0.5
    """
    distinct = places(location)
    if len(distinct) == 1:
        return 1.0
    # with matrix products a place would be 2 mm from itself
    apart = torch.cdist(distinct[:256], distinct, compute_mode="donot_use_mm_for_euclid_dist")
    return float(apart[apart > 1e-3].min())


def spread_poses(location: Tensor, rotation: Tensor, count: int) -> list[int]:
    """Farthest-point selection of states, by place and heading, starting nearest to the centre.

    Opposite headings count as half of the room apart.

    Args:
        location: (N, 2) metres.
        rotation: (N,) degrees.
        count: number of states; all of them when there are fewer.

    Returns:
        distinct state ids in order of selection.

    >>> row = torch.tensor([[0.0, 0.0], [0.0, 1.0], [0.0, 2.0], [0.0, 3.0], [0.0, 4.0]])
    >>> spread_poses(row, torch.zeros(5), 3)
    [2, 0, 4]
    """
    extent = float((location.amax(0) - location.amin(0)).max()) or 1.0
    angle = rotation * (math.pi / 180)
    # one unit vector per heading, so that 0 and 360 are the same; opposite ones are 2 apart
    heading = torch.stack([angle.sin(), angle.cos()], 1) * (extent / 4)
    pose = torch.cat([location, heading], 1).double()
    middle = torch.cat([location.mean(0), heading[0]]).double()
    chosen = [int((pose - middle).norm(dim=1).argmin())]
    nearest = (pose - pose[chosen[0]]).norm(dim=1)
    while len(chosen) < min(count, len(pose)):
        # exclude chosen states, even where several states share a pose
        nearest[chosen] = -1.0
        chosen.append(int(nearest.argmax()))
        nearest = torch.minimum(nearest, (pose - pose[chosen[-1]]).norm(dim=1))
    return chosen
