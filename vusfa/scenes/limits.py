"""Limits of what a file may declare, checked before anything of that size is allocated.

They are far above every scene that is known and far below what fills a machine.
"""

from __future__ import annotations

import reprlib
from typing import Any

import h5py

__all__ = [
    "MAX_COMPRESSION",
    "MAX_MANIFEST_BYTES",
    "MAX_PICTURE_SIDE",
    "MAX_STATES",
    "PICTURE_FORMATS",
    "UNCOMPRESSED_BYTES",
    "brief",
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
#: Datasets of at most this size need not keep to it.
UNCOMPRESSED_BYTES = 1 << 26
#: Size of a YAML file of goals or archives.
MAX_MANIFEST_BYTES = 1 << 20


def size_fault(dataset: h5py.Dataset) -> str | None:
    """The fault of a dataset that declares more than it can hold; None when it does not."""
    if dataset.shape and dataset.shape[0] > MAX_STATES:
        return f"declares {dataset.shape[0]} states; at most {MAX_STATES} are read"
    stored = dataset.id.get_storage_size()
    if dataset.nbytes > max(UNCOMPRESSED_BYTES, MAX_COMPRESSION * stored):
        return (
            f"declares {dataset.nbytes} bytes, but {stored} are stored; at most {MAX_COMPRESSION} times as"
            f" many are read"
        )
    return None


_BRIEF = reprlib.Repr()
_BRIEF.maxlevel, _BRIEF.maxlist, _BRIEF.maxdict, _BRIEF.maxstring, _BRIEF.maxother = 3, 10, 10, 200, 200


def brief(value: Any) -> str:
    """A value of a file as messages show it: a bounded part, however much a file says.

    >>> brief(list(range(1000)))
    '[0, 1, 2, 3, 4, 5, 6, 7, 8, 9, ...]'
    """
    return _BRIEF.repr(value)
