"""Rectangles on the floor, and the visible pieces of wall of a room's outline and its solid blocks.

A plan is seen from above: X to the right, Z forward, in metres; heading 0 looks along +Z, 90 along +X. A room
is the rectangle (0, 0) to (width, depth) without its solid blocks (a cut-off corner, a partition, the wall
between two rooms).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

__all__ = ["Rect", "Wall", "footprint", "gap", "overlaps", "wall_pieces"]

#: x0, z0, x1, z1
Rect = tuple[float, float, float, float]

_EDGE = 1e-6
_SHORTEST = 0.12


@dataclass(frozen=True)
class Wall:
    """A straight visible piece of wall.

    Args:
        corner: its left end, seen from inside the room.
        along: unit vector from there to its right end.
        normal: unit vector into the room.
        length: metres.
    """

    corner: tuple[float, float]
    along: tuple[int, int]
    normal: tuple[int, int]
    length: float

    def point(self, t: float, out: float = 0.0) -> tuple[float, float]:
        """The point ``t`` metres along the wall and ``out`` metres into the room.

        >>> Wall((4.0, 3.0), (-1, 0), (0, -1), 4.0).point(1.0, 0.5)
        (3.0, 2.5)
        """
        x = self.corner[0] + self.along[0] * t + self.normal[0] * out
        z = self.corner[1] + self.along[1] * t + self.normal[1] * out
        return x, z

    @property
    def facing(self) -> float:
        """Heading in degrees of something that hangs on the wall and looks into the room."""
        return math.degrees(math.atan2(*self.normal)) % 360


def overlaps(a: Rect, b: Rect, margin: float = 0.0) -> bool:
    """Whether two rectangles overlap, or come nearer than ``margin`` along both axes.

    >>> overlaps((0, 0, 1, 1), (1, 0, 2, 1)), overlaps((0, 0, 1, 1), (1.1, 0, 2, 1), margin=0.2)
    (False, True)
    """
    return a[0] < b[2] + margin and b[0] < a[2] + margin and a[1] < b[3] + margin and b[1] < a[3] + margin


def gap(rect: Rect, x: float, z: float) -> float:
    """Distance in metres from a point to a rectangle; 0 inside.

    >>> gap((0, 0, 1, 1), 4.0, 5.0)
    5.0
    """
    return math.hypot(max(rect[0] - x, x - rect[2], 0.0), max(rect[1] - z, z - rect[3], 0.0))


def footprint(x: float, z: float, width: float, depth: float, facing: float) -> Rect:
    """Bounding rectangle of a ``width`` x ``depth`` piece of furniture at (x, z) with heading ``facing``.

    >>> footprint(1.0, 1.0, 1.0, 0.5, 90.0)
    (0.75, 0.5, 1.25, 1.5)
    """
    angle = math.radians(facing)
    # Exact at right angles: a rounding error would push furniture at a wall into it.
    cos, sin = (round(abs(f(angle)), 12) for f in (math.cos, math.sin))
    half_x = (width * cos + depth * sin) / 2
    half_z = (width * sin + depth * cos) / 2
    return x - half_x, z - half_z, x + half_x, z + half_z


def _uncovered(length: float, covered: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """What is left of 0..length without some intervals, from left to right; slivers are dropped."""
    left, at = [], 0.0
    for low, high in sorted(covered):
        if min(low, length) - at > _SHORTEST:
            left.append((at, min(low, length)))
        at = max(at, min(high, length))
    if length - at > _SHORTEST:
        left.append((at, length))
    return left


def _piece(
    origin: tuple[float, float], along: tuple[int, int], normal: tuple[int, int], a: float, b: float
) -> Wall:
    return Wall((origin[0] + along[0] * a, origin[1] + along[1] * a), along, normal, b - a)


def _spans(
    origin: tuple[float, float], along: tuple[int, int], rects: Sequence[Rect]
) -> list[tuple[float, float]]:
    """Where some rectangles begin and end along a wall."""
    spans = []
    for x0, z0, x1, z1 in rects:
        ends = [(x - origin[0]) * along[0] + (z - origin[1]) * along[1] for x, z in ((x0, z0), (x1, z1))]
        spans.append((max(min(ends), 0.0), max(*ends, 0.0)))
    return spans


def wall_pieces(width: float, depth: float, solids: Sequence[Rect] = ()) -> list[Wall]:
    """Find all visible pieces of wall: those of the outline, then the sides of the solid blocks.

    Args:
        width: of the room's rectangle, metres along X.
        depth: metres along Z.
        solids: blocks that reach from floor to ceiling; they hide what they touch.

    >>> [wall.length for wall in wall_pieces(4.0, 3.0, [(0.0, 0.0, 1.0, 1.0)])]
    [3.0, 4.0, 2.0, 3.0, 1.0, 1.0]
    """
    walls = []
    outline: list[tuple[tuple[float, float], tuple[int, int], float]] = [
        ((width, 0.0), (0, 1), width),
        ((0.0, depth), (0, -1), width),
        ((0.0, 0.0), (1, 0), depth),
        ((width, depth), (-1, 0), depth),
    ]
    for origin, normal, length in outline:
        along = (-normal[1], normal[0])
        touching = [
            (x0, z0, x1, z1)
            for x0, z0, x1, z1 in solids
            if {
                (0, 1): z0 <= _EDGE,
                (0, -1): z1 >= depth - _EDGE,
                (1, 0): x0 <= _EDGE,
                (-1, 0): x1 >= width - _EDGE,
            }[normal]
        ]
        for a, b in _uncovered(length, _spans(origin, along, touching)):
            walls.append(_piece(origin, along, normal, a, b))
    for number, (x0, z0, x1, z1) in enumerate(solids):
        sides: list[tuple[tuple[int, int], tuple[float, float], tuple[float, float]]] = [
            ((1, 0), (x1, z0), (x1, z1)),
            ((-1, 0), (x0, z0), (x0, z1)),
            ((0, 1), (x0, z1), (x1, z1)),
            ((0, -1), (x0, z0), (x1, z0)),
        ]
        for normal, p, q in sides:
            middle = ((p[0] + q[0]) / 2 + normal[0] * 0.05, (p[1] + q[1]) / 2 + normal[1] * 0.05)
            if not (0 < middle[0] < width and 0 < middle[1] < depth):
                continue
            along = (-normal[1], normal[0])
            origin = p if (q[0] - p[0]) * along[0] + (q[1] - p[1]) * along[1] > 0 else q
            strip = (
                min(p[0], q[0] + normal[0] * 0.05),
                min(p[1], q[1] + normal[1] * 0.05),
                max(p[0], q[0] + normal[0] * 0.05),
                max(p[1], q[1] + normal[1] * 0.05),
            )
            hiding = [
                other for k, other in enumerate(solids) if k != number and overlaps(strip, other, -_EDGE)
            ]
            for a, b in _uncovered(math.dist(p, q), _spans(origin, along, hiding)):
                walls.append(_piece(origin, along, normal, a, b))
    return walls
