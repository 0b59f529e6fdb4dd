"""The pages of the documentation, read as plain Markdown: no Sphinx is needed to test them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(
    path
    for path in DOCS.rglob("*.md")
    if not {"generated", "_build", "api"} & set(path.relative_to(DOCS).parts)
)
FENCE = re.compile(
    r"^(?P<fence>`{3,})(?P<language>[^\n]*)\n(?P<body>.*?)^(?P=fence)[ ]*$", flags=re.MULTILINE | re.DOTALL
)


@dataclass(frozen=True)
class Block:
    """A fenced block; ``tags`` are those of a code cell."""

    language: str
    code: str
    tags: tuple[str, ...] = ()


def blocks(path: Path) -> list[Block]:
    """The fenced blocks of a page, in order."""
    found = []
    for match in FENCE.finditer(path.read_text(encoding="utf-8")):
        options = re.match(r"(?::\w+:[^\n]*\n)*\n?", match["body"])
        assert options is not None
        tags = re.findall(r"[\w-]+", " ".join(re.findall(r":tags:(.*)", options[0])))
        found.append(Block(match["language"].strip(), match["body"][options.end() :], tuple(tags)))
    return found


def cells(path: Path) -> list[Block]:
    """The code cells of a tutorial."""
    return [block for block in blocks(path) if block.language.startswith("{code-cell}")]


def run_cells(path: Path, parameters: dict[str, Any]) -> dict[str, Any]:
    """Run a tutorial's cells in order, with other values for the cell that is tagged "parameters".

    Returns:
        the names that the cells have set.
    """
    names: dict[str, Any] = {"__name__": "tutorial"}
    tagged = 0
    for cell in cells(path):
        exec(compile(cell.code, str(path), "exec"), names)
        if "parameters" in cell.tags:
            unknown = parameters.keys() - names.keys()
            assert not unknown, f"{path.name} has no parameters {sorted(unknown)}"
            names |= parameters
            tagged += 1
    assert tagged == 1, f"{path.name} has {tagged} cells with the tag parameters"
    return names
