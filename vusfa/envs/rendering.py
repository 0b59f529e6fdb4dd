"""Rendering with Pillow alone: an agent's view, its goal, and a map of the scene."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor

from vusfa.errors import ConfigError
from vusfa.scenes import Scene, SceneSet
from vusfa.scenes.poses import dart, places, step_length

__all__ = ["draw_map", "draw_panels"]

_PANELS = ("view", "goal", "map")
_HEIGHT = 150  # of a map that stands alone, in pixels
_GAP = 8  # between panels
_SMOOTH = 4  # drawn this many times larger, then shrunk
_PAPER, _FLOOR, _EDGE = (250, 250, 247), (221, 224, 230), (188, 193, 203)
_AGENT, _TRAIL, _GOAL = (31, 97, 182), (142, 178, 224), (214, 69, 44)

_Point = tuple[float, float]


def draw_panels(
    scenes: SceneSet, trail: Sequence[int], goal: int, panels: Sequence[str] | None = None
) -> np.ndarray:
    """Panels side by side, (h, w, 3) uint8.

    Args:
        scenes: the world.
        trail: global ids of the states that the agent came through, the last where it is.
        goal: global id.
        panels: see :meth:`TargetNavEnv.render`.

    Raises:
        ConfigError: no panels, or one that does not exist.
        SceneError: the scene has no pictures.

    >>> draw_panels(SceneSet.bundled(["bathroom"]), [0, 1], 73, ["map"]).dtype
    dtype('uint8')
    """
    scene = scenes.scenes[int(scenes.scene_id[trail[-1]])]
    if panels is None:
        panels = ("view",) if scene.has_pictures else ("map",)
    unknown = [panel for panel in panels if panel not in _PANELS]
    if unknown or isinstance(panels, str) or not panels:
        raise ConfigError(f"panels are {panels!r}; give any of {_PANELS} as a list")
    height = scene.picture_shape[0] if scene.picture_shape is not None else _HEIGHT
    local = scenes.local_id(torch.tensor([*trail, goal])).tolist()
    found = []
    for panel in panels:
        if panel == "map":
            found.append(draw_map(scene, local[:-1], local[-1], height))
        else:
            found.append(scene.pictures(local[-1] if panel == "goal" else local[-2]).numpy())
    gap = np.full((height, _GAP, 3), 255, np.uint8)
    parts = [part for picture in found for part in (gap, picture)][1:]
    return np.concatenate(parts, axis=1)


def draw_map(scene: Scene, trail: Sequence[int], goal: int, size: int = _HEIGHT) -> np.ndarray:
    """Map of a scene from above, +Z up, with arrows where agent and goal look; (size, size, 3) uint8.

    Args:
        scene: the scene; its ``location`` and ``rotation`` are drawn.
        trail: state ids within the scene that the agent came through, the last where it is.
        goal: state id within the scene.
        size: pixels per side.

    >>> draw_map(Scene.bundled("bathroom"), [0], goal=73, size=64).shape
    (64, 64, 3)
    """
    cells = places(scene.location)
    cell = step_length(cells)
    low, high = cells.amin(0) - cell, cells.amax(0) + cell
    side = size * _SMOOTH
    scale = side / max(float((high - low).max()), 1e-6)
    left, bottom = ((side - scale * float(length)) / 2 for length in (high - low))

    def pixel(place: Tensor) -> _Point:
        x, z = ((place - low) * scale).tolist()
        return left + x, side - bottom - z

    image = Image.new("RGB", (side, side), _PAPER)
    draw = ImageDraw.Draw(image)
    half = cell * scale / 2
    for place in cells:
        x, y = pixel(place)
        draw.rectangle(
            [x - half, y - half, x + half, y + half], fill=_FLOOR, outline=_EDGE, width=_SMOOTH // 2
        )
    path = [pixel(scene.location[state]) for state in trail]
    draw.line(path, fill=_TRAIL, width=max(_SMOOTH, int(half / 3)), joint="curve")
    longest = max(half * 0.9, side * 0.04)  # to be seen in large rooms, too
    for state, color, length in ((goal, _GOAL, longest), (trail[-1], _AGENT, longest * 0.9)):
        x, y = pixel(scene.location[state])
        corners = dart(float(scene.rotation[state]))
        draw.polygon([(x + length * right, y + length * down) for right, down in corners], fill=color)
    return np.asarray(image.resize((size, size), Image.Resampling.LANCZOS))
