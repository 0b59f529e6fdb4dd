"""Floor maps: each place is a square, each heading a slice of it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from vusfa.report.packing import pack_ids
from vusfa.report.room_plan import plan_of, plan_shapes
from vusfa.scenes import Scene
from vusfa.scenes.poses import dart, step_length

__all__ = ["blocked_edges", "dart_path", "floor_plan", "outline", "slices"]

_HALF = 0.47  # half the side of a place's square; the unit is the distance between neighbouring places
_WHOLE = 359.9  # a slice of this many degrees is the whole square


def slices(location: np.ndarray, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A slice of a square per state, without overlaps.

    States of one place share its square; each gets the angles nearest to its heading, so four headings give
    four triangles. If two states have the same pose there is no map: all states are laid out on a grid in the
    order of their ids, a square each.

    Args:
        location: (N, 2) metres.
        rotation: (N,) degrees, 0 = up, 90 = right.

    Returns:
        centre of the square (N, 2) metres; first and last angle of the slice, (N,) degrees each.

    >>> centre, first, last = slices(np.zeros((2, 2)), np.array([0.0, 90.0]))
    >>> first.tolist(), last.tolist()
    ([-135.0, 45.0], [45.0, 225.0])
    """
    count = len(location)
    centre, first, last = location.astype(np.float64).copy(), np.zeros(count), np.full(count, 360.0)
    _, place = np.unique(np.round(location, 3), axis=0, return_inverse=True)
    place = place.reshape(-1)
    for members in (np.flatnonzero(place == here) for here in range(place.max() + 1)):
        if len(members) == 1:
            continue
        heading = np.mod(rotation[members].astype(np.float64), 360.0)
        order = np.argsort(heading, kind="stable")
        sorted_headings = heading[order]
        gap = np.mod(np.roll(sorted_headings, -1) - sorted_headings, 360.0)
        if (gap < 1e-3).any():
            return _grid(count)
        first[members[order]] = sorted_headings - np.roll(gap, 1) / 2
        last[members[order]] = sorted_headings + gap / 2
    return centre, first, last


