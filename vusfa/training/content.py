"""Content of a checkpoint file, checked before it is used: a file is data, and may be damaged or hostile.

1. The archive: stored (not compressed) records that fit the file, each with the CRC that it was written with.
   torch checks none of this.
2. The content: plain data and dense tensors, of bounded number and depth.
3. The entries: all there, of their types, weights and moments finite.
4. What a training restores: the same keys, shapes and types as its own (:func:`check_like`).
"""

from __future__ import annotations

import math
import os
import re
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from vusfa import limits
from vusfa.errors import CheckpointError, VusfaError
from vusfa.limits import brief
from vusfa.reading import BoundedZip

__all__ = [
    "ENTRIES",
    "NO_VALIDATION",
    "check_entries",
    "check_like",
    "check_sizes",
    "mended",
    "read_content",
    "restore",
]

#: Entries of a checkpoint and their types; :mod:`vusfa.training.checkpoint` says what they are.
ENTRIES: dict[str, type | tuple[type, ...]] = {
    "frames": int,
    "updates": int,
    "seconds": (int, float),
    "run_id": str,
    "agent_config": dict,
    "agent": dict,
    "scenes": dict,
    "goals": Tensor,
    "config": dict,
    "overrides": list,
    "optimizer": dict,
    "algorithm": dict,
    "collector": dict,
    "meter": dict,
    "rng": dict,
}
#: The entry ``validation`` before the first evaluation during a training, and in checkpoints without one.
NO_VALIDATION: dict[str, float] = {"best": -1.0, "frames": 0, "seconds": 0.0, "last_seconds": 0.0}
NO_VALIDATION |= {"media_seconds": 0.0, "last_media_seconds": 0.0}
_SCENES: dict[str, type] = {"sources": list, "names": list, "fingerprint": str}
#: Settings of a checkpoint that results name.
_CONFIG: dict[str, type | tuple[type, ...]] = {
    "agent": dict,
    "algorithm": dict,
    "env": dict,
    "seed": int,
    "threads": int,
    "autocast": (bool, str),
    "total_frames": int,
}
#: Entries whose tensors hold numbers (a meter's may be NaN, the mean over nothing), and entries without any.
_FINITE = ("agent", "algorithm", "optimizer", "collector")
_PLAIN = ("agent_config", "scenes", "config", "overrides")


def mended(path: str | Path, what: str) -> CheckpointError:
    """The error for a faulty file, with what can be done about it."""
    return CheckpointError(
        f"{path}: {what}; the file is damaged or was changed: take another checkpoint of the run,"
        " or start a new run"
    )


def read_content(path: Path, device: torch.device | str) -> Any:
    """Plain data and tensors of a file that ``torch.save`` wrote; no code in it is run.

    Raises:
        CheckpointError: the file is cut off, changed, or of another kind.
    """
    size = os.path.getsize(path)
    other = CheckpointError(
        f"{path}: not a whole checkpoint ({size} bytes), damaged, cut off in copying or another kind of file;"
        " take another"
    )
    if not zipfile.is_zipfile(path):
        raise other
    try:
        damaged = _damaged_record(path, size)
        # mapped: what a file says of a tensor's size cannot make torch read past the file's end
        content = None if damaged else torch.load(path, "cpu", weights_only=True, mmap=True)
    except Exception as error:  # of other files zipfile and the unpickler raise anything
        raise other from error
    if damaged:
        raise mended(path, damaged)
    return _Copy(path, torch.device(device)).copy(content)


def _damaged_record(path: Path, size: int) -> str | None:
    """Fault of an archive's records, or None."""
    with BoundedZip(path) as archive:
        records = archive.infolist()
        if len({record.filename for record in records}) < len(records):
            return "two of its records have one name"
        for record in records:
            if record.compress_type != zipfile.ZIP_STORED:
                return f"its record {brief(record.filename)} is compressed"
        if sum(record.file_size for record in records) > size:
            return "its records are longer than the file"
        name = archive.testzip()  # reads everything, and compares CRCs
        return None if name is None else f"its record {brief(name)} is not as it was written (CRC)"


