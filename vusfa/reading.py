"""Readers of text, tables and arrays: only regular files, within :mod:`vusfa.limits`, one line of error."""

from __future__ import annotations

import csv
import io
import json
import math
import os
import zipfile
import zlib
from array import array
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from typing import Any, BinaryIO

import numpy as np
import yaml

from vusfa import limits
from vusfa.errors import ResultError, VusfaError
from vusfa.limits import brief, one_line

__all__ = [
    "BoundedZip",
    "check_fields",
    "parse_yaml",
    "read_csv",
    "read_json",
    "read_npy",
    "read_npz",
    "read_text",
    "read_yaml",
]

# What Python's parsers raise for damaged or hostile text, besides errors of their own.
_PARSING = (ValueError, OverflowError, RecursionError)


def read_text(
    path: str | os.PathLike[str],
    error: type[VusfaError],
    mend: str,
    most: int = limits.MAX_TEXT_BYTES,
    encoding: str = "utf-8",
) -> str:
    """Read a regular text file of bounded size.

    Args:
        path: the file.
        error: class of the exception, for whatever is wrong with the file.
        mend: end of its message, "write it again".
        most: bytes.
        encoding: of the text.

    >>> read_text("/dev/zero", ResultError, "give a file")
    Traceback (most recent call last):
    ...
    vusfa.errors.ResultError: /dev/zero: cannot be read (it is no regular file); give a file
    """
    try:
        with open_regular(path, most) as file:
            return file.read().decode(encoding)
    except (OSError, UnicodeDecodeError) as fault:
        raise error(f"{path}: cannot be read ({fault}); {mend}") from fault


def open_regular(path: str | os.PathLike[str], most: int | None = None) -> BinaryIO:
    """Open a regular file of at most ``most`` bytes.

    Raises:
        OSError: it is none, has more bytes, or cannot be read.
    """
    if not os.path.exists(path):
        raise FileNotFoundError("there is no such file")
    if not os.path.isfile(path):
        raise OSError("it is no regular file")
    file = open(path, "rb")  # noqa: SIM115
    if most is not None and os.fstat(file.fileno()).st_size > most:
        file.close()
        raise OSError(f"it has more than {most} bytes")
    return file


def read_yaml(path: str | os.PathLike[str], error: type[VusfaError], mend: str) -> Any:
    """Read one YAML document, see :func:`read_text` and :func:`parse_yaml`."""
    return parse_yaml(read_text(path, error, mend), str(path), error, mend)


