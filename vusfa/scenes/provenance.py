"""Provenance of a scene: who made it, with what, from which plan and seed, under which licences.

One attribute of the scene's file per field of :class:`Provenance`, in :attr:`vusfa.scenes.Scene.attributes`
beside its maker's other attributes.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from vusfa import __version__

__all__ = ["Provenance", "this_tool", "today"]


@dataclass(frozen=True)
class Provenance:
    """The origin of a scene, as its file records it.

    Args:
        made_with: tools and their versions, as :func:`this_tool` writes them.
        made_by: a person or a group.
        made_on: a date, 2026-11-23.
        plan: the room's plan as YAML text, or its location.
        seed: random seed.
        licences: one line per separately licensed part.
        credits: people to credit wherever the pictures are shown.

    >>> origin = Provenance("vusfa 0.1.0 scenes from-photos", seed=3, credits=("Photographs: A. Fan",))
    >>> origin.attributes()
    {'made_with': 'vusfa 0.1.0 scenes from-photos', 'seed': 3, 'credits': ['Photographs: A. Fan']}
    >>> Provenance.of(origin.attributes()) == origin
    True
    """

    made_with: str | None = None
    made_by: str | None = None
    made_on: str | None = None
    plan: str | None = None
    seed: int | None = None
    licences: tuple[str, ...] = ()
    credits: tuple[str, ...] = ()

    @classmethod
    def of(cls, attributes: Mapping[str, Any]) -> Provenance:
        """Read the origin from a scene's attributes; fields that they lack are empty.

        >>> Provenance.of({"seed": 1, "licences": "CC0", "exposure": 2.2})
        Provenance(made_with=None, ..., seed=1, licences=('CC0',), credits=())
        """
        values: dict[str, Any] = {name: attributes[name] for name in _NAMES if name in attributes}
        for name in ("licences", "credits"):
            if name in values:
                value = values[name]
                values[name] = tuple(map(str, value)) if isinstance(value, list | tuple) else (str(value),)
        return cls(**values)

    def attributes(self) -> dict[str, Any]:
        """Attributes of a scene: ``Scene(..., attributes={**origin.attributes(), ...})``."""
        values = {name: getattr(self, name) for name in _NAMES}
        return {k: list(v) if isinstance(v, tuple) else v for k, v in values.items() if v not in (None, ())}

    @staticmethod
    def other(attributes: Mapping[str, Any]) -> dict[str, Any]:
        """Attributes that are not part of the origin.

        >>> Provenance.other({"seed": 1, "exposure": 2.2})
        {'exposure': 2.2}
        """
        return {name: value for name, value in attributes.items() if name not in _NAMES}


_NAMES = tuple(field.name for field in dataclasses.fields(Provenance))


def this_tool(command: str, **versions: str) -> str:
    """A value for ``made_with``: this package, the command, and the other tools with their versions.

    >>> this_tool("scenes render", mitsuba="3.9.1")
    'vusfa ... scenes render, mitsuba 3.9.1'
    """
    return ", ".join([f"vusfa {__version__} {command}", *(f"{name} {of}" for name, of in versions.items())])


def today() -> str:
    """A value for ``made_on``: the date in UTC, or that of $SOURCE_DATE_EPOCH for reproducible files."""
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    moment = datetime.now(UTC) if epoch is None else datetime.fromtimestamp(int(epoch), UTC)
    return moment.strftime("%Y-%m-%d")