class _Copy:
    """Copy of the mapped file's content, which refuses what no checkpoint holds."""

    def __init__(self, path: Path, device: torch.device) -> None:
        self.path, self.device, self.left = path, device, limits.MAX_CHECKPOINT_VALUES

    def copy(self, value: Any, where: str = "", depth: int = 0) -> Any:
        self.left -= 1
        if self.left < 0 or depth > limits.MAX_CHECKPOINT_DEPTH:
            most = f"{limits.MAX_CHECKPOINT_VALUES:,} values or {limits.MAX_CHECKPOINT_DEPTH} levels"
            raise mended(self.path, f"it holds more than {most}")
        if isinstance(value, Tensor):
            return self._tensor(value, where)
        if isinstance(value, dict):
            for key in value:
                if type(key) not in (str, int):
                    raise mended(self.path, f"{_named(where)} has a key of type {type(key).__name__}")
            return {key: self.copy(item, f"{where}.{key}", depth + 1) for key, item in value.items()}
        if type(value) in (list, tuple):
            return type(value)(self.copy(item, f"{where}.{i}", depth + 1) for i, item in enumerate(value))
        if value is not None and type(value) not in (bool, int, float, str):
            raise mended(self.path, f"{_named(where)} is a {type(value).__name__}, which no checkpoint holds")
        return value

    def _tensor(self, value: Tensor, where: str) -> Tensor:
        plain = type(value) is Tensor and value.layout == torch.strided and value.device.type == "cpu"
        if not plain or value.is_quantized or not value.is_contiguous():
            raise mended(self.path, f"{_named(where)} is no plain tensor")
        entry = where.split(".")[1] if where else ""
        if entry in _PLAIN:
            raise mended(self.path, f"{_named(where)} is a tensor, not plain data")
        if entry in _FINITE and not bool(value.isfinite().all()):
            raise mended(self.path, f"{_named(where)} holds NaN or infinity")
        return value.detach().to(self.device, copy=True)


def check_entries(path: str | Path, state: Mapping[str, Any]) -> None:
    """Check entries and types of a checkpoint of this version; a CheckpointError names the faulty one."""
    _check_types(path, "", state, ENTRIES)
    _check_types(path, "scenes.", state["scenes"], _SCENES)
    _check_types(path, "config.", state["config"], _CONFIG)
    _check_types(path, "", state, {"validation": dict})
    _check_types(path, "validation.", state["validation"], dict.fromkeys(NO_VALIDATION, (int, float)))
    _check_types(path, "config.agent.", state["config"]["agent"], {"model": str, "architecture": str})
    _check_types(path, "config.algorithm.", state["config"]["algorithm"], {"name": str})
    _check_types(path, "meter.", state["meter"], {"episodes": dict, "terms": dict})
    _check_types(path, "optimizer.", state["optimizer"], {"state": dict, "param_groups": list})
    for name in ("frames", "updates", "seconds"):
        if not 0 <= state[name] < math.inf:
            raise mended(path, f"its entry {name!r} is {brief(state[name])}, not 0 or more")
    if not re.fullmatch(r"[\w.-]{0,128}", state["run_id"], re.ASCII):
        raise mended(path, f"its entry 'run_id' is {brief(state['run_id'])}, no id of a run")
    for name in ("scenes.sources", "scenes.names", "overrides"):
        group, _, key = name.rpartition(".")
        if not all(isinstance(item, str) for item in (state[group] if group else state)[key]):
            raise mended(path, f"its entry {name!r} holds something else than text")
    goals = state["goals"]
    if goals.dtype != torch.int64 or goals.ndim != 1:
        raise mended(path, f"its entry 'goals' is {_shown(goals)}, not a list of state ids")
    for name, value in state["agent"].items():
        if not isinstance(value, Tensor):
            raise mended(path, f"its entry 'agent.{name}' is {_shown(value)}, not a tensor")
    check_sizes(path, state["agent_config"], state["agent"])


