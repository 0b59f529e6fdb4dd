"""Opening and replacing HDF5 files: no handle outlives its block, and files are replaced atomically."""

from __future__ import annotations

import math
import mmap
import os
import stat
import uuid
from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from vusfa import limits
from vusfa.errors import SceneError, VusfaError
from vusfa.limits import brief

__all__ = [
    "check_heaps",
    "copy_others",
    "dataset_in",
    "opened",
    "plain",
    "read_all",
    "read_attributes",
    "read_distances",
    "read_features",
    "replaced",
    "row_blocks",
]

_NUMBERS_AT_ONCE = 1 << 22
#: Size up to which reading a file costs less than mapping it.
_READ_WHOLE = 1 << 21


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """A file open for reading within a ``with`` block.

    Raises:
        SceneError: the file is missing, locked, unreadable, truncated, damaged, or no HDF5 file.
    """
    try:
        kind = os.stat(path).st_mode
    except (OSError, ValueError):
        kind = stat.S_IFDIR
    if not stat.S_ISREG(kind):
        fault = "there is no such file" if stat.S_ISDIR(kind) else "is no regular file"
        raise SceneError(f"{path}: {fault}; check the path")
    try:
        # with the library's own settings, as h5py's are: half of the time
        with h5py.File(h5py.h5f.open(os.fsencode(path), h5py.h5f.ACC_RDONLY)) as file:
            yield file
    except PermissionError as error:
        raise SceneError(f"{path}: may not be read ({error.strerror}); change its permissions") from error
    # h5py raises any of these for a damaged file.
    except (OSError, RuntimeError, KeyError, ValueError) as error:
        if isinstance(error, VusfaError):
            raise
        if isinstance(error, BlockingIOError) or "unable to lock" in str(error):
            raise SceneError(
                f"{path}: is locked, or its disk has no file locks; close the program that writes it, or set"
                f" the environment variable HDF5_USE_FILE_LOCKING=FALSE if none does"
            ) from error
        raise SceneError(
            f"{path}: cannot be read as HDF5 ({error}); the file is truncated, damaged or something else:"
            f" copy it or make it again"
        ) from error


