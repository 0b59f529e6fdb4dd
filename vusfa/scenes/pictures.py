"""Pictures of a scene, in either of two datasets.

``observation`` (N, H, W, 3) uint8 is the THOR v1 schema's; ``observation_jpeg`` (N,), each entry the bytes
of a JPEG file, is ours and about ten times smaller. Where a file has both, ``observation``
counts: it is exact.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import h5py
import numpy as np
from PIL import Image, UnidentifiedImageError

from vusfa import limits
from vusfa.errors import SceneError
from vusfa.scenes.hdf5 import dataset_in, opened

__all__ = [
    "check",
    "check_scans",
    "decode",
    "decoded",
    "look",
    "open_image",
    "raw_blocks",
    "read_pictures",
    "stored",
    "to_jpeg",
    "write_jpegs",
    "write_raw",
]

#: Names of the datasets of pictures.
DATASETS = _RAW, _JPEG = "observation", "observation_jpeg"
_AT_ONCE = 32
_QUALITY = 92
#: Last bytes of JPEG and PNG files.
_ENDS = (b"\xff\xd9", b"IEND\xaeB`\x82")


def _find(file: h5py.File) -> tuple[str, h5py.Dataset] | None:
    for name in DATASETS:
        dataset = dataset_in(file, name)
        if dataset is not None:
            return name, dataset
    return None


@contextmanager
def open_image(source: str | os.PathLike[str] | IO[bytes]) -> Iterator[Image.Image]:
    """A JPEG or PNG file, open for decoding within a ``with`` block.

    Raises:
        OSError: the file cannot be opened or decoded.
    """
    try:
        with Image.open(source, formats=limits.PICTURE_FORMATS) as image:
            yield image
    except UnidentifiedImageError as error:
        raise OSError("unknown format") from error  # Pillow's message names an address in memory
    except OSError:
        raise
    except Exception as error:  # Pillow's decoders raise nearly anything for damaged bytes
        raise OSError(f"{type(error).__name__}: {error}") from error


def check_scans(encoded: bytes) -> None:
    """Raise an OSError for a JPEG file with so many scans that decoding would hardly end."""
    if encoded.count(b"\xff\xda") > limits.MAX_PICTURE_SCANS:
        raise OSError(f"more than {limits.MAX_PICTURE_SCANS} scans")


def decode(encoded: bytes, shape: tuple[int, ...] | None = None) -> np.ndarray:
    """Decode a JPEG or PNG file to (H, W, 3) uint8; ``shape`` is the required one.

    Raises:
        OSError: it is no picture of these formats, damaged, larger than allowed, or of another shape.
    """
    with _opened_within(encoded, shape) as image:
        return np.asarray(image.convert("RGB"))


@contextmanager
def _opened_within(encoded: bytes, shape: tuple[int, ...] | None) -> Iterator[Image.Image]:
    """A picture whose header satisfies :func:`decode`; its content is not checked."""
    check_scans(encoded)
    with open_image(io.BytesIO(encoded)) as image:
        size = (image.height, image.width)
        if max(size) > limits.MAX_PICTURE_SIDE:
            raise OSError(
                f"{image.width} x {image.height} pixels; at most {limits.MAX_PICTURE_SIDE} per side"
            )
        if shape is not None and shape[:2] != size:
            raise OSError(f"{size} in size, and state 0 is {shape[:2]}")
        yield image


def to_jpeg(picture: np.ndarray, quality: int = _QUALITY) -> bytes:
    """A picture (H, W, 3) uint8 as a JPEG file, of quality 92 by default."""
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "JPEG", quality=quality)
    return buffer.getvalue()


def look(file: h5py.File, num_states: int | None) -> tuple[tuple[int, int, int] | None, list[str]]:
    """Shape of a file's pictures (None without any) and their faults, by the header and the first picture."""
    try:
        found = _find(file)
    except (OSError, RuntimeError) as error:
        return None, [f"the pictures cannot be read ({error}); write them again"]
    if found is None:
        return None, []
    name, dataset = found
    shape: tuple[int, ...] = dataset.shape or ()
    held = f"dataset {name!r} holds {dataset.dtype} of shape {dataset.shape}"
    if name == _RAW:
        layout = "uint8 (N, H, W, 3)"
        fits = dataset.dtype == np.uint8 and len(shape) == 4 and shape[3] == 3
    else:
        layout = "(N,) of variable-length uint8"
        fits = h5py.check_vlen_dtype(dataset.dtype) == np.uint8 and len(shape) == 1
    if not fits or 0 in shape:
        return None, [f"{held}; write it as {layout}, or leave it out"]
    if num_states is not None and len(dataset) != num_states:
        return None, [
            f"dataset {name!r} has {len(dataset)} pictures, but the graph has {num_states} states;"
            f" write one per state, or leave it out"
        ]
    if name == _RAW:
        if max(shape[1:3]) > limits.MAX_PICTURE_SIDE:
            most = limits.MAX_PICTURE_SIDE
            return None, [f"{held}; make the pictures smaller, at most {most} pixels per side"]
        return (shape[1], shape[2], 3), []
    try:
        height, width, _ = decode(dataset[0].tobytes()).shape
        return (height, width, 3), []
    except OSError as error:
        return None, [f"dataset {name!r}, state 0: is unusable ({error}); write it again"]


