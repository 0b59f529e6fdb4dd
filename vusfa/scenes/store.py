"""Scenes on disk: HDF5 files in the schema of the THOR v1 dumps (Zhu et al., arXiv 1609.05143).

| dataset | content |
|---|---|
| graph (N, A) | next state, -1 = blocked; any integers |
| resnet_feature (N, C, F) | features of each state's C crops, of any network; any floats |
| location (N, 2), rotation (N,) | metres, degrees |
| shortest_path_distance (N, N) | in actions, -1 = unreachable; any integers; not read above 4096 states |
| observation, or observation_jpeg | optional: the pictures, see :mod:`vusfa.scenes.pictures` |

Attributes hold the provenance; ``scene`` and ``actions`` are the scene's name and the names of its actions.
Every function closes the file before it returns, so that scenes can be forked and pickled.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch

from vusfa.deprecated import moved_names
from vusfa.errors import SceneError
from vusfa.limits import TABLE_STATES
from vusfa.scenes import pictures as picture_files
from vusfa.scenes.features import StoredFeatures, stamp_of
from vusfa.scenes.hdf5 import (
    check_heaps,
    copy_others,
    dataset_in,
    opened,
    read_all,
    read_attributes,
    read_distances,
    read_features,
    replaced,
    row_blocks,
)
from vusfa.scenes.validation import DATASETS, array_faults, name_faults, shape_fault

__all__ = ["Dump", "bundled_names", "bundled_path", "read", "validate", "write"]

_BUNDLED = Path(__file__).parent / "bundled"


@dataclass
class Dump:
    """Content of a scene file except its pictures, unchecked.

    Attributes:
        name: attribute ``scene``, or the file's stem.
        arrays: the numeric datasets by name, as far as they can be read.
        actions: attribute ``actions``, or None.
        attributes: all other attributes as plain Python values.
        picture_shape: (H, W, 3), or None without usable pictures.
        reading_faults: faults met while reading, one line each, without the file's name.
        left: datasets that were left in the file, and their shapes fit.
        stored: the features, where they were.
    """

    name: str
    arrays: dict[str, np.ndarray] = field(default_factory=dict)
    actions: tuple[str, ...] | None = None
    attributes: dict[str, Any] = field(default_factory=dict)
    picture_shape: tuple[int, int, int] | None = None
    reading_faults: list[str] = field(default_factory=list)
    left: list[str] = field(default_factory=list)
    stored: StoredFeatures | None = None

    def faults(self) -> list[str]:
        """All faults, including those of the values."""
        unread = [name for name in DATASETS if any(f"{name!r}" in line for line in self.reading_faults)]
        return self.reading_faults + array_faults(self.arrays, self.actions, optional=unread + self.left)


def bundled_names() -> tuple[str, ...]:
    """Names of the rooms that come with the package.

    >>> bundled_names()
    ('bathroom', 'bedroom', 'kitchen', 'living_room')
    """
    return tuple(sorted(path.stem for path in _BUNDLED.glob("*.h5")))


def bundled_path(name: str) -> Path:
    """The file of a room that comes with the package.

    Raises:
        SceneError: there is no such room.

    >>> bundled_path("kitchen").name
    'kitchen.h5'
    """
    if name not in bundled_names():
        raise SceneError(f"no bundled scene is called {name!r}; there are {', '.join(bundled_names())}")
    return _BUNDLED / f"{name}.h5"


def read(path: str | os.PathLike[str], lazy: bool = False) -> Dump:
    """Read everything but the pictures; faults are collected, not raised.

    Args:
        path: the file.
        lazy: leave features and distances in the file.

    Raises:
        SceneError: the file is missing or cannot be opened as HDF5.

    >>> read(bundled_path("bathroom")).arrays["graph"].shape
    (176, 4)
    """
    path = Path(path)
    with opened(path) as file:
        stamp = stamp_of(path)
        attributes = read_attributes(file, check_heaps(path))
        dump = Dump(name=str(attributes.pop("scene", path.stem)))
        dump.reading_faults += name_faults(dump.name)
        if "actions" in attributes:
            dump.actions = tuple(str(action) for action in np.atleast_1d(attributes.pop("actions")))
        dump.attributes = attributes
        for name in DATASETS:
            try:
                dataset = dataset_in(file, name)
                if dataset is None:
                    continue
                shape: tuple[int, ...] = dataset.id.shape or ()
                if lazy and name == "resnet_feature":
                    alike = np.broadcast_to(np.zeros((), dataset.id.dtype), shape)
                    fault = shape_fault(name, alike, len(dump.arrays.get("graph", alike)))
                    if fault is None:
                        dump.left.append(name)
                        dump.stored = StoredFeatures(path.resolve(), torch.Size(shape), stamp)
                    else:
                        dump.reading_faults.append(fault)
                elif name == "resnet_feature":
                    dump.arrays[name] = read_features(dataset)
                elif name != "shortest_path_distance":
                    dump.arrays[name] = read_all(dataset)
                elif not lazy and shape[:1] <= (TABLE_STATES,):
                    dump.arrays[name] = read_distances(dataset)
                elif shape == np.shape(dump.arrays.get("graph", ()))[:1] * 2:
                    dump.left.append(name)
                else:
                    dump.arrays[name] = np.broadcast_to(np.zeros((), dataset.dtype), shape)
            except (OSError, RuntimeError, TypeError, ValueError) as error:
                dump.reading_faults.append(
                    f"dataset {name!r} cannot be read ({error}); copy the file or make it again"
                )
        graph = dump.arrays.get("graph")
        num_states = len(graph) if graph is not None and graph.ndim else None
        dump.picture_shape, faults = picture_files.look(file, num_states)
        dump.reading_faults += faults
    return dump


def validate(path: str | os.PathLike[str], every_picture: bool = False) -> list[str]:
    """All faults of a scene file at once; an empty list for a sound file.

    Each line names the file, the dataset, the state and the remedy.

    Args:
        path: the file.
        every_picture: decode all pictures. By default the header and the end of each are checked, and as many
            decoded, evenly spaced, as a few seconds suffice for: all, in a room of common size.

    >>> validate(bundled_path("bathroom"))
    []
    >>> validate("no_such_room.h5")
    ['no_such_room.h5: there is no such file; check the path']
    """
    path = Path(path)
    try:
        dump = read(path)
    except SceneError as error:
        return [str(error)]
    faults = [f"{path}: {fault}" for fault in dump.faults()]
    if dump.picture_shape is not None and "graph" in dump.arrays and dump.arrays["graph"].ndim:
        try:
            picture_files.check(path, len(dump.arrays["graph"]), every_picture)
        except SceneError as error:
            faults.append(str(error))
    return faults


def _smallest_integer(values: np.ndarray) -> np.dtype:
    return next(
        np.dtype(kind)
        for kind in (np.int16, np.int32, np.int64)
        if values.min() >= np.iinfo(kind).min and values.max() <= np.iinfo(kind).max
    )


def _smallest_float(values: np.ndarray) -> np.dtype:
    """float16 if it holds every value exactly, otherwise float32: reading gives the same values."""
    with np.errstate(over="ignore"):
        exact = all((values[rows].astype(np.float16) == values[rows]).all() for rows in row_blocks(values))
    return np.dtype(np.float16 if exact else np.float32)


def _write_rows(file: h5py.File, name: str, values: np.ndarray, kind: np.dtype) -> None:
    written = file.create_dataset(
        name, values.shape, kind, compression="gzip", compression_opts=9, shuffle=True, fletcher32=True
    )
    for rows in row_blocks(written):
        written[rows] = values[rows].astype(kind)


def _write_attributes(file: h5py.File, attributes: Mapping[str, Any]) -> None:
    for key, value in sorted(attributes.items()):
        try:
            if isinstance(value, list | tuple) and any(isinstance(item, str) for item in value):
                file.attrs.create(key, list(value), dtype=h5py.string_dtype())
            else:
                file.attrs[key] = value
        except (TypeError, ValueError, OSError, RuntimeError) as error:
            raise SceneError(
                f"attribute {key!r} of type {type(value).__name__} cannot be written ({error});"
                f" use str, int, float or a list of one of them"
            ) from error


def write(
    path: str | os.PathLike[str],
    arrays: Mapping[str, np.ndarray],
    *,
    name: str,
    actions: Sequence[str],
    attributes: Mapping[str, Any],
    pictures: np.ndarray | Sequence[bytes] | None = None,
    source: Path | None = None,
    stale: Collection[str] = (),
) -> None:
    """Write a scene file, atomically.

    Integers take the smallest type that holds them; features are float16 where that is exact, else float32.
    Everything except the JPEG files is compressed and has checksums. The same content gives the same bytes.

    Args:
        path: file to write; replaced if it exists.
        arrays: the datasets of :data:`vusfa.scenes.validation.DATASETS`; without the table of distances in
            scenes of more than 4096 states.
        name: the scene's name.
        actions: A names.
        attributes: provenance.
        pictures: (N, H, W, 3) uint8, or N JPEG files; None copies those of ``source`` as they are.
        source: the scene's previous file. Its other entries are copied, see
            :func:`vusfa.scenes.hdf5.copy_others`.
        stale: datasets with new content, whose attributes in ``source`` are not copied.

    Raises:
        SceneError: the file or an attribute cannot be written, or the pictures do not fit.
    """
    path = Path(path)
    num_states = len(arrays["graph"])
    kinds = {"resnet_feature": _smallest_float(arrays["resnet_feature"])}
    kinds |= {key: np.dtype(np.float32) for key in ("location", "rotation")}
    integers = ("graph", "shortest_path_distance")
    kinds |= {key: _smallest_integer(arrays[key]) for key in integers if key in arrays}
    raw: Iterable[np.ndarray] | None = None
    if pictures is None and source is not None:
        pictures, raw = picture_files.stored(source, num_states)
    if isinstance(pictures, np.ndarray):
        raw = [pictures]
        if pictures.dtype != np.uint8 or pictures.ndim != 4 or pictures.shape[3] != 3:
            raise SceneError(
                f"{path}: pictures are {pictures.dtype} of shape {pictures.shape}; give uint8 (N, H, W, 3)"
            )
    if pictures is not None and len(pictures) != num_states:
        raise SceneError(f"{path}: {len(pictures)} pictures for {num_states} states; give one per state")
    with replaced(path) as file:
        _write_attributes(file, {**attributes, "scene": name, "actions": list(actions)})
        for key in (name for name in DATASETS if name in kinds):
            _write_rows(file, key, arrays[key], kinds[key])
        if raw is not None:
            picture_files.write_raw(file, raw, num_states)
        elif pictures is not None:
            picture_files.write_jpegs(file, list(pictures))
        if source is not None:
            copy_others(source, file, {*DATASETS, *picture_files.DATASETS}, stale)


__getattr__ = moved_names(__name__, {"compact": "vusfa.sources.compact.compact"})
