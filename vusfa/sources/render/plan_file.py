"""Plans as YAML: one line per object in the room; an error lists all faults of a file."""

from __future__ import annotations

import dataclasses
import os
import types
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import yaml

from vusfa.errors import SceneError
from vusfa.limits import MAX_FURNITURE, MAX_NAME, brief
from vusfa.reading import parse_yaml, read_text
from vusfa.sources.render.faults import plan_faults
from vusfa.sources.render.plan import Plan

__all__ = ["from_yaml", "load_plan", "read_entry", "save_plan", "to_yaml"]

_Kind = TypeVar("_Kind")


class _Line(dict[str, Any]):
    """A mapping written on one line."""


class _Dumper(yaml.SafeDumper):
    pass


_Dumper.add_representer(
    _Line, lambda dumper, value: dumper.represent_mapping("tag:yaml.org,2002:map", value, flow_style=True)
)
_Dumper.add_representer(
    tuple, lambda dumper, value: dumper.represent_sequence("tag:yaml.org,2002:seq", value, flow_style=True)
)


def _plain(value: Any) -> Any:
    """Dataclasses as mappings without entries at their defaults."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        entries = {}
        for field in dataclasses.fields(value):
            entry = getattr(value, field.name)
            factory = field.default_factory
            if entry != (field.default if factory is dataclasses.MISSING else factory()):
                entries[field.name] = _plain(entry)
        return _Line(entries)
    if isinstance(value, tuple) and any(dataclasses.is_dataclass(item) for item in value):
        return [_plain(item) for item in value]
    return value


def to_yaml(plan: Plan) -> str:
    """Write a plan as YAML, from which :func:`from_yaml` makes an equal plan.

    >>> print(to_yaml(Plan("cell", size=(3.0, 2.0, 2.6))))
    name: cell
    size: [3.0, 2.0, 2.6]
    <BLANKLINE>
    """
    entries = dict(_plain(plan))  # no longer on one line
    return yaml.dump(entries, Dumper=_Dumper, sort_keys=False, width=400, allow_unicode=True)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _build(kind: Any, value: Any, where: str, faults: list[str]) -> Any:
    """``value`` as the type ``kind``; what does not fit becomes a line in ``faults`` and None."""
    origin = get_origin(kind)
    if origin in (Union, types.UnionType):
        inner = next(option for option in get_args(kind) if option is not type(None))
        return None if value is None else _build(inner, value, where, faults)
    if dataclasses.is_dataclass(kind):
        return _build_entry(kind, value, where, faults)
    if origin is tuple:
        parts = get_args(kind)
        if not isinstance(value, list):
            faults.append(f"{where}: {brief(value)} must be a list")
            return None
        if len(value) > MAX_FURNITURE:
            faults.append(f"{where}: has {len(value)} entries; at most {MAX_FURNITURE} are read")
            return None
        if parts[-1] is Ellipsis:
            return tuple(_build(parts[0], item, f"{where}[{k}]", faults) for k, item in enumerate(value))
        if len(value) != len(parts):
            faults.append(f"{where}: {brief(value)} must have {len(parts)} entries")
            return None
        return tuple(
            _build(part, item, f"{where}[{k}]", faults)
            for k, (part, item) in enumerate(zip(parts, value, strict=True))
        )
    fits = {
        float: _is_number,
        int: lambda item: _is_number(item) and item == int(item) and abs(item) < 2**63,
        str: lambda item: isinstance(item, str) and item.isprintable() and len(item) <= MAX_NAME,
        bool: lambda item: isinstance(item, bool),
    }[kind]
    try:
        if fits(value):
            return kind(value)
    except (OverflowError, ValueError):  # infinity and NaN are no whole numbers
        pass
    names = {float: "a number", int: "a whole number below 2 ** 63", bool: "true or false"}
    names[str] = f"text of one line, at most {MAX_NAME} characters"
    faults.append(f"{where}: {brief(value)} must be {names[kind]}")
    return None


def _build_entry(kind: Any, value: Any, where: str, faults: list[str]) -> Any:
    fields = {field.name: field for field in dataclasses.fields(kind)}
    if not isinstance(value, dict):
        named = where or f"the {kind.__name__.lower()}"
        faults.append(f"{named}: must be a mapping with the keys {', '.join(fields)}")
        return None
    hints = get_type_hints(kind)
    before = len(faults)
    prefix = f"{where}." if where else ""
    for key in value:
        if key not in fields:
            faults.append(f"{prefix}{key}: there is no such key; the keys are {', '.join(fields)}")
    values = {
        key: _build(hints[key], item, f"{prefix}{key}", faults)
        for key, item in value.items()
        if key in fields
    }
    for name, field in fields.items():
        required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        if required and name not in value:
            faults.append(f"{prefix}{name}: is missing")
    return kind(**values) if len(faults) == before else None


def read_entry(kind: type[_Kind], text: str, source: str, check: Callable[[_Kind], list[str]]) -> _Kind:
    """Read a dataclass from YAML.

    Args:
        kind: the class.
        text: the YAML, a mapping of its fields.
        source: name in errors, such as the file's.
        check: gives the faults of the values, one line each.

    Raises:
        SceneError: the text is no YAML, or has faults; the message lists all of them.
    """
    content = parse_yaml(text, source, SceneError, "correct it")
    faults: list[str] = []
    entry = _build_entry(kind, content, "", faults)
    faults = faults or check(entry)
    if len(faults) == 1:
        raise SceneError(f"{source}: {faults[0]}")
    if faults:
        raise SceneError(f"{source}: {len(faults)} faults" + "".join(f"\n  - {fault}" for fault in faults))
    return cast(_Kind, entry)


def from_yaml(text: str, source: str = "plan") -> Plan:
    """Read and check a plan.

    Args:
        text: the YAML.
        source: name in errors, such as the file's.

    Raises:
        SceneError: the text is no YAML, or has faults; the message lists all of them.

    >>> from_yaml("name: cell\\nsize: [3, 2]\\ngird: {step: 1}", "cell.yaml")
    Traceback (most recent call last):
    ...
    vusfa.errors.SceneError: cell.yaml: 2 faults
      - gird: there is no such key; the keys are name, size, kind, ...
      - size: [3, 2] must have 3 entries
    """
    return read_entry(Plan, text, source, plan_faults)


def load_plan(path: str | os.PathLike[str]) -> Plan:
    """Read and check a plan's file.

    Raises:
        SceneError: there is no such file; or as for :func:`from_yaml`.
    """
    return from_yaml(read_text(path, SceneError, "give the file of a plan in YAML"), str(path))


def save_plan(plan: Plan, path: str | os.PathLike[str]) -> None:
    """Write a plan's file, atomically.

    Raises:
        SceneError: it cannot be written.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.part")
    try:
        temporary.write_text(to_yaml(plan), encoding="utf-8")
        temporary.replace(path)
    except OSError as error:
        raise SceneError(f"{path}: cannot be written ({error}); check folder, rights and space") from error
    finally:
        temporary.unlink(missing_ok=True)
