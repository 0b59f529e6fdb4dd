"""Rooms drawn from a kind and a seed: the same arguments always give the same plan.

Many drafts are drawn and furnished. The plan is the draft whose number of free places is nearest to
``cells``, with the fewest places cut off and enough furniture.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass

import numpy as np

from vusfa.errors import SceneError
from vusfa.sources.render.catalogue import Catalogue
from vusfa.sources.render.decorate import decorate
from vusfa.sources.render.draft import Draft
from vusfa.sources.render.furnish import furnish
from vusfa.sources.render.grid import free_cells
from vusfa.sources.render.kinds import CEILING, Programme, programme
from vusfa.sources.render.outline import Rect
from vusfa.sources.render.plan import Grid, Light, Plan, Solid, Surfaces

__all__ = ["best_lamps", "lamps_of", "layout", "room_seed", "room_size", "scaled"]

#: Metres from a wall to the first places of the grid.
MARGIN = 0.3
_GRID = Grid()
_ATTEMPTS, _TRIALS = 600, 8
_GOOD_ENOUGH = 1.5
_FEWEST_CELLS = 12


def room_seed(kind: str, seed: int) -> int:
    """Random seed of a room's textures and views, different for each kind.

    >>> room_seed("hall", 1)
    417001
    """
    return sum(map(ord, kind)) * 1000 + seed


def scaled(kind: str, cells: int | None, roomier: float = 1.0) -> tuple[Programme, float]:
    """Scale a kind's programme to a number of free places; also gives the share of its furniture.

    Args:
        kind: of room.
        cells: free places; the kind's own when None.
        roomier: a factor on the floor, for the same furniture.

    Raises:
        SceneError: there is no such kind, or ``cells`` is too small.

    >>> scaled("kitchen", 85)[0].grid
    (13, 11)
    """
    base = programme(kind)
    if cells is None or cells == base.cells:
        return base, 1.0
    if cells < _FEWEST_CELLS:
        raise SceneError(f"cells: {cells} is too few for a room; ask for {_FEWEST_CELLS} or more")
    share = cells / base.cells
    side = math.sqrt(share * roomier)
    columns = max(3, round(base.grid[0] * side))
    rows = max(3, round(base.grid[1] * base.grid[0] * share * roomier / columns))
    notch = (round(base.notch[0] * side), round(base.notch[1] * side))
    changed = {
        "cells": cells,
        "grid": (columns, rows),
        "notch": notch if all(notch) else (0, 0),
        "partition": base.partition * side,
    }
    return Programme(**{**vars(base), **changed}), share


def room_size(grid: tuple[int, int]) -> tuple[float, float]:
    """Width and depth in metres of a room, from its numbers of places along X and Z.

    >>> room_size((3, 2))
    (1.6, 1.1)
    """
    return 2 * MARGIN + _GRID.step * (grid[0] - 1), 2 * MARGIN + _GRID.step * (grid[1] - 1)


def draw_solids(kind: Programme, rng: random.Random) -> list[Rect]:
    """A cut-off corner or a partition, as the programme has it."""
    width, depth = room_size(kind.grid)
    solids: list[Rect] = []
    a, b = (count * _GRID.step for count in kind.notch)
    if a:
        x0, z0 = rng.choice([0, width - a]), rng.choice([0, depth - b])
        solids.append((x0, z0, x0 + a, z0 + b))
    if kind.partition:
        x = width * rng.uniform(0.4, 0.6)
        near = rng.random() < 0.5
        span = (0, kind.partition) if near else (depth - kind.partition, depth)
        solids.append((x - 0.08, span[0], x + 0.08, span[1]))
    return solids


@dataclass(frozen=True, eq=False)
class _Attempt:
    cost: float
    draft: Draft
    cells: list[tuple[int, int]]
    cut_off: int


def _attempt(
    kind: Programme, share: float, name: str, seed: int, number: int, catalogue: Catalogue
) -> _Attempt:
    rng = random.Random(f"{name}-{seed}-{number}")
    width, depth = room_size(kind.grid)
    draft = Draft(width, depth, draw_solids(kind, rng), catalogue, rng)
    furnish(draft, kind, share=share)
    decorate(draft, kind, 1000 + room_seed(name, seed))
    cells, _, cut_off = free_cells(kind.grid, (width, depth), draft.obstacles, _GRID)
    standing = sum(item.role == "floor" for item in draft.items)
    cost = abs(len(cells) - kind.cells) + 0.5 * cut_off
    cost += 3 * max(0, standing - round(20 * share)) + 3 * max(0, round(8 * share) - standing)
    return _Attempt(cost, draft, cells, cut_off)


def best_lamps(places: np.ndarray, solids: list[Rect]) -> list[int]:
    """Choose the places below the lamps: one, or two for more than 60 places, that light all places best.

    A lamp gives a place light by the inverse square of their distance (+ 2 m^2, as it hangs high), and a
    twentieth of that where a solid block is between them; the geometric mean over all places is maximised.

    Args:
        places: (n, 2) metres.
        solids: blocks that throw shadows.

    >>> best_lamps(np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]), [])
    [1]
    """
    along = np.linspace(0, 1, 25)[:, None]
    seen = np.ones((len(places), len(places)))
    for i, place in enumerate(places):
        if not solids:
            break
        way = place + along[None] * (places[:, None] - place)
        for x0, z0, x1, z1 in solids:
            inside = (way[..., 0] > x0) & (way[..., 0] < x1) & (way[..., 1] > z0) & (way[..., 1] < z1)
            seen[i] *= ~inside.any(axis=1)
    light = (seen + 0.05) / (((places[:, None] - places) ** 2).sum(-1) + 2)
    if len(places) <= 60:
        return [int(np.argmax(np.log(light).mean(axis=1)))]
    both = [np.log(light[i] + light[:i]).mean(axis=1) for i in range(1, len(places))]
    first = 1 + int(np.argmax([row.max() for row in both]))
    return [first, int(np.argmax(both[first - 1]))]


_RADIANCE = ((14.0, 13.4, 12.2), (13.0, 12.8, 12.6))


def lamps_of(cells: list[tuple[int, int]], solids: list[Rect]) -> tuple[Light, ...]:
    """Ceiling lamps for a room with these free places, above :func:`best_lamps`."""
    places = MARGIN + _GRID.step * np.array(cells, dtype=np.float64)
    lit = [(round(float(x), 4), round(float(z), 4)) for x, z in places[best_lamps(places, solids)]]
    return tuple(Light(at, radiance=_RADIANCE[k]) for k, at in enumerate(lit))


def as_plan(
    draft: Draft, name: str, kind: str, seed: int, surfaces: Surfaces, cells: list[tuple[int, int]]
) -> Plan:
    """A finished draft as a plan, lamps put up."""
    # Not rounded: the last digit decides a wall's number of pixels, and all colors drawn after it.
    solids = tuple(Solid(tuple(float(edge) for edge in rect)) for rect in draft.solids)  # type: ignore[arg-type]
    return Plan(
        name=name,
        size=(round(draft.width, 4), round(draft.depth, 4), CEILING),
        kind=kind,
        seed=seed,
        solids=solids,
        surfaces=surfaces,
        furniture=tuple(item.furniture() for item in (*draft.items, *draft.fixtures)),
        pictures=tuple(draft.pictures),
        windows=tuple(draft.windows),
        lights=lamps_of(cells, list(draft.solids)),
    )


def layout(kind: str, seed: int = 1, cells: int | None = None, catalogue: Catalogue | None = None) -> Plan:
    """Draw a room.

    Args:
        kind: bathroom, bedroom, kitchen, living_room or hall.
        seed: any whole number.
        cells: number of free places, half a metre apart; by default the kind's own. The plan has about so
            many, mostly within two.
        catalogue: sizes of the models; by default the package's table.

    Raises:
        SceneError: the kind is not known, or ``cells`` is too small.

    >>> plan = layout("bathroom", seed=1)
    >>> plan.size, len(plan.furniture), len(plan.pictures)
    ((5.1, 4.6, 2.6), 17, 11)
    """
    catalogue = Catalogue.bundled() if catalogue is None else catalogue
    kind_programme, share = scaled(kind, cells)
    if cells is not None and kind_programme is not programme(kind):
        # A few drafts measure how much floor the furniture takes, which hardly depends on the room's size.
        tried = [_attempt(kind_programme, share, kind, seed, -k, catalogue) for k in range(1, _TRIALS + 1)]
        free = sum(len(draft.cells) + draft.cut_off for draft in tried) / _TRIALS
        places = kind_programme.grid[0] * kind_programme.grid[1]
        kind_programme, share = scaled(kind, cells, (cells + places - free) / places)
    best: _Attempt | None = None
    for number in range(_ATTEMPTS):
        found = _attempt(kind_programme, share, kind, seed, number, catalogue)
        if best is None or found.cost < best.cost:
            best = found
        # Large rooms may miss the number of places by more.
        if best.cost <= max(_GOOD_ENOUGH, 0.02 * kind_programme.cells * (share != 1.0)):
            break
    assert best is not None
    if not best.cells:
        raise SceneError(f"no {kind} with {cells} free places could be drawn; ask for more cells")
    surfaces = Surfaces(kind_programme.floor, room_seed(kind, seed))
    return as_plan(best.draft, kind, kind, seed, surfaces, best.cells)
