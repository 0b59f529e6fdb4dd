"""Flats: two to five rooms side by side, joined by doorways, as one scene.

Each room is drawn and furnished separately, with free floor in front of its doorways, then moved to its
place in the row. The thickness of the walls between rooms puts all of them on one grid, with one place in
each doorway.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

from vusfa.errors import SceneError
from vusfa.sources.render.catalogue import Catalogue
from vusfa.sources.render.decorate import decorate
from vusfa.sources.render.draft import Draft
from vusfa.sources.render.furnish import furnish, reserve
from vusfa.sources.render.grid import free_cells
from vusfa.sources.render.kinds import CEILING, Programme
from vusfa.sources.render.layout import lamps_of, room_seed, room_size, scaled
from vusfa.sources.render.outline import Wall
from vusfa.sources.render.plan import Furniture, Grid, Light, Picture, Plan, Solid, Surfaces, Window, Zone

__all__ = ["flat"]

_GRID = Grid()
_MARGIN = _GRID.origin[0]
# A room's width is 2 * 0.3 m more than a multiple of the step; with this it is such a multiple.
_THICKNESS = 0.4
_DOORWAY, _LINTEL = 1.0, 2.1
_ATTEMPTS = 40
_ROOMS = (2, 5)


@dataclass(frozen=True)
class _Slot:
    """A room of the flat: its programme and where its doorways are, in places along Z; None without one."""

    kind: str
    programme: Programme
    share: float
    left: int | None
    right: int | None


def _slots(kinds: Sequence[str], cells: int | None, rng: random.Random) -> list[_Slot]:
    each = None if cells is None else max(12, round(cells / len(kinds)))
    drawn = [scaled(kind, each) for kind in kinds]
    # A row of rectangles: no cut-off corners, whose walls a doorway might meet.
    programmes = [replace(programme, notch=(0, 0), partition=0.0) for programme, _ in drawn]
    rows = [programme.grid[1] for programme in programmes]
    doorways = [rng.randrange(1, min(pair) - 1) for pair in pairwise(rows)]
    return [
        _Slot(kind, programme, share, left, right)
        for kind, programme, (_, share), left, right in zip(
            kinds, programmes, drawn, [None, *doorways], [*doorways, None], strict=True
        )
    ]


def _at_doorway(wall: Wall, row: int, on_left: bool) -> float | None:
    """Where along a wall the doorway at a row of places is; None for another wall."""
    if wall.normal != ((1, 0) if on_left else (-1, 0)):
        return None
    return abs(_MARGIN + _GRID.step * row - wall.corner[1])


def _draw_room(slot: _Slot, seed: int, number: int, catalogue: Catalogue) -> Draft:
    """Draw several drafts and keep the best: as many free places as wanted, no doorway cut off."""
    best: tuple[float, Draft] | None = None
    width, depth = room_size(slot.programme.grid)
    for attempt in range(_ATTEMPTS):
        rng = random.Random(f"flat-{seed}-{number}-{slot.kind}-{attempt}")
        draft = Draft(width, depth, [], catalogue, rng)
        doors = []
        for row, on_left in ((slot.left, True), (slot.right, False)):
            for wall in draft.walls:
                t = None if row is None else _at_doorway(wall, row, on_left)
                if t is not None:
                    reserve(draft, wall, t, _DOORWAY)
                    assert row is not None
                    doors.append((0 if on_left else slot.programme.grid[0] - 1, row))
        furnish(draft, slot.programme, doors=1, share=slot.share)
        decorate(draft, slot.programme, 1000 + room_seed(slot.kind, seed) + 100 * number)
        cells, _, cut_off = free_cells(slot.programme.grid, (width, depth), draft.obstacles, _GRID)
        cost = (
            abs(len(cells) - slot.programme.cells) + cut_off + 1000 * sum(door not in cells for door in doors)
        )
        if best is None or cost < best[0]:
            best = (cost, draft)
    assert best is not None
    return best[1]


def _moved(at: tuple[float, float], by: float) -> tuple[float, float]:
    return round(at[0] + by, 4), at[1]


def flat(
    kinds: Sequence[str], seed: int = 1, cells: int | None = None, catalogue: Catalogue | None = None
) -> Plan:
    """Draw a flat.

    Args:
        kinds: of its rooms, from left to right; two to five, repeats allowed.
        seed: any whole number.
        cells: approximate number of free places of all rooms together; by default the kinds' own.
        catalogue: sizes of the models; by default the package's table.

    Raises:
        SceneError: there are too few or too many rooms, a kind is not known, or ``cells`` is too small.

    >>> from vusfa.sources.render.grid import poses
    >>> plan = flat(["bathroom", "hall"], seed=1, cells=60)
    >>> len(plan.surfaces.zones), len(plan.lights), poses(plan).cut_off
    (1, 2, 0)
    """
    if not _ROOMS[0] <= len(kinds) <= _ROOMS[1]:
        raise SceneError(f"a flat has {_ROOMS[0]} to {_ROOMS[1]} rooms, not {len(kinds)}; name as many kinds")
    catalogue = Catalogue.bundled() if catalogue is None else catalogue
    slots = _slots(kinds, cells, random.Random(f"flat-{seed}"))
    rooms = [_draw_room(slot, seed, number, catalogue) for number, slot in enumerate(slots)]
    depth = max(room.depth for room in rooms)
    solids: list[Solid] = []
    zones: list[Zone] = []
    furniture: list[Furniture] = []
    pictures: list[Picture] = []
    windows: list[Window] = []
    lights: list[Light] = []
    x0 = 0.0
    for number, (slot, room) in enumerate(zip(slots, rooms, strict=True)):
        x1 = round(x0 + room.width, 4)
        if room.depth < depth - 1e-6:
            solids.append(Solid((x0, round(room.depth, 4), x1, round(depth, 4))))
        if number:
            zones.append(Zone((x0 - _THICKNESS / 2, 0.0, x1, round(room.depth, 4)), slot.programme.floor))
        placed = [item.furniture() for item in (*room.items, *room.fixtures)]
        furniture += [replace(item, at=_moved(item.at, x0)) for item in placed]
        pictures += [replace(item, at=_moved(item.at, x0)) for item in room.pictures]
        windows += [replace(item, at=_moved(item.at, x0)) for item in room.windows]
        lights += [replace(light, at=_moved(light.at, x0)) for light in _lights(slot, room)]
        if slot.right is not None:
            solids += _dividing_wall(x1, depth, _MARGIN + _GRID.step * slot.right)
            x0 = round(x1 + _THICKNESS, 4)
    return Plan(
        name="flat",
        size=(x1, round(depth, 4), CEILING),
        kind="flat: " + ", ".join(kinds),
        seed=seed,
        solids=tuple(solids),
        surfaces=Surfaces(slots[0].programme.floor, room_seed("flat", seed), zones=tuple(zones)),
        furniture=tuple(furniture),
        pictures=tuple(pictures),
        windows=tuple(windows),
        lights=tuple(lights),
    )


def _lights(slot: _Slot, room: Draft) -> tuple[Light, ...]:
    cells, _, _ = free_cells(slot.programme.grid, (room.width, room.depth), room.obstacles, _GRID)
    return lamps_of(cells, [])


def _dividing_wall(x: float, depth: float, doorway: float) -> list[Solid]:
    """A wall from front to back with a doorway whose middle is at ``doorway``, and the lintel above it."""
    low, high = round(doorway - _DOORWAY / 2, 4), round(doorway + _DOORWAY / 2, 4)
    right = round(x + _THICKNESS, 4)
    walls = [Solid((x, 0.0, right, low))] if low > 0 else []
    walls.append(Solid((x, high, right, round(depth, 4))))
    return [*walls, Solid((x, low, right, high), _LINTEL)]
