"""The plan of a room: everything that decides what its pictures show, as plain data.

Metres and degrees throughout; X to the right, Z forward, heading 0 along +Z and 90 along +X. A plan is read
from and written to YAML by :mod:`vusfa.sources.render.plan_file`; it comes from a person or from
:func:`vusfa.sources.render.layout.layout`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TypeVar

from vusfa.errors import SceneError
from vusfa.sources.render.catalogue import Catalogue
from vusfa.sources.render.outline import Rect, Wall, footprint, wall_pieces

__all__ = [
    "ROLES",
    "Camera",
    "Furniture",
    "Grid",
    "Light",
    "Picture",
    "Plan",
    "Solid",
    "Surfaces",
    "Window",
    "Zone",
]

#: Roles of furniture: standing, lying on another piece, walked over, hanging from the ceiling, ...
ROLES = ("floor", "top", "rug", "lamp", "hung", "door")

# Metres; higher obstacles do not block the way.
_HEADROOM = 1.9


@dataclass(frozen=True)
class Solid:
    """A block of wall; with ``bottom`` above 1.9 m a lintel, which does not block the way."""

    rect: Rect
    bottom: float = 0.0


@dataclass(frozen=True)
class Zone:
    """A part of the floor with its own pattern."""

    rect: Rect
    floor: str


@dataclass(frozen=True)
class Surfaces:
    """Patterns of floor and walls.

    Args:
        floor: wood, tile or check.
        seed: random seed of the colors, the grain, the walls' patterns where none are named, and the frames
            from which the exposure is measured.
        walls: patterns of :meth:`Plan.walls`, in order, repeated when they run out:
            stripe, wainscot, brick, plain, dots, tile, chevron, plank, diamond.
        zones: floors that differ from ``floor``, such as those of a flat's rooms.
    """

    floor: str = "wood"
    seed: int = 0
    walls: tuple[str, ...] = ()
    zones: tuple[Zone, ...] = ()


@dataclass(frozen=True)
class Furniture:
    """A placed model of the catalogue.

    Args:
        model: its name, such as ``Scopia#5``.
        at: (x, z) of the middle of its footprint.
        facing: heading of its front.
        elevation: height of its underside; the catalogue's by default.
        size: (width, height, depth); the catalogue's by default.
        role: one of :data:`ROLES`.
        blocks: whether its footprint blocks the way.
    """

    model: str
    at: tuple[float, float]
    facing: float = 0.0
    elevation: float | None = None
    size: tuple[float, float, float] | None = None
    role: str = "floor"
    blocks: bool = True

    @property
    def rect(self) -> Rect:
        """Its footprint; needs ``size``."""
        if self.size is None:
            raise SceneError(
                f"furniture {self.model!r} has no size; complete the plan from a catalogue first"
            )
        return footprint(*self.at, self.size[0], self.size[2], self.facing)


@dataclass(frozen=True)
class Picture:
    """A painted picture at a place on a wall; ``height`` is that of its centre, ``size`` (width, height)."""

    at: tuple[float, float]
    facing: float
    height: float
    size: tuple[float, float]
    seed: int


@dataclass(frozen=True)
class Window:
    """A window of the catalogue at a place on a wall, with a painted view behind it that gives daylight."""

    model: str
    at: tuple[float, float]
    facing: float
    view: int
    elevation: float | None = None
    size: tuple[float, float, float] | None = None
    daylight: float = 1.2


_Thing = TypeVar("_Thing", Furniture, Window)


@dataclass(frozen=True)
class Light:
    """A square lamp in the ceiling; ``side`` in metres, ``radiance`` red, green, blue."""

    at: tuple[float, float]
    side: float = 1.1
    radiance: tuple[float, float, float] = (14.0, 13.4, 12.2)


@dataclass(frozen=True)
class Grid:
    """Grid of the camera's places.

    Args:
        step: distance between neighbouring places.
        origin: the first place; the others follow from it by steps to the right and forward.
        headings: 4, or 8 for diagonal moves, too.
        radius: size of the agent's body, which must clear walls and furniture.
    """

    step: float = 0.5
    origin: tuple[float, float] = (0.3, 0.3)
    headings: int = 4
    radius: float = 0.25


@dataclass(frozen=True)
class Camera:
    """The camera: ``height`` above the floor, ``pitch`` degrees down, ``fov`` degrees wide.

    ``resolution`` is (width, height) in pixels, ``samples`` the light paths per pixel before denoising,
    ``exposure`` the factor on brightness (measured from some frames by default).
    """

    height: float = 1.4
    pitch: float = 6.8428
    fov: float = 90.0
    resolution: tuple[int, int] = (200, 150)
    samples: int = 4
    exposure: float | None = None


@dataclass(frozen=True)
class Plan:
    """A room. ``size`` is (width, depth, height of the ceiling).

    ``kind`` and ``seed`` are those from which a plan was drawn.

    >>> from vusfa.sources.render.plan import Furniture, Plan
    >>> plan = Plan("cell", size=(3.0, 3.0, 2.6), furniture=(Furniture("Scopia#5", (1.5, 1.5)),))
    >>> plan.models, len(plan.walls), plan.num_places
    (['Scopia#5'], 4, (5, 5))
    """

    name: str
    size: tuple[float, float, float]
    kind: str = ""
    seed: int = 0
    solids: tuple[Solid, ...] = ()
    surfaces: Surfaces = field(default_factory=Surfaces)
    furniture: tuple[Furniture, ...] = ()
    pictures: tuple[Picture, ...] = ()
    windows: tuple[Window, ...] = ()
    lights: tuple[Light, ...] = ()
    grid: Grid = field(default_factory=Grid)
    camera: Camera = field(default_factory=Camera)

    @property
    def walls(self) -> list[Wall]:
        """Visible pieces of wall without lintels, in the order of ``surfaces.walls``."""
        standing = [solid.rect for solid in self.solids if solid.bottom < _HEADROOM]
        return wall_pieces(self.size[0], self.size[1], standing)

    @property
    def obstacles(self) -> list[Rect]:
        """Footprints that block the way."""
        standing = [solid.rect for solid in self.solids if solid.bottom < _HEADROOM]
        return standing + [item.rect for item in self.furniture if item.blocks]

    @property
    def models(self) -> list[str]:
        """Names of its models of the catalogue, sorted, each once."""
        return sorted({item.model for item in self.furniture} | {item.model for item in self.windows})

    @property
    def is_complete(self) -> bool:
        """Whether all furniture and windows have sizes and elevations."""
        pairs = [(item.size, item.elevation) for item in self.furniture]
        pairs += [(item.size, item.elevation) for item in self.windows]
        return not any(None in pair for pair in pairs)

    def completed(self, catalogue: Catalogue) -> Plan:
        """Copy the plan, with the sizes and elevations of all furniture and windows.

        Raises:
            SceneError: the catalogue lacks a model; the message names all missing ones.
        """
        missing = [model for model in self.models if model not in catalogue]
        if missing:
            raise SceneError(
                f"plan {self.name!r}: the furniture catalogue has no {', '.join(missing)}; correct the names,"
                f" or install the collections that they are in"
            )

        def fill(item: _Thing) -> _Thing:
            model = catalogue[item.model]
            return replace(
                item,
                size=model.exact_size if item.size is None else item.size,
                elevation=model.elevation if item.elevation is None else item.elevation,
            )

        return replace(
            self,
            furniture=tuple(fill(item) for item in self.furniture),
            windows=tuple(fill(item) for item in self.windows),
        )

    @property
    def num_places(self) -> tuple[int, int]:
        """Places of the grid along X and Z, free or not."""
        grid = self.grid
        columns, rows = (
            math.floor((self.size[axis] - grid.radius - grid.origin[axis]) / grid.step + 1e-6) + 1
            for axis in (0, 1)
        )
        return max(columns, 0), max(rows, 0)
