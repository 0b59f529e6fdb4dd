"""Scenes on disk: HDF5 files in the schema of the THOR v1 dumps (Zhu et al., arXiv 1609.05143).

| dataset | content |
|---|---|
| graph (N, A) | next state, -1 = blocked; any integers |
| resnet_feature (N, C, F) | features of each state's C crops, whatever network they come from; any floats |
| location (N, 2), rotation (N,) | metres, degrees |
| shortest_path_distance (N, N) | in actions, -1 = unreachable |
| observation (N, H, W, 3) uint8 | optional: the pictures |
| observation_jpeg (N,) of bytes | optional, ours: the pictures as JPEG files, about ten times smaller |

Attributes carry the provenance; ``scene`` and ``actions`` are the scene's name and the names of its actions. Every
function opens the file, does its work and closes it: no handle outlives a call, so scenes may be forked and pickled.
Files are written under another name beside the final one and then renamed: nobody ever sees half a file.
"""

from __future__ import annotations

import io
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from PIL import Image

from vusfa.errors import SceneError
from vusfa.scenes.faults import DATASETS, array_faults

__all__ = ["Dump", "bundled_names", "bundled_path", "compact", "read", "read_pictures", "validate", "write"]

_BUNDLED = Path(__file__).parent / "bundled"
_JPEG_QUALITY = 92
_PICTURES_AT_ONCE = 32


