"""Index of a folder of many rooms: their graphs and poses in one file, so that none needs to be opened.

The index is ``.vusfa-rooms.npz`` in the folder; where that may not be written there is none. A room of it is
believed only while its file has the size, the times and the number of then; any other is read from its file.
What the index holds is data, bounded and checked as the files are; one with any fault is made anew.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch

from vusfa import limits
from vusfa.errors import ResultError
from vusfa.files import write_npz
from vusfa.reading import read_npz
from vusfa.scenes.features import StoredFeatures, stamp_of
from vusfa.scenes.scene import Scene
from vusfa.scenes.store import Dump
from vusfa.scenes.validation import name_faults

__all__ = ["INDEX", "SceneIndex", "read_index", "write_index"]

#: Name of an index.
INDEX = ".vusfa-rooms.npz"
#: Datasets that are not in it.
_LEFT = ("resnet_feature", "shortest_path_distance")
#: Types and shapes of its arrays, for R rooms and S states of all; ``size`` has N, A, C and F of each.
_ARRAYS: dict[str, tuple[Any, tuple[int | str | None, ...]]] = {
    "stamp": (np.int64, ("R", 4)),
    "size": (np.int64, ("R", 4)),
    "picture": (np.int64, ("R", 3)),
    "graph": (np.int32, (None,)),
    "location": (np.float32, ("S", 2)),
    "rotation": (np.float32, ("S",)),
    "text": (np.uint8, (None,)),
}


class SceneIndex:
    """Indexes of all folders that many files are opened from.

    Args:
        sources: names and paths of scenes, as :meth:`vusfa.scenes.Scene.open` takes them.

    >>> SceneIndex(["bathroom"]).scene("bathroom") is None
    True
    """

    def __init__(self, sources: Sequence[str | os.PathLike[str]]) -> None:
        counts = Counter(_split(source)[0] for source in sources)
        folders = [folder for folder, count in counts.items() if count >= limits.LAZY_SCENES]
        self._rooms = {folder: read_index(Path(folder)) or {} for folder in folders}
        self._folders = {folder: Path(folder).resolve() for folder in folders}

    def scene(self, source: str | os.PathLike[str]) -> Scene | None:
        """A lazily opened scene; None where the index does not have its file as it now is."""
        folder, name = _split(source)
        found = self._rooms.get(folder, {}).get(name)
        if found is None or not _is_unchanged(found):
            return None
        return Scene.of_dump(found)

    def keep(self, sources: Sequence[str | os.PathLike[str]], scenes: Sequence[Scene]) -> None:
        """Write the index of each folder that has scenes which it lacks; those that are gone are left out."""
        by_folder: dict[str, dict[str, Scene]] = {folder: {} for folder in self._rooms}
        lacking = set()
        for source, scene in zip(sources, scenes, strict=False):  # the last may have been interrupted
            folder, name = _split(source)
            stored = scene.stored
            # not what a link leads to, whose change the link does not show
            if folder not in by_folder or stored is None or stored.path != self._folders[folder] / name:
                continue
            before = self._rooms[folder].pop(name, None)
            if before is None or before.stored is None or before.stored.stamp != stored.stamp:
                lacking.add(folder)
            by_folder[folder][name] = scene
        for folder in lacking:
            others = {
                name: Scene.of_dump(dump) for name, dump in self._rooms[folder].items() if _is_unchanged(dump)
            }
            write_index(Path(folder), {**others, **by_folder[folder]})


def _split(source: str | os.PathLike[str]) -> tuple[str, str]:
    return os.path.split(os.fspath(source))


def _is_unchanged(dump: Dump) -> bool:
    assert dump.stored is not None
    path = dump.stored.path
    try:
        return stamp_of(path) == dump.stored.stamp and not path.is_symlink()
    except OSError:
        return False


def write_index(folder: Path, scenes: Mapping[str, Scene]) -> None:
    """Write the index of a folder, atomically; nothing where the folder may not be written, or it is too
    large.

    Args:
        folder: of the files.
        scenes: by the names of their files, opened lazily; those with attributes that JSON does not have are
            left out.
    """
    rooms = {name: scene for name, scene in scenes.items() if _is_plain(scene.attributes)}
    held = list(rooms.values())
    if not held:
        return
    stored = [scene.stored for scene in held]
    facts = [[name, scene.name, list(scene.actions), scene.attributes] for name, scene in rooms.items()]
    text = np.frombuffer(json.dumps(facts).encode(), np.uint8)
    arrays = {
        "stamp": np.array([file.stamp for file in stored if file is not None], np.int64),
        "size": np.array([[*scene.graph.shape, scene.num_crops, scene.feature_size] for scene in held]),
        "picture": np.array([scene.picture_shape or (0, 0, 0) for scene in held]),
        "graph": np.concatenate([scene.graph.numpy().ravel() for scene in held]).astype(np.int32),
        "location": np.concatenate([scene.location.numpy() for scene in held]),
        "rotation": np.concatenate([scene.rotation.numpy() for scene in held]),
        "text": text,
    }
    if (
        len(text) > limits.MAX_INDEX_TEXT_BYTES
        or sum(x.nbytes for x in arrays.values()) > limits.MAX_NPZ_BYTES
    ):
        return
    with suppress(ResultError):
        write_npz(folder / INDEX, arrays)


def read_index(folder: Path) -> dict[str, Dump] | None:
    """The rooms of a folder's index, by the names of their files; None where it is missing or has any fault.

    Each has the stamp (:func:`vusfa.scenes.features.stamp_of`) of the file that it was read from.
    """
    try:
        arrays = read_npz(folder / INDEX)
        if not _is_sound(arrays):
            return None
        facts = json.loads(arrays["text"].tobytes())
    except (ResultError, ValueError, RecursionError):
        return None
    if not _fits(facts, arrays["size"]):
        return None
    place, graph = folder.resolve(), arrays["graph"].astype(np.int64)
    found, state, edge = {}, 0, 0
    columns = (arrays[name].tolist() for name in ("stamp", "size", "picture"))
    for (file, name, actions, attributes), stamp, (n, a, c, f), picture in zip(facts, *columns, strict=True):
        content = {
            "graph": graph[edge : edge + n * a].reshape(n, a),
            "location": arrays["location"][state : state + n],
            "rotation": arrays["rotation"][state : state + n],
        }
        state, edge = state + n, edge + n * a
        stored = StoredFeatures(place / file, torch.Size((n, c, f)), tuple(stamp))
        shape: Any = tuple(picture) if any(picture) else None
        found[file] = Dump(name, content, tuple(actions), attributes, shape, left=[*_LEFT], stored=stored)
    return found


def _is_sound(arrays: Mapping[str, np.ndarray]) -> bool:
    """Whether arrays are those of an index, and the numbers in them have no fault."""
    if any(name not in arrays or arrays[name].dtype != dtype for name, (dtype, _) in _ARRAYS.items()):
        return False
    lengths = {"R": arrays["size"].shape[:1], "S": arrays["rotation"].shape[:1]}
    for name, (_, shape) in _ARRAYS.items():
        known = [lengths[side] if isinstance(side, str) else (side,) for side in shape]
        if arrays[name].ndim != len(shape) or any(
            side not in (None, given) for given, (side,) in zip(arrays[name].shape, known, strict=True)
        ):
            return False
    size, picture, graph = arrays["size"], arrays["picture"], arrays["graph"]
    most = np.array([limits.MAX_STATES, limits.MAX_NPZ_ELEMENTS, 1 << 31, 1 << 31])
    if not len(size) or ((size < 1) | (size > most)).any() or size[:, 0].sum() != len(arrays["rotation"]):
        return False
    if (size[:, 0] * size[:, 1]).sum() != len(graph) or len(arrays["text"]) > limits.MAX_INDEX_TEXT_BYTES:
        return False
    states = np.repeat(size[:, 0], size[:, 0] * size[:, 1])
    sides = picture[picture.any(1)]
    return bool(
        ((graph >= -1) & (graph < states)).all()
        and all(np.isfinite(arrays[name]).all() for name in ("location", "rotation"))
        and ((sides >= 1) & (sides <= limits.MAX_PICTURE_SIDE)).all()
        and (sides[:, 2] == 3).all()
    )


def _fits(facts: Any, size: np.ndarray) -> bool:
    """Whether the text of an index names a file, a scene, its actions and attributes for every room."""
    if not isinstance(facts, list) or len(facts) != len(size):
        return False
    files = set()
    for room, num_actions in zip(facts, size[:, 1].tolist(), strict=True):
        if not isinstance(room, list) or len(room) != 4:
            return False
        file, name, actions, attributes = room
        if not isinstance(file, str) or os.path.basename(file) != file or not file.isprintable():
            return False
        if name_faults(name) or not isinstance(actions, list) or len(actions) != num_actions:
            return False
        if not all(isinstance(action, str) for action in actions) or not _is_plain(attributes):
            return False
        files.add(file)
    return len(files) == len(facts)


def _is_plain(attributes: Any) -> bool:
    """Whether attributes are text, numbers and lists of these, by names."""
    if not isinstance(attributes, dict):
        return False
    return all(_is_plain_value(value) for value in attributes.values())


def _is_plain_value(value: Any) -> bool:
    if isinstance(value, list):
        return all(map(_is_plain_value, value))
    return isinstance(value, str | int | float)
