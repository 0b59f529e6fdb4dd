"""Draft of a room while it is being furnished: what stands where, and what else fits.

All random numbers come from the draft's own ``random.Random``, whose stream is the same in every version of
Python.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

from vusfa.sources.render.catalogue import Catalogue, Model
from vusfa.sources.render.outline import Rect, Wall, footprint, overlaps, wall_pieces
from vusfa.sources.render.plan import Furniture, Picture, Window

__all__ = ["Draft", "Placed", "Span"]

_FLUSH = 0.015  # gap between a wall and what stands at it
_HEADINGS = ((0, 1), (1, 0), (0, -1), (-1, 0))


@dataclass(frozen=True, eq=False)
class Placed:
    """A model at its place, with its entry of the catalogue."""

    model: Model
    x: float
    z: float
    facing: float
    elevation: float
    role: str
    blocks: bool

    @cached_property
    def rect(self) -> Rect:
        """Its footprint."""
        return footprint(self.x, self.z, self.model.width, self.model.depth, self.facing)

    def furniture(self) -> Furniture:
        """Convert to an entry of a plan, rounded to a tenth of a millimetre."""
        at = (round(self.x, 4), round(self.z, 4))
        elevation = round(self.elevation, 4)
        return Furniture(
            self.model.name, at, self.facing, elevation, self.model.exact_size, self.role, self.blocks
        )


@dataclass(frozen=True)
class Span:
    """An occupied part of a wall: ``width`` / 2 to either side of ``middle``."""

    wall: Wall
    middle: float
    width: float

    def meets(self, wall: Wall, a: float, b: float, margin: float = 0.04) -> bool:
        """Whether it is nearer than ``margin`` to the part a..b of a wall."""
        low, high = self.middle - self.width / 2, self.middle + self.width / 2
        return self.wall == wall and low < b + margin and a - margin < high


def facing_of(normal: tuple[int, int]) -> float:
    """Heading in degrees of one of the four unit vectors.

    >>> facing_of((1, 0))
    90.0
    """
    return 90.0 * _HEADINGS.index(normal)


@dataclass
class Draft:
    """A room, the rectangle (0, 0) to (width, depth) without its solid blocks, and its furniture so far.

    Args:
        width: metres along X.
        depth: metres along Z.
        solids: blocks of wall.
        catalogue: sizes of models.
        rng: generator of all random numbers.
        reserved: rectangles that stay free, such as those in front of doors.
        spans: occupied parts of walls.
    """

    width: float
    depth: float
    solids: Sequence[Rect]
    catalogue: Catalogue
    rng: random.Random
    reserved: list[Rect] = field(default_factory=list)
    spans: list[Span] = field(default_factory=list)
    items: list[Placed] = field(default_factory=list)
    fixtures: list[Placed] = field(default_factory=list)  # doors and what hangs on walls
    pictures: list[Picture] = field(default_factory=list)
    windows: list[Window] = field(default_factory=list)
    used: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        self.walls = wall_pieces(self.width, self.depth, self.solids)

    @property
    def obstacles(self) -> list[Rect]:
        """Rectangles that block walking."""
        return [*self.solids, *(item.rect for item in (*self.items, *self.fixtures) if item.blocks)]

    def inside(self, rect: Rect) -> bool:
        """Whether a rectangle lies within the room's rectangle."""
        edge = 1e-6
        return (
            rect[0] >= -edge
            and rect[1] >= -edge
            and rect[2] <= self.width + edge
            and rect[3] <= self.depth + edge
        )

    def fits(self, rect: Rect, margin: float) -> bool:
        """Whether a rectangle lies in the room, clear of walls, and ``margin`` metres from all obstacles."""
        if not self.inside(rect) or any(overlaps(rect, solid, 1e-4) for solid in self.solids):
            return False
        others = [*(item.rect for item in self.items if item.blocks), *self.reserved]
        return not any(overlaps(rect, other, margin) for other in others)

    def pick(self, pool: Sequence[str]) -> Model:
        """Draw a model from a pool; unused ones first."""
        chosen = self.rng.choice([name for name in pool if name not in self.used] or pool)
        self.used.add(chosen)
        return self.catalogue[chosen]

    def put(self, model: Model, x: float, z: float, normal: tuple[int, int], margin: float) -> Placed | None:
        """Stand a model on the floor, its front towards ``normal``; None if it does not fit."""
        item = Placed(model, x, z, facing_of(normal), model.elevation, "floor", True)
        if not self.fits(item.rect, margin):
            return None
        self.items.append(item)
        return item

    def lay(self, model: Model, x: float, z: float, facing: float, elevation: float, role: str) -> None:
        """Put something that blocks no way: a rug, a lamp, an object on a table."""
        self.items.append(Placed(model, x, z, facing, elevation, role, False))

    def put_along_wall(self, model: Model, tries: int = 80) -> None:
        """Stand a model at a random wall, often in a corner; leave it out after ``tries`` failures."""
        for _ in range(tries):
            wall = self.rng.choices(self.walls, [wall.length for wall in self.walls])[0]
            if wall.length < model.width + 0.05:
                continue
            t = self.rng.uniform(model.width / 2 + 0.02, wall.length - model.width / 2 - 0.02)
            if self.rng.random() < 0.35:
                t = self.rng.choice([model.width / 2 + 0.03, wall.length - model.width / 2 - 0.03])
            if self.put(model, *wall.point(t, model.depth / 2 + _FLUSH), wall.normal, 0.03):
                return

    def put_free(self, model: Model, margin: float = 0.55, tries: int = 120) -> Placed | None:
        """Stand a model free of walls, with a way around it; None after ``tries`` failures."""
        for _ in range(tries):
            x, z = self.rng.uniform(0.8, self.width - 0.8), self.rng.uniform(0.8, self.depth - 0.8)
            item = self.put(model, x, z, self.rng.choice(_HEADINGS), margin)
            if item:
                return item
        return None

    def put_table(self, table: Model, chair: Model, chairs: int) -> None:
        """Stand a table free of walls, with chairs at some of its sides."""
        placed = self.put_free(table, 0.75)
        if placed is None:
            return
        x0, z0, x1, z1 = placed.rect
        sides = [
            ((1, 0), x1, (z0 + z1) / 2),
            ((-1, 0), x0, (z0 + z1) / 2),
            ((0, 1), (x0 + x1) / 2, z1),
            ((0, -1), (x0 + x1) / 2, z0),
        ]
        self.rng.shuffle(sides)
        out = chair.depth / 2 + 0.03
        for normal, x, z in sides[:chairs]:
            self.put(chair, x + normal[0] * out, z + normal[1] * out, (-normal[0], -normal[1]), 0.01)
