"""The textures of one plan's floor, ceiling and walls, each drawn in turn from the plan's one seed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vusfa.sources.render import textures
from vusfa.sources.render.outline import Rect
from vusfa.sources.render.plan import Plan

__all__ = ["Textures", "draw_textures"]

# Hues a golden section apart never come near one another again.
_HUE_STEP = 0.618


@dataclass(frozen=True, eq=False)
class Textures:
    """sRGB arrays (height, width, 3), the top row first.

    Args:
        floors: rectangle and texture of each, the later ones over the earlier ones.
        ceiling: of the whole room.
        walls: one for each of ``plan.walls``.
        lintels: one for each of the plan's lintels, for all of its sides.
    """

    floors: list[tuple[Rect, np.ndarray]]
    ceiling: np.ndarray
    walls: list[np.ndarray]
    lintels: list[np.ndarray]


def draw_textures(plan: Plan) -> Textures:
    """Draw all surfaces of a room.

    Walls take the patterns that the plan names; where it names none the seed puts all patterns in an order,
    so that no two of nine walls share one. Every wall has a hue of its own.

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
