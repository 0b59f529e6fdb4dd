"""Splits of drawn rooms into those to train in, to choose by and to test in: fixed by number, in a file.

``manifests/unseen.yaml`` is that of docs/generalise.md. ``vusfa scenes render-rooms FOLDER split=unseen``
draws and renders its rooms and writes it to FOLDER/split.yaml, from which ``vusfa generalise FOLDER`` reads
it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from vusfa.errors import ConfigError, SceneError, near
from vusfa.files import write_text
from vusfa.limits import brief
from vusfa.reading import check_fields, parse_yaml, read_text

__all__ = ["SPLIT_FILE", "TRAIN", "RoomSplit", "find_split", "read_split"]

#: Name of a split's copy beside its rooms.
SPLIT_FILE = "split.yaml"
#: The part to train in.
TRAIN = "train"
_MEND = "write it as vusfa/experiments/manifests/unseen.yaml"
_FIELDS: dict[str, Any] = {
    "kinds": list,
    "parts": dict,
    "width": int,
    "samples": int,
    "layer": (str, type(None)),
    "grid": (str, type(None)),
}
_PART: dict[str, Any] = {"seeds": list, "cells": (int, type(None))}
_MOST_SEEDS = 100_000


@dataclass(frozen=True)
class RoomSplit:
    """Rooms of some kinds and seeds, in parts.

    Attributes:
        kinds: of rooms.
        parts: first and last seed and the number of free places (None: the kind's own), by name.
        width, samples: of the pictures; None for the plan's own.
        layer, grid: of the features, see :func:`vusfa.sources.backbones.load_backbone`.
        text: the file's.

    >>> split = read_split("unseen")
    >>> {part: len(list(split.rooms(part))) for part in split.parts}
    {'train': 240, 'validation': 20, 'test': 40, 'large': 40}
    """

    kinds: tuple[str, ...]
    parts: dict[str, tuple[int, int, int | None]]
    width: int | None
    samples: int | None
    layer: str | None
    grid: str | None
    text: str

    def rooms(self, part: str) -> Iterator[tuple[str, int, int | None]]:
        """Kind, seed and number of places of each room of a part: the first seed of all kinds, then the next.

        >>> next(read_split("unseen").rooms("test"))
        ('bathroom', 53, 20)
        """
        first, last, cells = self.parts[part]
        for seed in range(first, last + 1):
            for kind in self.kinds:
                yield kind, seed, cells

    def files(self, folder: Path, part: str, most: int | None = None) -> list[str]:
        """Files of the first rooms of a part, which are there.

        Args:
            folder: of the rooms.
            part: its name.
            most: number of rooms; all of them by default.

        Raises:
            ConfigError: there is no such part, or it has fewer rooms.
            SceneError: files are missing.
        """
        if part not in self.parts:
            raise ConfigError(f"{folder / SPLIT_FILE}: has no part {brief(part)}; {near(part, self.parts)}")
        paths = [folder / f"{kind}-{seed}.h5" for kind, seed, _ in self.rooms(part)]
        if most is not None and not 0 < most <= len(paths):
            raise ConfigError(f"{folder}: part {part!r} has {len(paths)} rooms, not {most}; ask for fewer")
        missing = [path for path in paths[:most] if not path.is_file()]
        if missing:
            raise SceneError(
                f"{missing[0]}: there is no such file, nor {len(missing) - 1} more of part {part!r}; render"
                f" them with vusfa scenes render-rooms {folder} split={folder / SPLIT_FILE}"
            )
        return [str(path) for path in paths[:most]]

    def write(self, folder: Path) -> Path:
        """Write the split beside its rooms.

        Raises:
            ConfigError: the folder has another split.
        """
        path = folder / SPLIT_FILE
        if path.exists() and read_split(path) != self:
            raise ConfigError(f"{path}: is another split; give another folder, or remove its rooms")
        folder.mkdir(parents=True, exist_ok=True)
        return write_text(path, self.text)


def find_split(folder: Path) -> RoomSplit | None:
    """The split of a folder of rooms; None where there is none."""
    path = folder / SPLIT_FILE
    return read_split(path) if path.is_file() else None


def read_split(source: str | Path) -> RoomSplit:
    """Read a split: a YAML file, or ``unseen``, the package's own.

    Raises:
        ConfigError: there is no such file, or it is no split.
    """
    path = Path(source)
    own = Path(__file__).parent / "manifests" / f"{source}.yaml"
    if not path.suffix and own.is_file():
        path = own
    text = read_text(path, ConfigError, _MEND)
    content = parse_yaml(text, str(path), ConfigError, _MEND)
    if not isinstance(content, dict) or not {"kinds", "parts"} <= content.keys() <= _FIELDS.keys():
        raise ConfigError(f"{path}: is no split of rooms, with kinds and parts; {_MEND}")
    check_fields(content, _FIELDS, path, ConfigError, _MEND)
    parts = {name: _part(path, name, part) for name, part in content["parts"].items()}
    kinds = content["kinds"]
    if (
        not kinds
        or not all(isinstance(kind, str) and kind.isidentifier() for kind in kinds)
        or TRAIN not in parts
    ):
        raise ConfigError(f"{path}: needs names of kinds, and a part {TRAIN!r}; {_MEND}")
    ranges = sorted(parts.values(), key=lambda part: part[0])
    if any(one[1] >= other[0] for one, other in pairwise(ranges)):
        raise ConfigError(f"{path}: two parts share seeds, so rooms; {_MEND}")
    asked = {key: content.get(key) for key in ("width", "samples", "layer", "grid")}
    return RoomSplit(tuple(kinds), parts, **asked, text=text)


def _part(path: Path, name: Any, part: Any) -> tuple[int, int, int | None]:
    if (
        not isinstance(name, str)
        or not isinstance(part, dict)
        or not {"seeds"} <= part.keys() <= _PART.keys()
    ):
        raise ConfigError(f"{path}: part {brief(name)} is {brief(part)}; {_MEND}")
    check_fields(part, _PART, path, ConfigError, _MEND)
    seeds = part["seeds"]
    if len(seeds) != 2 or any(type(seed) is not int for seed in seeds):
        raise ConfigError(f"{path}: part {name!r} has seeds {brief(seeds)}, no first and last; {_MEND}")
    first, last = seeds
    if not 0 <= first <= last < first + _MOST_SEEDS:
        raise ConfigError(f"{path}: part {name!r} has seeds {first} to {last}; {_MEND}")
    return first, last, part.get("cells")
