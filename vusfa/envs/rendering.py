"""Rendering with Pillow alone: an agent's view, its goal, and a map of the scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor

from vusfa.errors import ConfigError
from vusfa.scenes import Scene, SceneSet
from vusfa.scenes.poses import dart, places, step_length

__all__ = ["draw_map", "draw_panels", "draw_values"]

_PANELS = ("view", "goal", "map")
_HEIGHT = 150  # of a map that stands alone, in pixels
_GAP = 8  # between panels
_SMOOTH = 4  # drawn this many times larger, then shrunk
_PAPER, _FLOOR, _EDGE = (250, 250, 247), (221, 224, 230), (188, 193, 203)
_AGENT, _TRAIL, _GOAL = (31, 97, 182), (142, 178, 224), (214, 69, 44)
_LOW, _HIGH = (232, 240, 250), (9, 48, 107)  # of values from 0 to 1

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
    floor = _Floor(scene, size)
    path = [floor.pixel(scene.location[state]) for state in trail]
    floor.draw.line(path, fill=_TRAIL, width=max(_SMOOTH, int(floor.half / 3)), joint="curve")
    floor.dart(goal, _GOAL)
    floor.dart(trail[-1], _AGENT, 0.9)
    return floor.shrunk()


def draw_values(scene: Scene, values: Tensor, goals: Sequence[int] = (), size: int = 300) -> np.ndarray:
    """Map of a scene whose places have the color of the mean of their states' values; (size, size, 3) uint8.

    Args:
        scene: the scene.
        values: (N,) of its states, 0 to 1: from light to dark; NaN: grey.
        goals: state ids within the scene, drawn as arrows.
        size: pixels per side.

    >>> bathroom = Scene.bundled("bathroom")
    >>> draw_values(bathroom, torch.rand(bathroom.num_states), goals=[73], size=64).shape
    (64, 64, 3)
    """
    cells, place = torch.unique(scene.location, dim=0, return_inverse=True)
    known = ~values.isnan()
    sums = torch.zeros(2, len(cells), dtype=torch.float64)
    sums.index_add_(1, place[known], torch.stack([values[known].double(), known[known].double()]))
    floor = _Floor(scene, size)
    low, high = (torch.tensor(color, dtype=torch.float64) for color in (_LOW, _HIGH))
    for cell, value in zip(cells, (sums[0] / sums[1]).tolist(), strict=True):
        if not math.isnan(value):
            floor.square(cell, tuple(torch.lerp(low, high, value).round().int().tolist()))
    for goal in goals:
        floor.dart(goal, _GOAL)
    return floor.shrunk()


class _Floor:
    """The places of a scene, drawn several times larger than they will be."""

    def __init__(self, scene: Scene, size: int) -> None:
        self.scene, self.size = scene, size
        cells = places(scene.location)
        cell = step_length(cells)
        self._low, high = cells.amin(0) - cell, cells.amax(0) + cell
        self._side = size * _SMOOTH
        self._scale = self._side / max(float((high - self._low).max()), 1e-6)
        margins = ((self._side - self._scale * float(length)) / 2 for length in (high - self._low))
        self._left, self._bottom = margins
        self.half = cell * self._scale / 2
        self._image = Image.new("RGB", (self._side, self._side), _PAPER)
        self.draw = ImageDraw.Draw(self._image)
        for place in cells:
            self.square(place, _FLOOR)

    def pixel(self, place: Tensor) -> _Point:
        x, z = ((place - self._low) * self._scale).tolist()
        return self._left + x, self._side - self._bottom - z

    def square(self, place: Tensor, color: Any) -> None:
        (x, y), half = self.pixel(place), self.half
        corners = [x - half, y - half, x + half, y + half]
        self.draw.rectangle(corners, fill=color, outline=_EDGE, width=_SMOOTH // 2)

    def dart(self, state: int, color: Any, size: float = 1.0) -> None:
        x, y = self.pixel(self.scene.location[state])
        length = size * max(self.half * 0.9, self._side * 0.04)  # to be seen in large rooms, too
        corners = dart(float(self.scene.rotation[state]))
        self.draw.polygon([(x + length * right, y + length * down) for right, down in corners], fill=color)

    def shrunk(self) -> np.ndarray:
        return np.asarray(self._image.resize((self.size, self.size), Image.Resampling.LANCZOS))
