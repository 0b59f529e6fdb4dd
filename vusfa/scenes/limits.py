"""Limits of what a file may declare, checked before anything of that size is allocated or computed.

They are far above every scene that is known and far below what fills a machine.
"""

from __future__ import annotations

import math
import reprlib
from pathlib import Path
from typing import Any

import h5py

__all__ = [
    "MAX_CHUNK_BYTES",
    "MAX_COMPRESSION",
    "MAX_FURNITURE",
    "MAX_PICTURE_COMPRESSION",
    "MAX_PICTURE_SIDE",
    "MAX_STATES",
    "MAX_TEXT_BYTES",
    "PICTURE_FORMATS",
    "UNCOMPRESSED_BYTES",
    "brief",
    "read_text",
    "size_fault",
]

#: States of a scene: its table of distances has the square of it. The largest known scene has 12,100.
MAX_STATES = 16_384
#: Pixels of a picture's side.
MAX_PICTURE_SIDE = 4096
#: Formats that pictures are decoded from; Pillow would try some forty, and start other programs for some.
PICTURE_FORMATS = ("JPEG", "PNG")
#: Size of a dataset over its size in the file. Tables of distances have about 10.
MAX_COMPRESSION = 200
#: The same for raw pictures, which are read some at a time: what gzip reaches with a single color.
MAX_PICTURE_COMPRESSION = 1100
#: Size of a chunk, which is read as a whole.
MAX_CHUNK_BYTES = 1 << 28
#: Datasets of at most this size need not keep to a compression.
UNCOMPRESSED_BYTES = 1 << 26
#: Size of a YAML file: goals, archives, plans.
MAX_TEXT_BYTES = 1 << 20
#: Pieces of furniture, and entries of any other kind, of a plan.
MAX_FURNITURE = 1000


def size_fault(dataset: h5py.Dataset) -> str | None:
    """The fault of a dataset that declares more than it can hold; None when it does not."""
    if dataset.shape and dataset.shape[0] > MAX_STATES:
        return f"declares {dataset.shape[0]} states; at most {MAX_STATES} are read"
    stored = dataset.id.get_storage_size()
    times = MAX_PICTURE_COMPRESSION if dataset.ndim == 4 else MAX_COMPRESSION
    if dataset.nbytes > max(UNCOMPRESSED_BYTES, times * stored):
        return (
            f"declares {dataset.nbytes} bytes, but {stored} are stored; at most {times} times that are read"
        )
    if dataset.chunks and math.prod(dataset.chunks) * dataset.dtype.itemsize > MAX_CHUNK_BYTES:
        return f"has chunks of shape {dataset.chunks}; at most {MAX_CHUNK_BYTES} bytes a chunk are read"
    return None


_BRIEF = reprlib.Repr()
_BRIEF.maxlevel, _BRIEF.maxlist, _BRIEF.maxdict, _BRIEF.maxstring, _BRIEF.maxother = 2, 10, 10, 200, 200


def brief(value: Any) -> str:
    """A value of a file as messages show it: a bounded part, however much a file says.

    >>> brief(list(range(1000)))
    '[0, 1, 2, 3, 4, 5, 6, 7, 8, 9, ...]'
    """
    return _BRIEF.repr(value)


def read_text(path: Path) -> str:
    """The text of a regular file of at most :data:`MAX_TEXT_BYTES`.

    Raises:
        OSError: it is larger, no regular file, or cannot be read.
        UnicodeDecodeError: it is no UTF-8.
    """
    if path.exists() and not path.is_file():
        raise OSError("it is no regular file")
    if path.stat().st_size > MAX_TEXT_BYTES:
        raise OSError(f"it has more than {MAX_TEXT_BYTES} bytes")
    return path.read_text(encoding="utf-8")
