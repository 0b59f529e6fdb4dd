"""Where the files that a run was given are, as seen from its folder: they are found again when both have
moved, and its files tell no absolute path of their author's machine."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from vusfa.scenes import SceneSet, bundled_names
from vusfa.scenes.store import bundled_path

__all__ = [
    "find_given",
    "find_sources",
    "opened_from",
    "scene_sources",
    "settings_seen_from",
    "with_goals",
    "without_places",
]


def scene_sources(scenes: str | Sequence[str], folder: str | Path) -> list[str]:
    """Names and paths of scenes; paths relative to the checkpoint's folder, so that both may move together.

    >>> scene_sources(["kitchen", "rooms/hall.h5"], "runs/a")
    ['kitchen', '../../rooms/hall.h5']
    """
    given, bundled = [scenes] if isinstance(scenes, str) else list(scenes), bundled_names()
    return [
        name if name in bundled else os.path.relpath(os.path.realpath(name), os.path.realpath(folder))
        for name in given
    ]


def opened_from(scenes: SceneSet) -> list[str]:
    """Names of bundled rooms and paths of other files that scenes were read from; "" for one in memory.

    >>> opened_from(SceneSet.bundled(["kitchen", "bathroom"]))
    ['kitchen', 'bathroom']
    """
    bundled = {bundled_path(name).resolve(): name for name in bundled_names()}
    return [bundled.get(scene.path, str(scene.path)) if scene.path else "" for scene in scenes.scenes]


def find_sources(sources: Sequence[str], checkpoint: Path) -> list[str]:
    """Where a checkpoint's scenes are now: where they were, seen from the checkpoint, or else beside that."""
    folder, bundled = os.path.dirname(os.path.realpath(checkpoint)), bundled_names()
    found = []
    for source in sources:
        place = os.path.normpath(os.path.join(folder, source))
        beside = os.path.join(folder, os.path.basename(place))
        moved = os.path.isfile(beside) and not os.path.exists(place)
        found.append(source if source in bundled or not source else beside if moved else place)
    return found


def find_given(source: str, checkpoint: Path) -> str:
    """As :func:`find_sources`; what is not there stays as it is, as version 0.1 wrote it."""
    (found,) = find_sources([source], checkpoint)
    return found if os.path.isfile(found) else source


def settings_seen_from(folder: str | Path, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings as files in a run's folder hold them: scenes and lists of goals as seen from there, of other
    places the last part.

    >>> given = {"scenes": "/x/hall.h5", "folder": "/x/runs/a", "env": {"goals": "/x/few.yaml"}}
    >>> settings_seen_from("/x/runs/a", given)
    {'scenes': ['../../hall.h5'], 'folder': '.../a', 'env': {'goals': '../../few.yaml'}}
    """
    seen = with_goals(settings, lambda path: scene_sources(path, folder)[0])
    places = {name: without_places(settings[name]) for name in ("folder", "resume") if name in settings}
    return {**seen, **places, "scenes": scene_sources(settings["scenes"], folder)}


def with_goals(settings: Mapping[str, Any], change: Callable[[str], str]) -> dict[str, Any]:
    """Settings whose paths of lists of goals (``env.goals``, ``evaluation.goals``) are changed."""
    changed = dict(settings)
    for group in ("env", "evaluation"):
        goals = settings[group].get("goals") if isinstance(settings.get(group), Mapping) else None
        if isinstance(goals, str) and Path(goals).suffix in (".yaml", ".yml"):
            changed[group] = {**settings[group], "goals": change(goals)}
    return changed


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
