"""Rooms of the suites: the bundled four, or copies of them for a larger world."""

from __future__ import annotations

from dataclasses import replace

from vusfa.scenes import Scene, SceneSet

__all__ = ["tiled"]


def tiled(rooms: int) -> SceneSet:
    """Make a set of ``rooms`` scenes by repeating the bundled four; each copy is a separate scene.

    Copies share their tables' memory until the set joins them.

    >>> tiled(6).names
    ('bathroom', 'bedroom', 'kitchen', 'living_room', 'bathroom-1', 'bedroom-1')
    """
    bundled = SceneSet.bundled().scenes
    return SceneSet(_copy(bundled[i % len(bundled)], i // len(bundled)) for i in range(rooms))


def _copy(scene: Scene, copy: int) -> Scene:
    return scene if copy == 0 else replace(scene, name=f"{scene.name}-{copy}")