class Dump:
    """The content of one scene file, as it lies there, and what is wrong with it.

    Attributes:
        arrays: the numeric datasets by name; those that cannot be read are missing.
        name: attribute ``scene``, or the file's stem.
        actions: attribute ``actions``, or None.
        attributes: all other attributes as plain Python values.
        picture_shape: (H, W, 3), or None without pictures.
        faults: one line for each fault, without the file's name.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.arrays: dict[str, np.ndarray] = {}
        self.actions: tuple[str, ...] | None = None
        self.attributes: dict[str, Any] = {}
        self.picture_shape: tuple[int, int, int] | None = None
        self.faults: list[str] = []


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


@contextmanager
def _opened(path: Path) -> Iterator[h5py.File]:
    if not path.is_file():
        raise SceneError(f"{path}: there is no such file; check the path")
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise SceneError(
            f"{path}: cannot be opened as HDF5 ({error}); the file is truncated, damaged or something else:"
            f" copy or make it again"
        ) from error
    with file:
        yield file


def _plain(value: Any) -> Any:
    """An attribute as str, int, float, bool or a list of these."""
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    if isinstance(value, np.ndarray):
        return [_plain(item) for item in value.tolist()] if value.ndim else _plain(value.item())
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value


def read(path: str | os.PathLike[str]) -> Dump:
    """Everything but the pictures. Faults are collected in the result, not raised.

    Raises:
        SceneError: the file is missing or is no HDF5 file.
    """
    path = Path(path)
    dump = Dump(path.stem)
    with _opened(path) as file:
        attributes = {key: _plain(value) for key, value in file.attrs.items()}
        dump.name = str(attributes.pop("scene", path.stem))
        if "actions" in attributes:
            dump.actions = tuple(str(action) for action in attributes.pop("actions"))
        dump.attributes = attributes
        for name in DATASETS:
            if isinstance(file.get(name), h5py.Dataset):
                try:
                    dump.arrays[name] = file[name][()]
                except OSError as error:
                    dump.faults.append(
                        f"dataset {name!r} cannot be read ({error}); copy or make the file again"
                    )
        unreadable = {name for name in DATASETS if any(f"dataset {name!r}" in fault for fault in dump.faults)}
        found = array_faults(dump.arrays, dump.actions)
        dump.faults += [
            f for f in found if not any(f"dataset {name!r} is missing" in f for name in unreadable)
        ]
        graph = dump.arrays.get("graph")
        shape, faults = _look_at_pictures(file, len(graph) if graph is not None and graph.ndim else None)
        dump.picture_shape = shape
        dump.faults += faults
    return dump


def _pictures_of(file: h5py.File) -> h5py.Dataset | None:
    """Raw pictures where there are some, for they are exact; else the compressed ones; else None."""
    for name in ("observation", "observation_jpeg"):
        if isinstance(file.get(name), h5py.Dataset):
            return file[name]
    return None


def _look_at_pictures(
    file: h5py.File, num_states: int | None
) -> tuple[tuple[int, int, int] | None, list[str]]:
    """Size of the pictures and what is wrong with them, from the header and the first picture alone."""
    dataset = _pictures_of(file)
    if dataset is None:
        return None, []
    label = f"dataset {dataset.name.lstrip('/')!r}"
    count = dataset.shape[0] if dataset.shape else 0
    if num_states is not None and count != num_states:
        return None, [
            f"{label} has {count} pictures, but the graph has {num_states} states; write one per state"
        ]
    if dataset.name == "/observation":
        if dataset.ndim != 4 or dataset.shape[3] != 3 or dataset.dtype != np.uint8:
            return None, [
                f"{label} holds {dataset.dtype} {dataset.shape}; write it as uint8 (N, H, W, 3), or leave it out"
            ]
        return (dataset.shape[1], dataset.shape[2], 3), []
    if h5py.check_vlen_dtype(dataset.dtype) != np.uint8 or dataset.ndim != 1:
        return None, [
            f"{label} holds {dataset.dtype} {dataset.shape}; write it as one variable-length uint8 array per state"
        ]
    try:
        height, width, channels = _decode(dataset[0]).shape
    except OSError as error:
        return None, [f"{label}, state 0: not a JPEG file ({error}); write this picture again"]
    return (height, width, channels), []


def _decode(jpeg: np.ndarray) -> np.ndarray:
    with Image.open(io.BytesIO(jpeg.tobytes())) as image:
        return np.asarray(image.convert("RGB"))


def _decode_all(path: Path, ids: np.ndarray, files: Sequence[np.ndarray]) -> np.ndarray:
    pictures: list[np.ndarray] = []
    for state, jpeg in zip(ids.tolist(), files, strict=True):
        label = f"{path}: dataset 'observation_jpeg', state {state}"
        try:
            pictures.append(_decode(jpeg))
        except OSError as error:
            raise SceneError(f"{label}: not a JPEG file ({error}); write this picture again") from error
        if pictures[-1].shape != pictures[0].shape:
            raise SceneError(
                f"{label}: {pictures[-1].shape}, but state {ids[0]} has {pictures[0].shape};"
                f" write all pictures in one size"
            )
    return np.stack(pictures)


def read_pictures(path: str | os.PathLike[str], ids: np.ndarray) -> np.ndarray:
    """The pictures of some states; only these are read.

    Args:
        path: the scene's file.
        ids: (n,) integers in any order, repeats allowed.

    Returns:
        (n, H, W, 3) uint8.

    Raises:
        SceneError: the file has no pictures, a state is out of range, or a picture is damaged.
    """
    path = Path(path)
    # HDF5 reads a list of rows only in increasing order and without repeats.
    states, back = np.unique(np.asarray(ids, dtype=np.int64), return_inverse=True)
    with _opened(path) as file:
        dataset = _pictures_of(file)
        if dataset is None:
            raise SceneError(f"{path}: has no pictures; write dataset 'observation', uint8 (N, H, W, 3)")
        if len(states) and not (states[0] >= 0 and states[-1] < len(dataset)):
            wrong = states[0] if states[0] < 0 else states[-1]
            raise SceneError(
                f"{path}: there is no picture of state {wrong}; the states are 0..{len(dataset) - 1}"
            )
        try:
            rows = dataset[states]
        except OSError as error:
            raise SceneError(f"{path}: dataset {dataset.name!r} cannot be read ({error})") from error
        raw = dataset.name == "/observation"
    pictures = rows if raw else _decode_all(path, states, rows)
    return pictures[back.reshape(-1)]


def validate(path: str | os.PathLike[str]) -> list[str]:
    """All faults of a scene file at once, every picture looked at; an empty list for a sound file.

    Each line names the file, the dataset and the state, and the mend.

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
    faults = [f"{path}: {fault}" for fault in dump.faults]
    if dump.picture_shape is not None and "graph" in dump.arrays:
        num_states = len(dump.arrays["graph"])
        for first in range(0, num_states, _PICTURES_AT_ONCE):
            ids = np.arange(first, min(first + _PICTURES_AT_ONCE, num_states))
            try:
                shape = read_pictures(path, ids).shape[1:]
            except SceneError as error:
                faults.append(str(error))
                break
            if shape != dump.picture_shape:
                faults.append(
                    f"{path}: dataset 'observation_jpeg', state {first}: {shape}, but state 0 has"
                    f" {dump.picture_shape}; write all pictures in one size"
                )
                break
    return faults