def _grid(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    width = math.ceil(math.sqrt(count))
    ids = np.arange(count)
    centre = np.stack([ids % width, -(ids // width)], 1).astype(np.float64)
    return centre, np.zeros(count), np.full(count, 360.0)


def outline(x: float, y: float, first: float, last: float) -> str:
    """A slice of a square as the path of an SVG, in squares, y downwards.

    Args:
        x, y: centre of the square.
        first, last: angles of the slice, degrees, 0 = up, 90 = right.

    >>> outline(0.5, 0.5, -45.0, 45.0)
    'M0.03 0.03L0.97 0.03L0.5 0.5Z'
    """
    whole = last - first > _WHOLE
    corners = [45.0 + 90.0 * number for number in range(math.floor((first - 45) / 90) + 1, 9)]
    angles = (
        [45.0, 135.0, 225.0, 315.0] if whole else [first, *(a for a in corners if first < a < last), last]
    )
    points = []
    for angle in angles:
        right, up = math.sin(math.radians(angle)), math.cos(math.radians(angle))
        reach = _HALF / max(abs(right), abs(up))
        points.append((x + right * reach, y - up * reach))
    points += [] if whole else [(x, y)]
    return f"M{'L'.join(f'{round(a, 3):g} {round(b, 3):g}' for a, b in points)}Z"


def dart_path() -> str:
    """The dart of :func:`vusfa.scenes.poses.dart` that points up, as the path of an SVG."""
    return f"M{'L'.join(f'{x:.3f} {y:.3f}' for x, y in dart())}Z"


def floor_plan(scene: Scene) -> dict[str, Any]:
    """A scene's map for the page, in squares from the upper left corner.

    Args:
        scene: the scene.

    Returns:
        plain data: name, states (N), actions (names), width and height of the map, metre (its length; None
        where the places are made up), x, y (N, centres of the squares), middles (N pairs, a point within each
        slice), paths (N, :func:`outline` of each slice), heading (N, degrees), next (packed (N, A): the state
        each action leads to; a blocked one leads back); room (rectangle), solids (rectangles) and things
        (rect, kind, name) where the room's plan is known, see :mod:`vusfa.report.room_plan`, else edges, see
        :func:`blocked_edges`. Rectangles are x, y, width, height.

    >>> plan = floor_plan(Scene.bundled("bathroom"))
    >>> plan["states"], plan["metre"], len(plan["paths"]), plan["things"][0]["name"]
    (176, 2.0, 176, 'Bath')
    """
    location, rotation = scene.location.numpy(), scene.rotation.numpy()
    centre, first, last = slices(location, rotation)
    metric = bool(np.allclose(centre, location))
    cell = step_length(scene.location) if metric else 1.0
    low, high = centre.min(0), centre.max(0)
    x, y = (centre[:, 0] - low[0]) / cell + 0.5, (high[1] - centre[:, 1]) / cell + 0.5
    whole, angle = last - first > _WHOLE, np.radians((first + last) / 2)
    away = np.where(whole, 0.0, 0.3) * np.stack([np.sin(angle), -np.cos(angle)])
    graph = scene.graph.numpy()
    stay = np.arange(len(graph))[:, None]
    width, height = ((high - low) / cell + 1).tolist()
    known = plan_of(scene) if metric else None
    drawn: dict[str, Any] = {"edges": blocked_edges(scene, x, y) if metric else []}
    if known is not None:

        def placed(rect: list[float]) -> list[float]:
            x0, z0, x1, z1 = rect
            corner = [(x0 - low[0]) / cell + 0.5, (high[1] - z1) / cell + 0.5]
            return [round(float(number), 3) for number in (*corner, (x1 - x0) / cell, (z1 - z0) / cell)]

        shapes = plan_shapes(known, scene)
        drawn = {
            "room": placed(shapes["room"]),
            "solids": [placed(rect) for rect in shapes["solids"]],
            "things": [thing | {"rect": placed(thing["rect"])} for thing in shapes["things"]],
        }
    return drawn | {
        "name": scene.name,
        "states": scene.num_states,
        "actions": list(scene.actions),
        "width": round(width, 3),
        "height": round(height, 3),
        "metre": round(1 / cell, 3) if metric else None,
        "x": np.round(x, 3).tolist(),
        "y": np.round(y, 3).tolist(),
        "middles": np.round(np.stack([x, y], 1) + away.T, 3).tolist(),
        "paths": [outline(*numbers) for numbers in np.stack([x, y, first, last], 1).tolist()],
        "heading": np.round(rotation, 2).tolist(),
        "next": pack_ids(np.where(graph < 0, stay, graph)),
    }


def blocked_edges(scene: Scene, x: np.ndarray, y: np.ndarray) -> list[list[float]]:
    """Edges of squares that MoveForward cannot cross: walls or furniture, which a dump does not distinguish.

    Args:
        scene: the scene; without an action MoveForward nothing is known.
        x, y: (N,) centres of the squares, y downwards.

    Returns:
        lines x0, y0, x1, y1, for headings along the grid.

    >>> import torch
    >>> hall = Scene("hall", torch.tensor([[1], [-1]]), torch.rand(2, 1, 2), actions=("MoveForward",))
    >>> blocked_edges(hall, np.array([0.5, 0.5]), np.array([1.5, 0.5]))
    [[0.0, 0.0, 1.0, 0.0]]
    """
    if "MoveForward" not in scene.actions:
        return []
    blocked = scene.graph[:, scene.actions.index("MoveForward")].numpy() < 0
    heading = scene.rotation.numpy()
    straight = np.abs(np.mod(heading + 45, 90) - 45) < 1
    lines = set()
    for state in np.flatnonzero(blocked & straight).tolist():
        turn = math.radians(round(float(heading[state]) / 90) * 90)
        right, up = math.sin(turn), math.cos(turn)
        middle = x[state] + right / 2, y[state] - up / 2
        side = abs(up) / 2, abs(right) / 2
        ends = middle[0] - side[0], middle[1] - side[1], middle[0] + side[0], middle[1] + side[1]
        lines.add(tuple(round(float(end), 3) + 0.0 for end in ends))
    return [list(line) for line in sorted(lines)]
