"""Locations of scenes: bundled names, files, folders of files, and patterns."""

from __future__ import annotations

import os
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from glob import glob
from pathlib import Path
from typing import Any

from vusfa.errors import SceneError
from vusfa.limits import LAZY_SCENES, MAX_FAULTS, brief
from vusfa.scenes.index import SceneIndex
from vusfa.scenes.scene import Scene

__all__ = ["Sources", "expanded", "files_in", "listed", "open_scenes"]

#: Names and paths of scenes, folders and patterns, one or several.
Sources = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]

#: Endings of scene files.
SUFFIXES = (".h5", ".hdf5")


def expanded(scenes: Sources, keep: Callable[[str], bool] = lambda path: True) -> list[Any]:
    """Names and files, in order: a folder (``rooms/``) stands for its files ``*.h5`` and ``*.hdf5``, and a
    pattern (``rooms/*_small.h5``) for the files that match it, both sorted by name.

    Args:
        scenes: names, files, folders and patterns.
        keep: whether a file of a folder or a pattern counts.

    Raises:
        SceneError: a folder has no scene files, or no file matches a pattern.

    >>> expanded(["bathroom", "my_room.h5"])
    ['bathroom', 'my_room.h5']
    """
    found: list[Any] = []
    for source in listed(scenes):
        if not isinstance(source, str | os.PathLike):
            raise SceneError(f"{brief(source)} is no scene; give names and files, such as ['bathroom']")
        text = os.fspath(source)
        if os.path.isdir(text):
            inside = files_in(text)
        elif any(sign in text for sign in "*?[") and not os.path.lexists(text):
            inside = sorted(glob(text, recursive=True))
        else:
            found.append(source)
            continue
        inside = list(filter(keep, inside))
        if not inside:
            raise SceneError(f"{text}: there are no scene files ({', '.join(SUFFIXES)}); check the path")
        found += inside
    return found


def files_in(folder: str) -> list[str]:
    """Files of a folder whose names end as those of scenes do, sorted."""
    entries = (entry for entry in os.scandir(folder) if not entry.name.startswith("."))
    return sorted(entry.path for entry in entries if Path(entry.name).suffix in SUFFIXES)


def open_scenes(
    scenes: Sources, skip_broken: bool = False, lazy: bool | None = None
) -> tuple[list[str], list[Scene]]:
    """Names and paths, expanded, and their scenes; arguments and errors of
    :meth:`vusfa.scenes.SceneSet.open`."""
    sources, opened, faults, given = [], [], [], expanded(scenes)
    lazy = len(given) >= LAZY_SCENES if lazy is None else lazy
    for name, most in Counter(filter(None, map(os.fspath, given))).most_common(1):
        if most > 1:
            raise SceneError(f"{most} scenes are called {brief(Path(name).stem)}, of one file; name it once")
    index = SceneIndex(given) if lazy else None
    try:
        for source in given:
            try:
                scene = (index and index.scene(source)) or Scene.open(source, lazy)
                if skip_broken and lazy:
                    _ = scene.features  # checked now, because later it could not be left out
                opened.append(scene)
                sources.append(os.fspath(source))
            except SceneError as error:
                if not skip_broken:
                    raise
                faults.append(error)
    finally:
        if index is not None:
            index.keep(sources, opened)
    if faults:
        listing = "".join(f"\n  - {fault}" for fault in faults[:MAX_FAULTS])
        warnings.warn(f"{len(faults)} scenes cannot be opened and are left out:{listing}", stacklevel=3)
    times = Counter(scene.name for scene in opened)
    for source, scene in zip(sources, opened, strict=True):
        if times[scene.name] > 1 and Path(source).suffix:
            object.__setattr__(scene, "name", Path(source).stem)  # no other reference exists yet
    return sources, opened


def listed(scenes: Sources) -> list[Any]:
    """One name or path, or several, as a list."""
    return list(scenes) if isinstance(scenes, Iterable) and not isinstance(scenes, str) else [scenes]
