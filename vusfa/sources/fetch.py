"""Download of published scenes: they are unpacked and validated before they reach their folder.

There is no published checksum of the THOR v1 dumps. What stands in for it: the archive's own checksums (zip
has one for each file), the number of states of each room, and all that :func:`vusfa.scenes.validate` looks
at, a breadth-first search over every graph included. What does not pass is thrown away, and the next mirror
is asked.
"""

from __future__ import annotations

import os
import shutil
import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path, PurePosixPath
from typing import IO, Any

from vusfa.errors import ConfigError, SceneError
from vusfa.files import check_folder
from vusfa.limits import MAX_ARCHIVE_BYTES, MAX_STATE_BYTES, brief
from vusfa.reading import BoundedZip, read_yaml
from vusfa.scenes import store
from vusfa.scenes.hdf5 import opened
from vusfa.sources.download import Patience, download, require_space

__all__ = ["Archive", "archives", "arrived_faults", "fetch"]

_CONFIG = Path(__file__).with_name("archives.yaml")


@dataclass(frozen=True)
class Archive:
    """A zip file of scenes, and where to get it.

    Args:
        name: what ``fetch`` calls it.
        archive: the zip file's name.
        mirrors: its addresses, in the order in which they are asked.
        scenes: the scenes to take, ``NAME.h5`` anywhere in the archive, and how many states each has.
        patience: how long to bear with a server.
        about: one line of description.
    """

    name: str
    archive: str
    mirrors: tuple[str, ...]
    scenes: dict[str, int]
    patience: Patience = field(default_factory=Patience)
    about: str = ""


def archives(config: str | os.PathLike[str] | None = None) -> dict[str, Archive]:
    """The archives that a YAML file lists; by default the one that comes with this package.

    Raises:
        ConfigError: the file cannot be read, or an entry has a key or value that means nothing.

    >>> archives()["thor-v1"].scenes
    {'bathroom_02': 180, 'bedroom_04': 408, 'kitchen_02': 676, 'living_room_08': 468}
    """
    path = _CONFIG if config is None else Path(config)
    entries = read_yaml(path, ConfigError, "correct it")
    if not isinstance(entries, dict) or not all(isinstance(entry, dict) for entry in entries.values()):
        raise ConfigError(f"{path}: must map names to archives; see {_CONFIG} for an example")
    return {str(name): _archive(f"{path}: {name}", str(name), entry) for name, entry in entries.items()}


def _archive(where: str, name: str, entry: dict[str, Any]) -> Archive:
    keys = {item.name for item in fields(Archive)} - {"name"}
    patience_keys = {item.name for item in fields(Patience)}
    patience = {} if entry.get("patience") is None else entry["patience"]
    if not isinstance(patience, dict):
        raise ConfigError(f"{where}: patience is {brief(patience)}; map {', '.join(sorted(patience_keys))}")
    wrong = [*(entry.keys() - keys), *(f"patience.{key}" for key in patience.keys() - patience_keys)]
    if wrong:
        least = min(wrong, key=str)
        raise ConfigError(f"{where}: there is no key {brief(least)}; the keys are {', '.join(sorted(keys))}")
    mirrors, scenes = entry.get("mirrors"), entry.get("scenes")
    if not isinstance(mirrors, list) or not all(isinstance(url, str) for url in mirrors) or not mirrors:
        raise ConfigError(f"{where}: mirrors is {brief(mirrors)}; list one address or more")
    counts = scenes.values() if isinstance(scenes, dict) else [None]
    if not scenes or not all(type(count) is int and count > 0 for count in counts):
        raise ConfigError(f"{where}: scenes is {brief(scenes)}; map each name to its number of states")
    archive = str(entry.get("archive") or PurePosixPath(mirrors[0]).name)
    for what, given in [("archive", archive), *(("scenes", str(scene)) for scene in scenes)]:
        if (
            given in ("", ".", "..")
            or Path(given).name != given
            or not given.isprintable()
            or len(given) > 200
        ):
            raise ConfigError(f"{where}: {what} names {brief(given)}, which is no name of a file; give one")
    for key, value in patience.items():
        if type(value) not in ((int,) if key == "attempts" else (int, float)) or not 0 < value < 1e6:
            raise ConfigError(f"{where}: patience.{key} is {brief(value)}; give a number above 0")
    return Archive(
        name,
        archive,
        tuple(mirrors),
        {str(scene): count for scene, count in scenes.items()},
        Patience(**patience),
        str(entry.get("about", "")),
    )


def arrived_faults(path: Path, num_states: int) -> list[str]:
    """Faults of a scene file that should have this many states; an empty list for a sound one."""
    faults = store.validate(path)  # damage on the way shows in the archive's CRC
    if not faults:
        with opened(path) as file:
            found = len(file["graph"])
        if found != num_states:
            faults = [f"{path}: has {found} states, but this scene has {num_states}; fetch it again"]
    return faults


