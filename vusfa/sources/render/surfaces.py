"""Textures of a plan's floor, ceiling and walls, drawn in this order from the plan's seed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vusfa.sources.render import textures
from vusfa.sources.render.outline import Rect
from vusfa.sources.render.plan import Plan

__all__ = ["Textures", "draw_textures"]

# Multiples of the golden section stay far apart modulo 1.
_HUE_STEP = 0.618


@dataclass(frozen=True, eq=False)
class Textures:
    """sRGB arrays (height, width, 3), the top row first.

    Args:
        floors: a rectangle and a texture each; later ones cover earlier ones.
        ceiling: one texture for the whole room.
        walls: one texture per wall of ``plan.walls``.
        lintels: one texture per lintel of the plan, for all of its sides.
    """

    floors: list[tuple[Rect, np.ndarray]]
    ceiling: np.ndarray
    walls: list[np.ndarray]
    lintels: list[np.ndarray]


def draw_textures(plan: Plan) -> Textures:
    """Draw all surfaces of a room.

    Walls have the patterns that the plan names; by default all nine patterns in an order drawn from the seed.
    Every wall has its own hue.

    >>> [wall.shape for wall in draw_textures(Plan("cell", (2.0, 1.5, 2.6))).walls]
    [(338, 260, 3), (338, 260, 3), (338, 195, 3), (338, 195, 3)]
    """
    rng = textures.random_stream(plan.surfaces.seed)
    width, depth, height = plan.size
    floors = [((0.0, 0.0, width, depth), textures.floor(plan.surfaces.floor, width, depth, rng))]
    ceiling = textures.ceiling(width, depth, rng)
    patterns = list(textures.WALLS)
    rng.shuffle(patterns)
    hue = rng.random_sample()
    patterns = list(plan.surfaces.walls) or patterns
    walls = [
        textures.wall(patterns[k % len(patterns)], hue + k * _HUE_STEP, wall.length, height, rng)
        for k, wall in enumerate(plan.walls)
    ]
    for zone in plan.surfaces.zones:
        x0, z0, x1, z1 = zone.rect
        floors.append((zone.rect, textures.floor(zone.floor, x1 - x0, z1 - z0, rng)))
    lintels = [
        textures.wall("plain", hue + k * _HUE_STEP, 1.0, height - solid.bottom + 0.1, rng)
        for k, solid in enumerate(solid for solid in plan.solids if solid.bottom > 0)
    ]
    return Textures(floors, ceiling, walls, lintels)
