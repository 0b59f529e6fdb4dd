"""Furnishing of a draft, largest pieces first: doors, tables, along walls, free-standing, small objects."""

from __future__ import annotations

import re

from vusfa.sources.render.draft import Draft, Placed, Span
from vusfa.sources.render.kinds import CEILING, DOORS, LAMPS, Programme
from vusfa.sources.render.outline import Wall

__all__ = ["furnish", "put_door"]

_BEFORE_DOOR = 0.8
_HOLDS_THINGS = re.compile("able|abinet|esk|sland|Chest|Dresser|ashing|Dryer|freezer|Shelves|Box|TV|Stove")


def reserve(draft: Draft, wall: Wall, t: float, width: float) -> None:
    """Keep a part of a wall and the floor in front of it free."""
    x, z = wall.point(t)
    half = (abs(wall.along[0]) * width / 2, abs(wall.along[1]) * width / 2)
    low, high = (x - half[0], z - half[1]), (x + half[0], z + half[1])
    out = (wall.normal[0] * _BEFORE_DOOR, wall.normal[1] * _BEFORE_DOOR)
    draft.reserved.append(
        (
            min(low[0], low[0] + out[0]),
            min(low[1], low[1] + out[1]),
            max(high[0], high[0] + out[0]),
            max(high[1], high[1] + out[1]),
        )
    )
    draft.spans.append(Span(wall, t, width))


def put_door(draft: Draft, wall: Wall) -> None:
    """Put a door into a wall at random, with free floor in front of it."""
    model = draft.catalogue[draft.rng.choice(DOORS)]
    t = draft.rng.uniform(0.25 + model.width / 2, wall.length - 0.25 - model.width / 2)
    draft.fixtures.append(Placed(model, *wall.point(t), wall.facing, 0.0, "door", False))
    reserve(draft, wall, t, model.width)


def _put_small_things(draft: Draft, programme: Programme) -> None:
    for item in list(draft.items):
        low = 0.35 < item.model.height < 1.15 and item.model.width * item.model.depth > 0.15
        if not (low and draft.rng.random() < 0.7 and _HOLDS_THINGS.search(item.model.title)):
            continue
        thing = draft.pick(programme.tops)
        if thing.width <= item.model.width and thing.depth <= item.model.depth + 0.05:
            top = item.elevation + min(item.model.top, item.model.height)
            draft.lay(thing, item.x, item.z, item.facing, top, "top")


def furnish(draft: Draft, programme: Programme, doors: int = 2, share: float = 1.0) -> None:
    """Put a programme's furniture into a draft; pieces that fit nowhere after some tries are left out.

    Args:
        draft: an empty room.
        programme: the furniture to draw from.
        doors: number of doors, each in another wall.
        share: of the programme's furniture; 2 for a room twice as large.
    """
    rng = draft.rng
    for wall in rng.sample([wall for wall in draft.walls if wall.length > 1.6], doors):
        put_door(draft, wall)

    def how_many(count: int) -> int:
        return max(1, round(count * share))

    for table_set in programme.sets:
        for _ in range(how_many(table_set.count)):
            table = draft.pick(table_set.tables)
            draft.put_table(table, draft.pick(table_set.seats), table_set.chairs)
    for pool, count in programme.wall:
        for _ in range(how_many(count)):
            draft.put_along_wall(draft.pick(pool))
    for pool, count in programme.middle:
        for _ in range(how_many(count)):
            draft.put_free(draft.pick(pool))
    _put_small_things(draft, programme)
    for name in programme.rugs:
        rug = draft.catalogue[name]
        x = rng.uniform(rug.width / 2, draft.width - rug.width / 2)
        z = rng.uniform(rug.depth / 2, draft.depth - rug.depth / 2)
        # Each slightly higher than the last, so that overlapping rugs do not flicker.
        draft.lay(rug, x, z, 0.0, 0.003 + 0.002 * len(draft.items) / 50, "rug")
    lamp = draft.catalogue[rng.choice(LAMPS)]
    x, z = draft.width * rng.uniform(0.35, 0.65), draft.depth * rng.uniform(0.35, 0.65)
    draft.lay(lamp, x, z, 0.0, CEILING - lamp.height - 0.01, "lamp")