def parse_yaml(text: str, source: str, error: type[VusfaError], mend: str) -> Any:
    """Parse one YAML document without tags, of bounded depth and size; each alias counts as what it repeats.

    >>> parse_yaml("hall: [3, 4]", "goals.yaml", ResultError, "correct it")
    {'hall': [3, 4]}
    """
    try:
        _check_yaml(yaml.parse(text, Loader=_Loader))
        return yaml.load(text, _Loader)
    except (yaml.YAMLError, *_PARSING) as fault:
        raise error(f"{source}: cannot be read as YAML ({one_line(fault)}); {mend}") from fault


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        """Refuse a key that is given twice; the last one would count."""
        keys = [(key.tag, key.value) for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        if len(set(keys)) < len(keys):
            twice = next(key for key, times in Counter(keys).items() if times > 1)
            raise ValueError(f"it has the key {brief(twice[1])} twice")
        return super().construct_mapping(node, deep)


def _check_yaml(events: Iterable[yaml.Event]) -> None:
    entries = 0
    unfinished: list[tuple[str | None, int]] = []  # anchor, and the entries before it
    sizes: dict[str | None, int] = {}
    for event in events:
        entries += 1
        if isinstance(event, yaml.AliasEvent):
            if event.anchor in [anchor for anchor, _ in unfinished]:
                raise ValueError("an alias repeats itself")
            entries += sizes.get(event.anchor, 0)
        elif isinstance(event, yaml.CollectionStartEvent):
            unfinished.append((event.anchor, entries))
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = unfinished.pop()
            sizes[anchor] = entries - before
        elif isinstance(event, yaml.ScalarEvent) and len(event.value) > limits.MAX_YAML_SCALAR:
            raise ValueError(f"an entry has more than {limits.MAX_YAML_SCALAR} characters")
        if getattr(event, "tag", None):
            raise ValueError("it has a tag")
        if entries > limits.MAX_YAML_NODES:
            raise ValueError(f"it has more than {limits.MAX_YAML_NODES} entries")
        if len(unfinished) > limits.MAX_YAML_DEPTH:
            raise ValueError(f"it is nested more than {limits.MAX_YAML_DEPTH} deep")


def read_json(path: str | os.PathLike[str], error: type[VusfaError], mend: str) -> dict[str, Any]:
    """Read a JSON file that holds an object, see :func:`read_text`."""
    text = read_text(path, error, mend, limits.MAX_JSON_BYTES)
    try:
        content = json.loads(text)
        json.dumps(content, ensure_ascii=False).encode()  # fails for half of a surrogate pair
    except _PARSING as fault:
        raise error(f"{path}: cannot be read as JSON ({one_line(fault)}); {mend}") from fault
    if not isinstance(content, dict):
        raise error(f"{path}: holds {brief(content)} in place of an object; {mend}")
    return content


def check_fields(
    content: Mapping[str, Any],
    kinds: Mapping[str, type | tuple[type, ...]],
    path: str | os.PathLike[str],
    error: type[VusfaError],
    mend: str,
) -> None:
    """Refuse fields of a file, where it has them, that are of another type than code reads them as.

    >>> check_fields({"seed": "one"}, {"seed": int}, "config.json", ResultError, "write it again")
    Traceback (most recent call last):
    ...
    vusfa.errors.ResultError: config.json: field 'seed' is 'one'; write it again
    """
    for name, kind in kinds.items():
        value = content.get(name)
        if name in content and (not isinstance(value, kind) or (kind is int and isinstance(value, bool))):
            raise error(f"{path}: field {name!r} is {brief(value)}; {mend}")


def read_csv(
    path: str | os.PathLike[str], error: type[VusfaError], mend: str, words: Collection[str] = ()
) -> dict[str, Any]:
    """Read a CSV file of numbers whose first line names the columns.

    Args:
        path, error, mend: see :func:`read_text`.
        words: columns that hold text.

    Returns:
        columns by name: (n,) float64, NaN where a field is empty or a line ends early; ``words`` as lists.
    """
    row = 1
    try:
        with open_regular(path, limits.MAX_CSV_BYTES) as binary:
            reader = csv.reader(io.TextIOWrapper(binary, encoding="utf-8", newline=""))
            names = next(reader, [])
            if len(set(names)) < len(names):
                raise ValueError("a column is named twice")
            texts: dict[int, list[str]] = {place: [] for place, name in enumerate(names) if name in words}
            numbers, shared = array("d"), dict[str, str]()
            for fields in reader:
                row += 1
                if len(fields) > len(names):
                    raise ValueError(f"{len(fields)} fields, and {len(names)} columns")
                fields += [""] * (len(names) - len(fields))
                numbers.extend([float(x) if x else math.nan for k, x in enumerate(fields) if k not in texts])
                for place, column in texts.items():
                    column.append(shared.setdefault(fields[place], fields[place]))
                if len(shared) > limits.MAX_CSV_WORDS:
                    raise ValueError(f"more than {limits.MAX_CSV_WORDS} different words")
    except OSError as fault:
        raise error(f"{path}: cannot be read ({fault}); {mend}") from fault
    except (csv.Error, ValueError) as fault:
        raise error(f"{path}: cannot be read as CSV, row {row} ({one_line(fault)}); {mend}") from fault
    table = iter(np.array(numbers).reshape(-1, max(1, len(names) - len(texts))).T)
    return {name: texts[place] if place in texts else next(table) for place, name in enumerate(names)}


class BoundedZip(zipfile.ZipFile):
    """A zip file for reading whose list of contents is of bounded size, and whose members are stored or
    deflated.

    Raises:
        OSError, zipfile.BadZipFile: it cannot be read, or is none within these limits.
    """

    class _File(io.BufferedReader):
        reads_contents = True

        def read(self, size: int | None = -1, /) -> bytes:
            if self.reads_contents and size is not None and size > limits.MAX_ZIP_READ:
                raise zipfile.BadZipFile(f"its list of contents has more than {limits.MAX_ZIP_READ} bytes")
            return super().read(size)

    _opened: _File | None = None

    def __init__(self, path: str | os.PathLike[str]) -> None:
        open_regular(path).close()
        self._opened = opened = self._File(io.FileIO(path))
        try:
            super().__init__(opened)
            opened.reads_contents = False
            if {info.compress_type for info in self.infolist()} - {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}:
                raise zipfile.BadZipFile("it is compressed by another method than deflate")
        except BaseException:
            opened.close()
            raise

    def read(self, name: str | zipfile.ZipInfo, pwd: bytes | None = None) -> bytes:
        """A member as far as its declared size; ``ZipFile.read`` decompresses all that there is first."""
        with self.open(name, pwd=pwd) as member:
            return member.read((name if isinstance(name, zipfile.ZipInfo) else self.getinfo(name)).file_size)

    def close(self) -> None:
        """Close the archive and its file."""
        super().close()
        if self._opened is not None:
            self._opened.close()


def read_npz(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """The arrays of a .npz file: numbers, truth values and text, no pickles.

    Raises:
        ResultError: the file is missing or damaged, holds anything else, or more than
            :data:`vusfa.limits.MAX_NPZ_BYTES`.
    """
    try:
        with BoundedZip(path) as file:
            if sum(info.file_size for info in file.infolist()) > limits.MAX_NPZ_BYTES:
                raise ValueError(f"its arrays have more than {limits.MAX_NPZ_BYTES} bytes")
            arrays = {info.filename.removesuffix(".npy"): _array(file, info) for info in file.infolist()}
        if sum(array.size for array in arrays.values()) > limits.MAX_NPZ_ELEMENTS:
            raise ValueError(f"its arrays have more than {limits.MAX_NPZ_ELEMENTS} elements")
        return arrays
    except (OSError, EOFError, zipfile.BadZipFile, zlib.error, RuntimeError, *_PARSING) as error:
        raise ResultError(f"{path}: cannot be read ({one_line(error)}); make it again") from error


def _array(file: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    try:
        return _read_array(io.BytesIO(file.read(info)), info.file_size)
    except ValueError as error:
        raise ValueError(f"{info.filename}: {error}") from error


def _read_array(file: BinaryIO, size: int) -> np.ndarray:
    """The array of a .npy file of ``size`` bytes, whose header is held against them first."""
    try:
        version = np.lib.format.read_magic(file)
        header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
        shape, column_major, dtype = header[version](file)
    except Exception as error:  # numpy's parser raises nearly anything for damaged bytes
        raise ValueError(f"its header is damaged ({brief(str(error))})") from error
    held = size - file.tell()
    sound = dtype.kind in "biufU" and all(type(side) is int and side >= 0 for side in shape)
    if not sound or dtype.itemsize * math.prod(shape) != held:
        raise ValueError(f"declares {dtype} of shape {brief(shape)}, and holds {held} bytes")
    return np.frombuffer(file.read(held), dtype).reshape(shape, order="F" if column_major else "C").copy()


def read_npy(path: str | os.PathLike[str], error: type[VusfaError], mend: str) -> np.ndarray:
    """Read a .npy file of numbers, truth values or text, no pickles; see :func:`read_text`."""
    try:
        with open_regular(path) as file:
            return _read_array(file, os.fstat(file.fileno()).st_size)
    except (OSError, ValueError) as fault:
        raise error(f"{path}: cannot be read ({fault}); {mend}") from fault