def read_pictures(path: Path, ids: np.ndarray) -> np.ndarray:
    """Read the pictures of the states ``ids`` (n,), in any order, repeats allowed, as (n, H, W, 3) uint8.

    Raises:
        SceneError: the file has no pictures, a state is out of range, or a picture is damaged.
    """
    # HDF5 reads a list of rows only in increasing order and without repeats.
    states, back = np.unique(np.asarray(ids, dtype=np.int64), return_inverse=True)
    with opened(path) as file:
        found = _find(file)
        if found is None:
            raise SceneError(f"{path}: has no pictures; write dataset {_RAW!r}, uint8 (N, H, W, 3)")
        name, dataset = found
        if len(states) and (states[0] < 0 or states[-1] >= len(dataset)):
            wrong = states[0] if states[0] < 0 else states[-1]
            raise SceneError(f"{path}: there is no state {wrong}; the states are 0..{len(dataset) - 1}")
        if name == _RAW:
            return dataset[states][back]
        # One at a time: entries can share bytes in the file, but not in memory.
        try:
            state = 0
            first = decode(dataset[0].tobytes())
            decoded = np.empty((len(states), *first.shape), np.uint8)
            for row, state in enumerate(states.tolist()):
                decoded[row] = decode(dataset[state].tobytes(), first.shape)
        except OSError as error:
            raise _unusable(path, state, error) from error
        return decoded[back]


def raw_blocks(path: Path, states: np.ndarray) -> Iterator[np.ndarray]:
    """Blocks (n, H, W, 3) of the pictures of the states, in order."""
    size = read_pictures(path, states[:1]).nbytes
    at_once = max(1, min(_AT_ONCE, limits.MAX_PICTURE_BYTES // max(size, 1)))
    for first in range(0, len(states), at_once):
        yield read_pictures(path, states[first : first + at_once])


def decoded(path: Path) -> tuple[int, int]:
    """How many pictures of a file :func:`check` decodes where it is not asked for all, and how many there
    are.

    >>> from vusfa.scenes.store import bundled_path
    >>> decoded(bundled_path("bathroom"))
    (176, 176)
    """
    with opened(path) as file:
        (shape, _), found = look(file, None), _find(file)
        number = 0 if shape is None or found is None else len(found[1])
    return (min(number, max(1, limits.MAX_DECODED_PIXELS // (shape[0] * shape[1]))) if shape else 0), number


def check(path: Path, num_states: int, every: bool = False) -> None:
    """Check the pictures of a file: the header and the end of each, then by decoding.

    Truncated pictures, other sizes and other data are thus found in seconds, in a file of any size.

    Args:
        path: the file.
        num_states: N.
        every: decode all pictures, however long it takes, not as many as :func:`decoded` says.

    Raises:
        SceneError: a picture cannot be used; the message names the first one.
    """
    with opened(path) as file:
        name, dataset = _find(file) or ("", None)
        if dataset is not None and name == _JPEG:
            state = 0
            try:
                shape = decode(dataset[0].tobytes()).shape
                for state in range(len(dataset)):
                    encoded = dataset[state].tobytes()
                    with _opened_within(encoded, shape) as image:
                        if not encoded.rstrip(b"\0").endswith(_ENDS):  # truncated, or with trailing data
                            image.load()
            except OSError as error:
                raise _unusable(path, state, error) from error
    count = num_states if every else decoded(path)[0]
    for _ in raw_blocks(path, np.linspace(0, num_states - 1, count, dtype=np.int64)):
        pass


def _unusable(path: Path, state: int, error: OSError) -> SceneError:
    return SceneError(f"{path}: dataset {_JPEG!r}, state {state}: is unusable ({error}); write it again")


def stored(path: Path, num_states: int) -> tuple[list[bytes] | None, Iterator[np.ndarray] | None]:
    """Pictures of a file as they are stored: JPEG files, or blocks of raw pictures; the other one is None."""
    with opened(path) as file:
        found = _find(file)
        if found is None:
            return None, None
        name, dataset = found
        if name == _RAW:
            return None, raw_blocks(path, np.arange(num_states))
        jpegs: list[bytes] = []
        left = path.stat().st_size
        for state in range(len(dataset)):
            jpegs.append(dataset[state].tobytes())
            left -= len(jpegs[-1])
            if left < 0:
                raise SceneError(f"{path}: dataset {_JPEG!r} has more bytes than the file; write it again")
        return jpegs, None


def write_jpegs(file: h5py.File, jpegs: Sequence[bytes]) -> None:
    """Write ``observation_jpeg``."""
    dataset = file.create_dataset(_JPEG, (len(jpegs),), dtype=h5py.vlen_dtype(np.uint8))
    for state, jpeg in enumerate(jpegs):
        dataset[state] = np.frombuffer(jpeg, dtype=np.uint8)


def write_raw(file: h5py.File, blocks: Iterable[np.ndarray], num_states: int) -> None:
    """Write ``observation`` from blocks of (n, H, W, 3) uint8 with N pictures in all."""
    first = 0
    for block in blocks:
        if first == 0:
            shape = block.shape[1:]
            dataset = file.create_dataset(
                _RAW, (num_states, *shape), np.uint8, chunks=(1, *shape), compression="gzip", fletcher32=True
            )
        dataset[first : first + len(block)] = block
        first += len(block)
