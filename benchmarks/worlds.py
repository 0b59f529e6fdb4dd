"""Rooms of the suites: the bundled four, copies of them, and generated rooms, in memory or as files."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np

from vusfa.scenes import Scene, SceneSet
from vusfa.scenes.graph import default_actions, shortest_path_distances

__all__ = ["generated_files", "tiled", "tiled_files"]


def tiled(rooms: int) -> SceneSet:
    """Make a set of ``rooms`` scenes by repeating the bundled four; each copy is a separate scene.

    Copies share their tables' memory until the set joins them.

    >>> tiled(6).names
    ('bathroom', 'bedroom', 'kitchen', 'living_room', 'bathroom-1', 'bedroom-1')
    """
    return SceneSet(_copies(rooms))


def tiled_files(folder: Path, rooms: int) -> None:
    """Write the scenes of :func:`tiled`, without their pictures, as scene files."""
    for index, scene in enumerate(_copies(rooms)):
        features = scene.features.numpy().astype(np.float16)
        _write(folder, index, scene.name, scene.graph.numpy(), scene.distance.numpy(), features)


def generated_files(folder: Path, rooms: int, width: int = 5, height: int = 4, features: int = 1280) -> None:
    """Write scene files of empty rooms of ``4 * width * height`` states whose features are random numbers,
    without pictures.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     generated_files(Path(folder), 3)
    ...     SceneSet.open(folder)
    SceneSet(room-00000: 80, room-00001: 80, room-00002: 80)
    """
    graph = _empty_room(width, height)
    distance = shortest_path_distances(graph).numpy()
    numbers = np.random.default_rng(0)
    pool = numbers.standard_normal(1 << 22, dtype=np.float32).astype(np.float16)
    size = len(graph) * features
    for index in range(rooms):
        first = numbers.integers(len(pool) - size)
        values = pool[first : first + size].reshape(-1, 1, features)
        _write(folder, index, f"room-{index:05d}", graph, distance, values)


def _copies(rooms: int) -> Iterator[Scene]:
    bundled = SceneSet.bundled().scenes
    for index in range(rooms):
        copy, scene = index // len(bundled), bundled[index % len(bundled)]
        yield scene if copy == 0 else replace(scene, name=f"{scene.name}-{copy}")


def _empty_room(width: int, height: int) -> np.ndarray:
    """Graph of places in a grid with four headings each; state = 4 * place + heading, 0 is up, clockwise."""
    graph = np.full((4 * width * height, 4), -1)
    moves = [(0, 1), (1, 0), (0, -1), (-1, 0)]
    for place, (y, x) in enumerate(itertools.product(range(height), range(width))):
        for heading, (right, up) in enumerate(moves):
            state = 4 * place + heading
            for action, sign in ((0, 1), (3, -1)):
                to_x, to_y = x + sign * right, y + sign * up
                if 0 <= to_x < width and 0 <= to_y < height:
                    graph[state, action] = 4 * (to_y * width + to_x) + heading
            graph[state, 1], graph[state, 2] = (4 * place + (heading + turn) % 4 for turn in (1, -1))
    return graph


def _write(
    folder: Path, index: int, name: str, graph: np.ndarray, distance: np.ndarray, features: np.ndarray
) -> None:
    """A scene file, as other programs write them: not compressed."""
    with h5py.File(folder / f"{index:05d}.h5", "w") as file:
        file.attrs["scene"], file.attrs["actions"] = name, list(default_actions(graph.shape[1]))
        file["graph"] = graph.astype(np.int16)
        file["resnet_feature"], file["shortest_path_distance"] = features, distance.astype(np.int16)
        file["location"] = np.zeros((len(graph), 2), np.float32)
        file["rotation"] = np.zeros(len(graph), np.float32)
