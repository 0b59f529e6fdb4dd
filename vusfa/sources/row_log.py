"""Resumable work: rows of numbers, appended to a file, each with its checksum.

A long command (encoding, exporting) appends every row that it has finished. Stopped and started again, it
continues after the last complete row; an incomplete row is dropped. When the product
is written, the log is removed.
"""

from __future__ import annotations

import hashlib
import json
import os
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vusfa.deprecated import moved_names
from vusfa.errors import SceneError

__all__ = ["RowLog"]

_MAGIC = b"vusfa row log 1\n"


class RowLog:
    """Log of rows of one dtype in a file.

    Args:
        path: the log; made when it does not exist.
        work: what is being done, as plain values: inputs, options, hashes. A log that belongs to other work
            is thrown away, so that two runs with different options never mix.
        dtype: of one row; a structured or sub-array dtype holds several things.

    Raises:
        SceneError: the folder does not exist or cannot be written to.

    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "squares.rows"
    >>> RowLog(path, {"power": 2}, np.dtype("i4")).append(np.array([0, 1, 4], "i4"))
    >>> len(RowLog(path, {"power": 2}, np.dtype("i4"))), len(RowLog(path, {"power": 3}, np.dtype("i4")))
    (3, 0)
    """

    def __init__(self, path: str | os.PathLike[str], work: Mapping[str, Any], dtype: np.dtype) -> None:
        self.path = Path(path)
        self.dtype = np.dtype(dtype)
        described = json.dumps({"work": work, "dtype": str(self.dtype)}, sort_keys=True, default=str)
        self._head = _MAGIC + hashlib.sha256(described.encode()).digest()
        self._record = self.dtype.itemsize + 4
        try:
            self._length = self._sound_rows()
        except OSError as error:
            raise SceneError(f"{self.path}: cannot be written ({error}); check folder and rights") from error

    def _sound_rows(self) -> int:
        """Count the complete rows and cut off what follows them."""
        if not self.path.exists() or not self._same_work():
            self.path.write_bytes(self._head)
            return 0
        rows = 0
        with open(self.path, "r+b") as file:
            file.seek(len(self._head))
            while len(record := file.read(self._record)) == self._record and self._is_sound(record):
                rows += 1
            file.truncate(len(self._head) + rows * self._record)
        return rows

    def _same_work(self) -> bool:
        with open(self.path, "rb") as file:
            return file.read(len(self._head)) == self._head

    @staticmethod
    def _is_sound(record: bytes) -> bool:
        return zlib.crc32(record[:-4]) == int.from_bytes(record[-4:], "little")

    def __len__(self) -> int:
        return self._length

    def append(self, rows: np.ndarray) -> None:
        """Add rows, (n, ...) of the log's dtype; they are on the disk when this returns.

        Raises:
            SceneError: the disk is full or gone.
        """
        if not len(rows):
            return
        values = [np.ascontiguousarray(row).tobytes() for row in rows]
        if any(len(value) != self.dtype.itemsize for value in values):
            raise ValueError(f"rows of {self.dtype} are {self.dtype.itemsize} bytes, not {len(values[0])}")
        try:
            with open(self.path, "ab") as file:
                for value in values:
                    file.write(value + zlib.crc32(value).to_bytes(4, "little"))
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise SceneError(f"{self.path}: cannot be written ({error}); check space and rights") from error
        self._length += len(values)

    def read(self, first: int = 0, last: int | None = None) -> np.ndarray:
        """Rows ``first`` to ``last`` (not included; None for all) as an array of the log's dtype."""
        last = len(self) if last is None else min(last, len(self))
        count = max(0, last - first)
        with open(self.path, "rb") as file:
            file.seek(len(self._head) + first * self._record)
            data = file.read(count * self._record)
        records = np.frombuffer(data, np.uint8).reshape(count, self._record)
        values = np.ascontiguousarray(records[:, :-4])
        if self.dtype.subdtype is None:
            return values.view(self.dtype).reshape(count)
        base, shape = self.dtype.subdtype
        return values.view(base).reshape(count, *shape)

    def cut(self, rows: int) -> None:
        """Drop all rows after the first ``rows``."""
        if rows < len(self):
            os.truncate(self.path, len(self._head) + rows * self._record)
            self._length = rows

    def remove(self) -> None:
        """Delete the file."""
        self.path.unlink(missing_ok=True)


__getattr__ = moved_names(__name__, {"file_sha256": "vusfa.files.file_sha256"})
