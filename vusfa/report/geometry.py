"""Where a scene's states lie on a floor map: each place a square, each heading a slice of it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from vusfa.report.packing import pack_ids
from vusfa.scenes import Scene
from vusfa.scenes.poses import step_length

__all__ = ["floor_plan", "slices"]


def slices(location: np.ndarray, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A slice of a square for every state, so that no two states cover each other.

    States of one place share its square; each gets the angles that are nearer to its heading than to the
    others'. Four headings give four triangles. Where two states have the same pose as well, the states are
    laid out on a grid in the order of their ids instead, a square each: there is no map to draw.

    Args:
        location: (N, 2) metres.
        rotation: (N,) degrees, 0 = up, 90 = right.

    Returns:
        centre of the square (N, 2) metres; first and last angle of the slice, (N,) degrees each.

    >>> centre, first, last = slices(np.zeros((2, 2)), np.array([0.0, 90.0]))
    >>> first.tolist(), last.tolist()
    ([-135.0, 45.0], [45.0, 225.0])
    """
    count = len(location)
    centre, first, last = location.astype(np.float64).copy(), np.zeros(count), np.full(count, 360.0)
    _, place = np.unique(np.round(location, 3), axis=0, return_inverse=True)
    place = place.reshape(-1)
    for members in (np.flatnonzero(place == here) for here in range(place.max() + 1)):
        if len(members) == 1:
            continue
        heading = np.mod(rotation[members].astype(np.float64), 360.0)
        order = np.argsort(heading, kind="stable")
        sorted_headings = heading[order]
        gap = np.mod(np.roll(sorted_headings, -1) - sorted_headings, 360.0)
        if (gap < 1e-3).any():
            return _grid(count)
        first[members[order]] = sorted_headings - np.roll(gap, 1) / 2
        last[members[order]] = sorted_headings + gap / 2
    return centre, first, last


def _grid(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    width = math.ceil(math.sqrt(count))
    ids = np.arange(count)
    centre = np.stack([ids % width, -(ids // width)], 1).astype(np.float64)
    return centre, np.zeros(count), np.full(count, 360.0)


def floor_plan(scene: Scene) -> dict[str, Any]:
    """A scene's map as the page draws it.

    Args:
        scene: the scene.

    Returns:
        plain data: name, states (N), actions (names), cell (side of a square, metres), metric (False where
        the places are made up), x, z (N numbers, metres, +z up), first, last (N, degrees), heading (N,
        degrees), next (packed (N, A): the state each action leads to; a blocked one leads back).

    >>> plan = floor_plan(Scene.bundled("bathroom"))
    >>> plan["states"], plan["cell"], len(plan["x"])
    (176, 0.5, 176)
    """
    location, rotation = scene.location.numpy(), scene.rotation.numpy()
    centre, first, last = slices(location, rotation)
    graph = scene.graph.numpy()
    stay = np.arange(len(graph))[:, None]
    metric = bool(np.allclose(centre, location))
    return {
        "name": scene.name,
        "states": scene.num_states,
        "actions": list(scene.actions),
        "cell": round(step_length(scene.location), 3) if metric else 1.0,
        "metric": metric,
        "x": np.round(centre[:, 0], 3).tolist(),
        "z": np.round(centre[:, 1], 3).tolist(),
        "first": np.round(first, 2).tolist(),
        "last": np.round(last, 2).tolist(),
        "heading": np.round(rotation, 2).tolist(),
        "next": pack_ids(np.where(graph < 0, stay, graph)),
    }
