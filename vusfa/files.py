"""Result files, written whole or not at all."""

from __future__ import annotations

import contextlib
import csv
import hashlib
import json
import math
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from multiprocessing.util import Finalize
from pathlib import Path
from typing import Any

import numpy as np

from vusfa.errors import ConfigError, ResultError, SceneError, printable

__all__ = [
    "cannot_write",
    "check_file",
    "check_folder",
    "file_sha256",
    "plain_cell",
    "remove_leftovers",
    "replacing",
    "say",
    "use_own_temporary_folder",
    "write_csv",
    "write_json",
    "write_npz",
    "write_text",
]

_FORMULA = "=+-@\t\r"  # what a spreadsheet takes for the beginning of a formula


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
    _check_place(Path(path).absolute(), f"{setting} is {str(path)!r}")
    return Path(path)


def _check_place(absolute: Path, what: str) -> None:
    nearest = next(place for place in (absolute, *absolute.parents) if os.path.lexists(place))
    if not os.path.isdir(nearest):
        raise ConfigError(f"{what}, but {nearest} is not a folder; give another")
    try:
        with tempfile.TemporaryFile(dir=nearest):  # /proc and a full disk let everybody in, too
            pass
    except OSError as error:
        reason = f"may not be written ({error.strerror})"
        raise ConfigError(f"{what}, but {nearest} {reason}; give another") from error


def check_file(path: str | Path, setting: str = "the file to write") -> Path:
    """Refuse, before the work, a file that :func:`replacing` could not write after it. Nothing is made.

    Raises:
        ConfigError: it is a folder, a device or a pipe, or its folder may not be written.

    >>> check_file("/dev/null")
    Traceback (most recent call last):
    ...
    vusfa.errors.ConfigError: /dev/null: is no regular file; name the file to write
    """
    path = Path(path)
    if os.path.isdir(path):
        raise ConfigError(f"{path}: is a folder; name the file to write")
    points_to_process = os.path.islink(path) and os.readlink(path).startswith("/proc/")  # /dev/stdout
    if points_to_process or (os.path.exists(path) and not os.path.isfile(path)):
        raise ConfigError(f"{path}: is no regular file; name the file to write")
    _check_place(path.absolute().parent, f"{setting} is {str(path)!r}")
    try:
        os.lstat(_unfinished(path))
    except FileNotFoundError:
        return path
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; name another file to write") from error
    return path


def _unfinished(path: Path) -> Path:
    return path.with_name(f".{path.name}.{os.getpid()}.tmp")


def file_sha256(path: str | os.PathLike[str]) -> str:
    """SHA-256 of a file's bytes, in hexadecimal.

    Raises:
        SceneError: the file cannot be read.
    """
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise SceneError(f"{path}: cannot be read ({error}); check the path") from error


