"""Docstrings as Sphinx needs them: they are written for ``help()`` first."""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Iterator
from typing import Any

from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer
from sphinx.util.inspect import stringify_signature

__all__ = ["setup"]

_RULE = re.compile(r"^\|(?:\s*:?-+:?\s*\|)+$")

#: "(*B, 4)" is a shape, no emphasis; what follows in a column of a table stays where it is.
_SHAPE = re.compile(r"(?<!\\)\(\*(?P<rest>[A-Za-z][^)]*\))(?P<gap> *)")


def _escaped(shape: re.Match[str]) -> str:
    gap = shape["gap"]
    return "(\\*" + shape["rest"] + (gap[1:] if len(gap) > 2 else gap)


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


def tables(lines: list[str]) -> Iterator[str]:
    """The lines with Markdown's tables as reStructuredText's ``list-table``."""
    index = 0
    while index < len(lines):
        line = lines[index]
        if line.strip().startswith("|") and index + 1 < len(lines) and _RULE.match(lines[index + 1].strip()):
            indent = line[: len(line) - len(line.lstrip())]
            yield from (f"{indent}.. list-table::", f"{indent}   :header-rows: 1", "")
            rows = [index, *range(index + 2, len(lines))]
            for row in rows:
                if not lines[row].strip().startswith("|"):
                    break
                index = row
                for column, cell in enumerate(_cells(lines[row])):
                    yield f"{indent}   {'*' if column == 0 else ' '} - {cell}"
            yield ""
        else:
            yield line
        index += 1


def comment(module: str, name: str, value: Any) -> list[str]:
    """The ``#:`` comment of a constant, from the module that sets it."""
    for source in sorted(key for key in sys.modules if key == module or key.startswith(f"{module}.")):
        if getattr(sys.modules[source], name, None) is value:
            found = ModuleAnalyzer.for_module(source).find_attr_docs().get(("", name))
            if found:
                return list(found)
    return []


def process(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Rewrite one docstring in place."""
    if what == "data":
        module, _, constant = name.rpartition(".")
        lines[:] = comment(module, constant, obj)
    lines[:] = [_SHAPE.sub(_escaped, line) for line in tables(lines)]


def signature_of(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, signature: str | None, returned: str | None
) -> tuple[str, str | None] | None:
    """The parameters of ``__init__``, where a metaclass hides them (TorchRL's losses and environments)."""
    if what not in ("class", "exception") or signature != "(*args, **kwargs)":
        return None
    found = inspect.signature(obj.__init__)
    shown = found.replace(parameters=list(found.parameters.values())[1:])
    text = stringify_signature(shown, show_return_annotation=False, unqualified_typehints=True)
    return text, returned


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the rewriting."""
    app.setup_extension("sphinx.ext.autodoc")
    app.connect("autodoc-process-docstring", process, priority=400)
    app.connect("autodoc-process-signature", signature_of)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
