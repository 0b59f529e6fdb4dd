"""Result files, written whole or not at all."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from vusfa.errors import ConfigError

__all__ = ["check_folder", "replacing", "write_csv", "write_json", "write_text"]


def check_folder(path: str | Path, setting: str) -> Path:
    """Refuse, before the work, a folder that could not be written after it. Nothing is made.

    Raises:
        ConfigError: it, or what it lies in, is a file or may not be written.

    >>> check_folder(__file__, "folder")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    ...
    vusfa.errors.ConfigError: folder is '...files.py', but ...files.py is not a folder; give another
    """
    if not isinstance(path, str | os.PathLike):
        raise ConfigError(f"{setting} is {path!r}; give the path of a folder")
    absolute = Path(path).absolute()
    nearest = next(place for place in (absolute, *absolute.parents) if os.path.lexists(place))
    if not os.path.isdir(nearest):
        raise ConfigError(f"{setting} is {str(path)!r}, but {nearest} is not a folder; give another")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise ConfigError(f"{setting} is {str(path)!r}, but {nearest} may not be written; give another")
    return Path(path)


@contextlib.contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yields another name in the folder of ``path``; what was written there takes ``path``'s place at the
    end.

    Whoever reads ``path`` finds the old content or the new, never a part of it, whenever this process dies.
    On an exception nothing is left behind.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with replacing(Path(folder) / "deep" / "a.txt") as unfinished:
    ...         _ = unfinished.write_text("whole")
    ...     (Path(folder) / "deep" / "a.txt").read_text()
    'whole'
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        yield unfinished
        with open(unfinished, "rb") as file:
            os.fsync(file.fileno())
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)


def write_csv(
    path: str | Path, rows: Iterable[Mapping[str, Any]], columns: Sequence[str] | None = None
) -> Path:
    """Write rows as CSV, atomically; the columns are those of the first row unless given. NaN becomes an
    empty field."""
    rows = list(rows)
    names = list(columns if columns is not None else rows[0] if rows else [])
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({key: "" if _is_nan(value) else value for key, value in row.items()})
    return write_text(path, text.getvalue())


def write_json(path: str | Path, content: Any) -> Path:
    """Write indented JSON, atomically; NaN, which JSON does not have, becomes null."""
    text = json.dumps(_without_nan(content), indent=2, ensure_ascii=False, allow_nan=False)
    return write_text(path, text + "\n")


def write_text(path: str | Path, text: str) -> Path:
    """Write UTF-8 text, atomically."""
    with replacing(path) as unfinished:
        unfinished.write_text(text, encoding="utf-8")
    return Path(path)


def _is_nan(value: Any) -> bool:
    return isinstance(value, float) and math.isnan(value)


def _without_nan(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(item) for item in value]
    return None if _is_nan(value) else value