def _smallest_integer(values: np.ndarray) -> np.ndarray:
    for dtype in (np.int16, np.int32):
        if not values.size or (values.min() >= np.iinfo(dtype).min and values.max() <= np.iinfo(dtype).max):
            return values.astype(dtype)
    return values.astype(np.int64)


def _smallest_float(values: np.ndarray) -> np.ndarray:
    """float16 where that holds every value exactly, else float32: what is read back is what was given."""
    with np.errstate(over="ignore"):
        half = values.astype(np.float16)
    return half if np.array_equal(half.astype(np.float32), values) else values.astype(np.float32)


def _write_attributes(file: h5py.File, attributes: Mapping[str, Any]) -> None:
    for key in sorted(attributes):
        value = attributes[key]
        try:
            if isinstance(value, list | tuple) and any(isinstance(item, str) for item in value):
                file.attrs.create(key, list(value), dtype=h5py.string_dtype())
            else:
                file.attrs[key] = value
        except (TypeError, ValueError, OSError) as error:
            raise SceneError(
                f"attribute {key!r} of type {type(value).__name__} cannot be written ({error});"
                f" use str, int, float or a list of one of them"
            ) from error


def _write_raw_pictures(file: h5py.File, blocks: Iterator[np.ndarray], num_states: int) -> None:
    dataset = None
    first = 0
    for block in blocks:
        if dataset is None:
            shape = (num_states, *block.shape[1:])
            dataset = file.create_dataset(
                "observation", shape, np.uint8, chunks=(1, *shape[1:]), compression="gzip", fletcher32=True
            )
        dataset[first : first + len(block)] = block
        first += len(block)


def _write_jpegs(file: h5py.File, jpegs: Sequence[bytes | np.ndarray]) -> None:
    dataset = file.create_dataset("observation_jpeg", (len(jpegs),), dtype=h5py.vlen_dtype(np.uint8))
    for state, jpeg in enumerate(jpegs):
        dataset[state] = np.frombuffer(jpeg, dtype=np.uint8) if isinstance(jpeg, bytes) else jpeg


def _raw_blocks(path: Path, num_states: int) -> Iterator[np.ndarray]:
    for first in range(0, num_states, _PICTURES_AT_ONCE):
        yield read_pictures(path, np.arange(first, min(first + _PICTURES_AT_ONCE, num_states)))