@contextlib.contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yields another name in the folder of ``path``; what was written there takes ``path``'s place at the
    end.

    Whoever reads ``path`` finds the old content or the new, never a part of it, whenever this process dies.
    On an exception nothing is left behind; what a killed process left, :func:`remove_leftovers` finds.

    Raises:
        ResultError: the disk is full, the folder may not be written, or another fault of the system.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with replacing(Path(folder) / "deep" / "a.txt") as unfinished:
    ...         _ = unfinished.write_text("whole")
    ...     (Path(folder) / "deep" / "a.txt").read_text()
    'whole'
    """
    path = Path(path)
    unfinished = _unfinished(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield unfinished
        with open(unfinished, "rb") as file:
            os.fsync(file.fileno())
        os.replace(unfinished, path)
    except OSError as error:
        raise cannot_write(path, error) from error
    finally:
        with contextlib.suppress(OSError):
            unfinished.unlink()


def cannot_write(path: str | Path, error: OSError) -> ResultError:
    """The error for a file that the system does not take.

    >>> str(cannot_write("a.csv", OSError(28, "No space left on device")))
    'a.csv: cannot be written (No space left on device); the previous file, if any, is unchanged'
    """
    return ResultError(
        f"{path}: cannot be written ({error.strerror or error}); the previous file, if any, is unchanged"
    )


def remove_leftovers(folder: str | Path) -> None:
    """Remove what processes that were killed left in a folder: unfinished files of :func:`replacing`, and
    folders of :func:`use_own_temporary_folder`.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = (Path(folder) / f".a.csv.{2**22}.tmp").write_text("ha")
    ...     remove_leftovers(folder)
    ...     os.listdir(folder)
    []
    """
    with contextlib.suppress(OSError):
        for place in os.scandir(folder):
            found = re.fullmatch(r"\..+\.(\d+)\.tmp|vusfa-(\d+)-\w+", place.name)
            if found is None or _is_alive(int(found[1] or found[2])):
                continue
            with contextlib.suppress(OSError):
                if found[1]:
                    os.unlink(place.path)
                elif place.is_dir(follow_symlinks=False) and place.stat().st_uid == os.getuid():
                    shutil.rmtree(place.path, ignore_errors=True)


def use_own_temporary_folder() -> None:
    """Give this process, its children and the libraries in it a temporary folder of their own, removed at
    exit; one that a killed process left is removed now."""
    if Path(tempfile.gettempdir()).name.startswith("vusfa-"):
        return
    remove_leftovers(tempfile.gettempdir())
    try:
        folder = tempfile.mkdtemp(prefix=f"vusfa-{os.getpid()}-")
    except OSError:  # then in the shared one
        return
    # after multiprocessing's own folders in it (priority -100); a forked process does not do it
    Finalize(None, shutil.rmtree, args=(folder,), kwargs={"ignore_errors": True}, exitpriority=-200)
    os.environ["TMPDIR"] = tempfile.tempdir = folder


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True  # another user's
    return True


def say(text: str) -> None:
    """Print a line on standard error; that nobody reads it any more ends nothing."""
    with contextlib.suppress(OSError, ValueError):
        print(text, file=sys.stderr, flush=True)


def write_csv(
    path: str | Path, rows: Iterable[Mapping[str, Any]], columns: Sequence[str] | None = None
) -> Path:
    """Write rows as CSV, atomically; the columns are those of the first row unless given.

    NaN becomes an empty field. Text that a spreadsheet would take for a formula gets an apostrophe before it,
    which :func:`plain_cell` takes off again.
    """
    if columns is None:
        rows = list(rows)
        columns = list(rows[0] if rows else [])
    with replacing(path) as unfinished, open(unfinished, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(columns), lineterminator="\n")
        writer.writerow({name: _cell(name) for name in columns})
        for row in rows:
            writer.writerow({key: _cell(value) for key, value in row.items()})
    return Path(path)


def plain_cell(text: str) -> str:
    """Text of a CSV field as it was given to :func:`write_csv`.

    >>> plain_cell("'=1+1"), plain_cell("'tis a hall")
    ('=1+1', "'tis a hall")
    """
    return text[1:] if text[:1] == "'" and text[1:2] in _FORMULA and text[1:2] else text


def _cell(value: Any) -> Any:
    if not isinstance(value, str):
        return "" if _is_nan(value) else value
    if value[:1] in _FORMULA and value and not _is_number(value):
        value = f"'{value}"
    return printable(value)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def write_json(path: str | Path, content: Any) -> Path:
    """Write indented JSON, atomically; NaN, which JSON does not have, becomes null."""
    text = json.dumps(_without_nan(content), indent=2, ensure_ascii=False, allow_nan=False)
    return write_text(path, text + "\n")


def write_npz(path: str | Path, arrays: Mapping[str, np.ndarray]) -> Path:
    """Write arrays as a compressed .npz file, atomically."""
    with replacing(path) as unfinished, open(unfinished, "wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)
    return Path(path)


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