def check_sizes(path: str | Path, config: Mapping[str, Any], weights: Mapping[str, Tensor]) -> None:
    """Refuse with a CheckpointError a file of a few bytes that asks for layers of gigabytes."""
    largest = max([limits.MAX_LAYER, *(length for value in weights.values() for length in value.shape)])
    for name, value in config.items():
        for number in value if isinstance(value, list) else [value]:
            if isinstance(number, int) and name not in ("scenes", "fingerprint") and abs(number) > largest:
                raise mended(path, f"its entry 'agent_config.{name}' is {_shown(value)}")


def check_like(path: str | Path, where: str, found: Any, expected: Any) -> None:
    """Check that a part of a checkpoint has the keys, types and shapes of what it is to replace.

    Args:
        path, where: for messages: the file, the entry's dotted name.
        found: the checkpoint's.
        expected: the training's own.

    Raises:
        CheckpointError: naming the entry.

    >>> check_like("a.pt", "agent", {"bias": torch.zeros(3)}, {"bias": torch.zeros(4)})
    Traceback (most recent call last):
    ...
    vusfa.errors.CheckpointError: a.pt: its entry 'agent.bias' is float32 (3,), not float32 (4,); the file ...
    """
    if isinstance(expected, Mapping):
        if not isinstance(found, Mapping):
            raise mended(path, f"its entry {where!r} is {_shown(found)}, not a group of entries")
        for key in expected.keys() | found.keys():
            if key not in found:
                raise mended(path, f"its entry '{where}.{key}' is missing")
            if key not in expected:
                raise mended(path, f"its entry '{where}.{brief(key)[1:-1]}' is unknown")
            check_like(path, f"{where}.{key}", found[key], expected[key])
    elif isinstance(expected, Tensor):
        same = isinstance(found, Tensor) and found.shape == expected.shape
        if not same or (found.dtype != expected.dtype and not _are_floats(found, expected)):
            raise mended(path, f"its entry {where!r} is {_shown(found)}, not {_shown(expected)}")
    elif type(found) is not type(expected):
        raise mended(path, f"its entry {where!r} is {_shown(found)}, not {_shown(expected)}")


def restore(path: str | Path, where: str, load: Callable[[Any], object], state: Any) -> None:
    """Restore an entry; whatever its ``load`` raises becomes an error of the file.

    Raises:
        CheckpointError: naming the entry.
    """
    try:
        load(state)
    except VusfaError as error:
        raise CheckpointError(f"{path}: {error}") from error
    except (
        KeyError,
        TypeError,
        ValueError,
        RuntimeError,
        IndexError,
        AttributeError,
        OverflowError,
    ) as error:
        raise mended(path, f"its entry {where!r} cannot be restored ({brief(str(error))})") from error


def _check_types(path: str | Path, where: str, state: Mapping[str, Any], types: Mapping[str, Any]) -> None:
    for name, kind in types.items():
        if name not in state:
            raise mended(path, f"no checkpoint of vusfa ('{where}{name}' is missing)")
        value, kinds = state[name], kind if isinstance(kind, tuple) else (kind,)
        if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
            words = " or ".join(each.__name__ for each in kinds)
            raise mended(path, f"its entry '{where}{name}' is {_shown(value)}, not of type {words}")


def _are_floats(*tensors: Tensor) -> bool:
    return all(tensor.is_floating_point() for tensor in tensors)  # of any precision


def _named(where: str) -> str:
    return f"its entry {brief(where[1:])}" if where else "it"


def _shown(value: Any) -> str:
    if isinstance(value, Tensor):
        return f"{str(value.dtype).removeprefix('torch.')} {tuple(value.shape)}"
    return brief(value)
