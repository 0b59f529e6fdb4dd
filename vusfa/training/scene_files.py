"""Where a checkpoint's scenes are, as seen from it: they are found again when both have moved."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vusfa.scenes import bundled_names

__all__ = ["PLACES", "find_source", "scene_sources", "without_places"]

#: Settings that say where something is, and that a resumed run does not take from its checkpoint.
PLACES = ("scenes", "folder", "resume")


def scene_sources(scenes: str | Sequence[str], folder: str | Path) -> list[str]:
    """Names and paths of scenes; paths relative to the checkpoint's folder, so that both may move together.

    >>> scene_sources(["kitchen", "rooms/hall.h5"], "runs/a")
    ['kitchen', '../../rooms/hall.h5']
    """
    given = [scenes] if isinstance(scenes, str) else list(scenes)
    return [
        name if name in bundled_names() else os.path.relpath(os.path.realpath(name), os.path.realpath(folder))
        for name in given
    ]


def find_source(source: str, checkpoint: Path) -> str:
    """Where a checkpoint's scene is now: where it was, seen from the checkpoint, or else beside that."""
    folder = Path(os.path.realpath(checkpoint)).parent
    if source in bundled_names() or not source:
        return source
    place = Path(os.path.normpath(folder / source))
    beside = folder / place.name
    return str(beside if beside.is_file() and not place.exists() else place)


def without_places(value: Any) -> Any:
    """Plain data whose absolute paths keep their last part: a checkpoint tells nothing of its author's disk.

    >>> without_places(["folder=/home/me/runs/a", "scenes=[/x/y/hall.h5,kitchen]", "seed=1"])
    ['folder=.../a', 'scenes=[.../hall.h5,kitchen]', 'seed=1']
    """
    if isinstance(value, list):
        return [without_places(item) for item in value]
    if not isinstance(value, str):
        return value
    return re.sub(r"(?<![\w.$:/])/(?:[^/,'\"\[\]]+/)*([^/,'\"\[\]]+)", r".../\1", value)