def _replace(path: Path, fill: Callable[[h5py.File], None]) -> None:
    """Write a file under a temporary name in the same folder, then give it its name in one step."""
    if not path.parent.is_dir():
        raise SceneError(f"{path}: there is no folder {path.parent}; make it first")
    handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
    os.close(handle)
    try:
        with h5py.File(temporary, "w") as file:
            fill(file)
        # mkstemp makes files that only the owner reads; give the usual permissions instead.
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(temporary, 0o666 & ~mask)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def write(
    path: str | os.PathLike[str],
    arrays: Mapping[str, np.ndarray],
    *,
    name: str,
    actions: Sequence[str],
    attributes: Mapping[str, Any],
    pictures: np.ndarray | Sequence[bytes] | Path | None = None,
) -> None:
    """Write a scene file, atomically.

    Integers take the smallest type that holds them; features are float16 where that is exact, else float32. All but
    the JPEG files is compressed and carries checksums. The same content gives the same bytes.

    Args:
        path: where to; replaced if it exists.
        arrays: the datasets of :data:`vusfa.scenes.faults.DATASETS`.
        name: the scene's name.
        actions: A names.
        attributes: provenance.
        pictures: (N, H, W, 3) uint8, or N JPEG files, or a scene file to copy them from as they are, or None.

    Raises:
        SceneError: an attribute cannot be written, or the folder does not exist.
    """
    path = Path(path)
    num_states = len(arrays["graph"])
    packed = {key: _smallest_integer(arrays[key]) for key in ("graph", "shortest_path_distance")}
    packed["resnet_feature"] = _smallest_float(arrays["resnet_feature"])
    packed |= {key: np.asarray(arrays[key], dtype=np.float32) for key in ("location", "rotation")}

    def fill(file: h5py.File) -> None:
        _write_attributes(file, {**attributes, "scene": name, "actions": list(actions)})
        for key in DATASETS:
            file.create_dataset(
                key, data=packed[key], compression="gzip", compression_opts=9, shuffle=True, fletcher32=True
            )
        if isinstance(pictures, Path):
            with _opened(pictures) as source:
                dataset = _pictures_of(source)
                if dataset is not None and dataset.name == "/observation_jpeg":
                    _write_jpegs(file, dataset[()])
                elif dataset is not None:
                    _write_raw_pictures(file, _raw_blocks(pictures, num_states), num_states)
        elif isinstance(pictures, np.ndarray):
            _write_raw_pictures(file, iter([pictures]), num_states)
        elif pictures is not None:
            _write_jpegs(file, pictures)

    _replace(path, fill)


def _encode(picture: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "JPEG", quality=_JPEG_QUALITY)
    return buffer.getvalue()


def compact(source: str | os.PathLike[str], target: str | os.PathLike[str]) -> None:
    """A small copy of a scene file: features as float16, raw pictures as JPEG files of quality 92.

    Pictures that are JPEG files already are kept byte for byte. Rounding to float16 changes a feature by at most
    one part in 2048 (values below 6e-5 by at most 3e-8).

    Raises:
        SceneError: the source has faults, or a feature is beyond float16's range.
    """
    source = Path(source)
    dump = read(source)
    raise_faults(source, dump.faults)
    with np.errstate(over="ignore"):
        half = dump.arrays["resnet_feature"].astype(np.float16)
    if not np.isfinite(half).all():
        state = int(np.argwhere(~np.isfinite(half))[0][0])
        raise SceneError(
            f"{source}: dataset 'resnet_feature', state {state}: a value is beyond float16's range of +-65504;"
            f" scale the features down"
        )
    pictures: Path | list[bytes] | None = source if dump.picture_shape is not None else None
    with _opened(source) as file:
        raw = "observation" in file
    if raw:
        blocks = _raw_blocks(source, len(dump.arrays["graph"]))
        pictures = [_encode(picture) for block in blocks for picture in block]
    actions = dump.actions or default_actions(dump.arrays["graph"].shape[1])
    arrays = {**dump.arrays, "resnet_feature": half.astype(np.float32)}
    write(target, arrays, name=dump.name, actions=actions, attributes=dump.attributes, pictures=pictures)


def default_actions(num_actions: int) -> tuple[str, ...]:
    """The THOR v1 dumps' four actions in their order; numbered names where there are not four.

    >>> default_actions(4)
    ('MoveForward', 'RotateRight', 'RotateLeft', 'MoveBackward')
    >>> default_actions(2)
    ('action_0', 'action_1')
    """
    if num_actions == 4:
        return ("MoveForward", "RotateRight", "RotateLeft", "MoveBackward")
    return tuple(f"action_{index}" for index in range(num_actions))


def raise_faults(source: str | os.PathLike[str], faults: Sequence[str]) -> None:
    """Raise one SceneError that lists all faults of a scene; nothing where there are none."""
    if len(faults) == 1:
        raise SceneError(f"{source}: {faults[0]}")
    if faults:
        lines = "".join(f"\n  - {fault}" for fault in faults)
        raise SceneError(f"{source}: {len(faults)} faults{lines}")