def check_heaps(path: Path) -> int:
    """Check the global heaps of a file, which hold text and JPEG files; return the largest size in bytes.

    The HDF5 library, at least up to version 2.0, hangs on a heap that was overwritten with zeros.

    Raises:
        SceneError: a heap is damaged.
    """
    objects = largest = 0
    with ExitStack() as stack:
        file = stack.enter_context(open(path, "rb"))
        data: bytes | mmap.mmap
        if os.fstat(file.fileno()).st_size <= _READ_WHOLE:
            data = file.read()
        else:
            data = stack.enter_context(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
        heap = data.find(b"GCOL")
        while heap >= 0:
            end = heap + int.from_bytes(data[heap + 8 : heap + 16], "little")
            place = heap + 16
            while place + 16 <= end <= len(data):
                size = int.from_bytes(data[place + 8 : place + 16], "little")
                step = 16 + (size + 7) // 8 * 8 if any(data[place : place + 2]) else size
                objects, largest = objects + 1, max(largest, size)
                if step == 0 or objects > limits.MAX_HEAP_OBJECTS:
                    raise SceneError(f"{path}: is damaged at byte {place}; copy the file or make it again")
                place += step
            heap = data.find(b"GCOL", heap + 4)
    return largest


def read_attributes(file: h5py.File, largest: int) -> dict[str, Any]:
    """The attributes of a file as plain values.

    Entries can share a text: each may have up to ``largest`` bytes, see :func:`check_heaps`.

    Raises:
        OSError: an attribute declares more than :data:`vusfa.limits.MAX_ATTRIBUTE_BYTES`.
    """
    values, attributes = {}, file.attrs
    for key in attributes:
        declared = attributes.get_id(key)
        kind, shape = declared.dtype, declared.shape
        held = largest if kind.hasobject else kind.itemsize
        size, most = math.prod(shape or ()) * held, limits.MAX_ATTRIBUTE_BYTES
        if size > most:
            raise OSError(f"attribute {brief(key)} declares up to {size} bytes; at most {most} are read")
        text = h5py.check_string_dtype(kind)
        if shape is not None and text is not None and text.length is None:  # as h5py does, but opened once
            found = np.zeros(shape, kind)
            declared.read(found)
            values[key] = plain(found, "surrogateescape")
        else:
            values[key] = plain(attributes[key])
    return values


@contextmanager
def replaced(path: Path) -> Iterator[h5py.File]:
    """A new file, open for writing within a ``with`` block that then replaces the old one.

    Until then it has a temporary name in the same folder; if the block fails it is removed, and the old
    file is unchanged.

    Raises:
        SceneError: the file cannot be written.
    """
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.part")
    try:
        with h5py.File(temporary, "w") as file:
            yield file
        temporary.replace(path)
    except OSError as error:
        raise SceneError(f"{path}: cannot be written ({error}); check folder, rights and space") from error
    finally:
        temporary.unlink(missing_ok=True)


def dataset_in(file: h5py.File, name: str) -> h5py.Dataset | None:
    """A dataset by name; None when there is none, or a group of that name.

    Raises:
        OSError: its data lie outside the file (a link, external storage, a virtual dataset), or it declares
            more than :mod:`vusfa.limits` allows. Nothing outside the file is opened.
    """
    links, key = file.id.links, name.encode()  # the low-level interface takes a fraction of the time
    if not links.exists(key):
        return None
    if links.get_info(key).type != h5py.h5l.TYPE_HARD:
        raise OSError("it is a link to another place; store the data in the file itself")
    there = h5py.h5o.open(file.id, key)
    if not isinstance(there, h5py.h5d.DatasetID):
        return None
    made = there.get_create_plist()
    if made.get_external_count() or made.get_layout() == h5py.h5d.VIRTUAL:
        raise OSError("its data lie outside the file; store them in the file itself")
    found = h5py.Dataset(there)
    fault = size_fault(there, made)
    if fault is not None:
        raise OSError(fault)
    return found


def read_all(dataset: h5py.Dataset) -> np.ndarray:
    """A dataset as an array; numbers take few calls of the library."""
    there = dataset.id
    kind, shape = there.dtype, there.shape
    if kind.kind not in "iuf" or not shape or 0 in shape:
        return np.asarray(dataset[()])
    values = np.empty(shape, kind)
    there.read(h5py.h5s.ALL, h5py.h5s.ALL, values)
    return values


def read_distances(dataset: h5py.Dataset) -> np.ndarray:
    """A table of distances (N, N), in int16 where all possible values fit; larger ones are clipped.

    Rows are read in blocks: other programs write 8 bytes per distance.
    """
    square = dataset.ndim == 2 and dataset.shape[0] == dataset.shape[1] > 0
    if not square or dataset.dtype.kind not in "iu" or dataset.dtype == np.int16:
        return np.asarray(dataset[()])
    table = np.empty(dataset.shape, np.int16)  # of at most limits.TABLE_STATES states
    for rows in row_blocks(dataset):
        table[rows] = np.clip(dataset[rows], -2, np.iinfo(np.int16).max)
    return table


def read_features(dataset: h5py.Dataset) -> np.ndarray:
    """Features (N, C, F) in float32, read in blocks of rows: other programs write 2 or 8 bytes per number.

    Values too large for float32 become infinite, which :mod:`vusfa.scenes.validation` finds.
    """
    if dataset.ndim != 3 or dataset.dtype.kind != "f" or dataset.dtype == np.float32:
        return np.asarray(dataset[()])
    features = np.empty(dataset.shape, np.float32)
    with np.errstate(over="ignore"):
        for rows in row_blocks(dataset):
            features[rows] = dataset[rows]
    return features


def row_blocks(array: h5py.Dataset | np.ndarray) -> Iterator[slice]:
    """Blocks of rows of an array; those of a dataset are whole chunks."""
    chunk = array.chunks[0] if isinstance(array, h5py.Dataset) and array.chunks else 1
    rows = chunk * max(1, _NUMBERS_AT_ONCE // max(1, chunk * math.prod(array.shape[1:])))
    return (slice(first, first + rows) for first in range(0, len(array), rows))


def copy_others(source: Path, target: h5py.File, known: Collection[str], stale: Collection[str] = ()) -> None:
    """Copy the entries of a file that are not the content of a scene.

    Unknown datasets, groups and links are copied unchanged, except datasets whose data lie in another
    file; known datasets have only their attributes copied.

    Args:
        source: the file to copy from.
        target: an open file with its own datasets.
        known: names of a scene's datasets.
        stale: those of them with new content, whose attributes are not copied.

    Raises:
        SceneError: an entry cannot be copied.
    """
    with opened(source) as file:
        for name in file:
            link = file.get(name, getlink=True)
            if not isinstance(link, h5py.HardLink):
                if name not in known:
                    target[name] = link
                continue
            found = file[name]
            if name in known:
                if name in target and name not in stale:
                    _copy_attributes(found, target[name])
            elif not (isinstance(found, h5py.Dataset) and (found.external or found.is_virtual)):
                file.copy(name, target)


def _copy_attributes(source: h5py.Dataset, target: h5py.Dataset) -> None:
    for key in source.attrs:
        kind = source.attrs.get_id(key).dtype
        if (key not in target.attrs and kind.kind != "O") or h5py.check_string_dtype(kind):
            target.attrs.create(key, source.attrs[key], dtype=kind)


def size_fault(dataset: h5py.h5d.DatasetID, made: h5py.h5p.PropDCID) -> str | None:
    """Fault of a dataset that declares more than it can hold or more than may be read; None without one."""
    shape, itemsize, stored = dataset.shape or (), dataset.dtype.itemsize, dataset.get_storage_size()
    declared = math.prod(shape) * itemsize
    if shape and shape[0] > limits.MAX_STATES:
        return f"declares {shape[0]} states; at most {limits.MAX_STATES} are read"
    times = limits.MAX_PICTURE_COMPRESSION if len(shape) == 4 else limits.MAX_COMPRESSION
    if declared > max(limits.UNCOMPRESSED_BYTES, times * stored):
        return f"declares {declared} bytes, but {stored} are stored; at most {times} times that are read"
    most, needed = limits.MAX_EXTRA_BYTES, 4 * math.prod(shape)
    if len(shape) == 3 and needed > stored + most:
        return (
            f"needs {needed} bytes as float32, but {stored} are stored; at most {most} more are allowed:"
            " store float32, or fewer crops"
        )
    most = limits.MAX_CHUNK_BYTES
    chunks = made.get_chunk() if made.get_layout() == h5py.h5d.CHUNKED else None
    if chunks and math.prod(chunks) * itemsize > most:
        return f"has chunks of shape {chunks}; at most {most} bytes per chunk are read"
    return None


def plain(value: Any, errors: str = "replace") -> Any:
    """An attribute's value as str, int, float, bool, or lists of these; ``errors`` as for ``bytes.decode``.

    >>> plain(np.array([b"a", b"b"])), plain(np.float64(0.5)), plain(np.arange(3))
    (['a', 'b'], 0.5, [0, 1, 2])
    """
    if isinstance(value, bytes):
        return value.decode("utf-8", errors)
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist(), errors)
    if isinstance(value, list):
        return [plain(item, errors) for item in value]
    return value
