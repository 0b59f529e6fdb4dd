"""Decoration of walls with pictures, windows and hung furniture, so that no two walls look alike.

Each wall is filled from left to right, where no tall furniture would hide the decoration.
"""

from __future__ import annotations

from vusfa.sources.render.draft import Draft, Placed, Span
from vusfa.sources.render.kinds import WINDOWS, Programme
from vusfa.sources.render.outline import Wall, overlaps
from vusfa.sources.render.plan import Picture, Window

__all__ = ["decorate", "is_hidden"]

_MOST_WINDOWS = 3


def is_hidden(draft: Draft, wall: Wall, a: float, b: float, low: float, depth: float = 0.5) -> bool:
    """Whether the part a..b of a wall is taken, or furniture within ``depth`` hides it above ``low``."""
    for item in draft.items:
        if item.role != "floor" or item.elevation + item.model.height <= low:
            continue
        x0, z0, x1, z1 = item.rect
        corner, normal, along = wall.corner, wall.normal, wall.along
        near = min(
            (x - corner[0]) * normal[0] + (z - corner[1]) * normal[1] for x in (x0, x1) for z in (z0, z1)
        )
        if -0.05 < near < depth:
            ends = sorted(
                (x - corner[0]) * along[0] + (z - corner[1]) * along[1] for x, z in ((x0, z0), (x1, z1))
            )
            if ends[0] < b and a < ends[1]:
                return True
    return any(span.meets(wall, a, b) for span in draft.spans)


def _window(draft: Draft, wall: Wall, t: float, view: int) -> float:
    model = draft.catalogue[draft.rng.choice(WINDOWS)]
    if t + model.width >= wall.length - 0.05 or is_hidden(draft, wall, t, t + model.width, 0.9):
        return 0.0
    middle = t + model.width / 2
    x, z = wall.point(middle)
    at, elevation = (round(x, 4), round(z, 4)), model.elevation
    draft.windows.append(Window(model.name, at, wall.facing, view, elevation, model.exact_size))
    draft.spans.append(Span(wall, middle, model.width))
    return model.width


def _hung(draft: Draft, programme: Programme, wall: Wall, t: float) -> float:
    model = draft.pick(programme.hung)
    low = model.elevation - 0.02 if model.elevation > 0.3 else 0.05
    if t + model.width >= wall.length - 0.03 or is_hidden(draft, wall, t, t + model.width, low):
        return 0.0
    middle = t + model.width / 2
    x, z = wall.point(middle, model.depth / 2 + 0.005)
    item = Placed(model, x, z, wall.facing, model.elevation, "hung", model.elevation < 2.0)
    if any(overlaps(item.rect, solid) for solid in draft.solids) or not draft.inside(item.rect):
        return 0.0
    draft.fixtures.append(item)
    draft.spans.append(Span(wall, middle, model.width))
    return model.width


def _picture(draft: Draft, wall: Wall, t: float) -> float:
    rng = draft.rng
    width = rng.uniform(0.3, 0.95)
    height = width * rng.uniform(0.65, 1.4)
    middle = rng.uniform(1.3, 1.75)
    low = max(middle - height / 2, 0.3)
    if t + width >= wall.length - 0.05 or is_hidden(draft, wall, t, t + width, low):
        return 0.0
    x, z = wall.point(t + width / 2)
    size = (round(width, 4), round(min(height, 1.2), 4))
    draft.pictures.append(
        Picture((round(x, 4), round(z, 4)), wall.facing, round(middle, 4), size, rng.randrange(1 << 30))
    )
    draft.spans.append(Span(wall, t + width / 2, width))
    return width


def decorate(draft: Draft, programme: Programme, view_seed: int) -> None:
    """Decorate the walls of a furnished draft.

    Args:
        draft: the room; its furniture is not moved.
        programme: what hangs there.
        view_seed: draws the views behind the windows.
    """
    rng = draft.rng
    for wall in draft.walls:
        t = rng.uniform(0.08, 0.3)
        while t < wall.length - 0.25:
            chance = rng.random()
            done = 0.0
            if chance < 0.14 and len(draft.windows) < _MOST_WINDOWS:
                done = _window(draft, wall, t, view_seed + len(draft.spans))
            elif chance < 0.36:
                done = _hung(draft, programme, wall, t)
            # Where a window or a hung piece does not fit, a picture may.
            done = done or _picture(draft, wall, t)
            t += done + rng.uniform(0.12, 0.5) if done else 0.15