def fetch(
    archive: Archive,
    folder: str | os.PathLike[str],
    *,
    mirrors: Sequence[str] | None = None,
    progress: Callable[[int, int], None] | None = None,
    say: Callable[[str], None] | None = None,
    sleep: Callable[[float], None] = time.sleep,
) -> list[Path]:
    """Download an archive, unpack and validate its scenes, and only then move them into a folder.

    Stopped at any moment, it goes on where it was when it is called again: a download with the bytes that
    have arrived, and a finished one with unpacking. Scenes that are there and sound are not fetched again.

    Args:
        archive: of :func:`archives`.
        folder: where the scenes go; made when it does not exist.
        mirrors: addresses to ask instead of the archive's own.
        progress: called with bytes received and bytes in total (0 when not known).
        say: called with a line on what is being done or what went wrong.
        sleep: waits between two tries.

    Returns:
        The scenes' files.

    Raises:
        SceneError: no mirror gave an archive that passes; the message says what each one did.
        ConfigError: a mirror is no address.
    """
    folder, report = Path(folder), say or (lambda line: None)
    for url in mirrors or archive.mirrors:
        if not url.isprintable() or len(url) > 2000:
            raise ConfigError(f"{archive.name}: mirror {brief(url)} is no address; correct it")
    targets = {name: folder / f"{name}.h5" for name in archive.scenes}
    if all(t.exists() and not arrived_faults(t, archive.scenes[n]) for n, t in targets.items()):
        report(f"{folder}: all scenes are there and sound")
        return list(targets.values())
    check_folder(folder, "the folder of the scenes")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SceneError(f"{folder}: cannot be made ({error}); give another folder") from error
    packed, failures = folder / archive.archive, []
    most = min(MAX_ARCHIVE_BYTES, sum(archive.scenes.values()) * MAX_STATE_BYTES)
    for url in mirrors or archive.mirrors:
        # An archive that fails is thrown away, whoever it came from, and this mirror asked for a new one.
        for attempt in ("found here", "fetched"):
            try:
                if not packed.exists():
                    report(f"fetching {url}")
                    download(url, packed, archive.patience, progress, sleep, begins=b"PK", most=most)
                    attempt = "fetched"
                report(f"unpacking and checking {packed.name}")
                _admit(packed, archive, targets)
                packed.unlink()
                return list(targets.values())
            except _Unsound as fault:
                packed.unlink(missing_ok=True)
                report(f"thrown away: {fault}")
                if attempt == "fetched":
                    failures.append(f"{url}: {fault}")
                    break
            except SceneError as error:
                failures.append(str(error))
                report(f"failed: {error}")
                break
    lines = "".join(f"\n  - {line}" for line in failures)
    raise SceneError(f"{archive.name}: no mirror gave it; name another one{lines}")


class _Unsound(Exception):
    """The archive fails a check."""


def _admit(packed: Path, archive: Archive, targets: dict[str, Path]) -> None:
    """Unpack into a folder of its own, check everything, then move all scenes at once."""
    workshop = packed.with_name(f".{packed.name}.{uuid.uuid4().hex}")
    try:
        workshop.mkdir()
        unpacked = {name: workshop / f"{name}.h5" for name in archive.scenes}
        _unpack(packed, unpacked, archive.scenes)
        for name, path in unpacked.items():
            faults = arrived_faults(path, archive.scenes[name])
            if faults:
                lines = "; ".join(fault.replace(f"{path}: ", "") for fault in faults)
                raise _Unsound(f"{name}.h5 {lines}")
        for name, path in unpacked.items():
            path.replace(targets[name])
    except OSError as error:
        raise SceneError(f"{packed}: cannot be unpacked ({error}); check space and rights") from error
    finally:
        shutil.rmtree(workshop, ignore_errors=True)


def _unpack(packed: Path, targets: dict[str, Path], scenes: dict[str, int]) -> None:
    """Files of a zip archive by their last name, wherever they lie in it."""
    try:
        with BoundedZip(packed) as file:
            listed = [info for info in file.infolist() if "__MACOSX" not in info.filename]
            members = {PurePosixPath(info.filename).name: info for info in listed}
            for name, states in scenes.items():
                if f"{name}.h5" not in members:
                    raise _Unsound(f"{packed.name} has no {name}.h5")
                size, most = members[f"{name}.h5"].file_size, states * MAX_STATE_BYTES
                if size > most:
                    raise _Unsound(f"{name}.h5 has {size} bytes; at most {most} are read for {states} states")
            require_space(packed.parent, sum(members[f"{name}.h5"].file_size for name in scenes))
            for name, path in targets.items():
                with file.open(members[f"{name}.h5"]) as source:
                    _copy(source, path)
    except (_Unsound, SceneError):
        raise
    except Exception as error:  # zipfile raises nearly anything for damaged bytes
        raise _Unsound(f"{packed.name} is no whole zip file ({error})") from error


def _copy(source: IO[bytes], path: Path) -> None:
    """Copy a member; what goes wrong in writing is no fault of the archive."""
    path.touch()
    while block := source.read(1 << 20):
        try:
            with open(path, "ab") as copy:
                copy.write(block)
        except OSError as error:
            raise SceneError(f"{path}: cannot be written ({error}); check space and rights") from error
