"""The command lines in the documentation are ones that the program takes."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
import typer

from vusfa.cli.app import app

ROOT = Path(__file__).parents[2]
PAGES = [path for path in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))) if path.is_file()]
LINES = [
    pytest.param(line, id=f"{page.name}: {line}")
    for page in PAGES
    for line in re.findall(r"(?:^|`)vusfa (scenes [^`\n]*)", page.read_text(encoding="utf-8"), re.MULTILINE)
]


def test_there_are_some() -> None:
    assert len(LINES) >= 3


@pytest.mark.parametrize("line", LINES)
def test_a_line_is_taken(line: str) -> None:
    _, *words = shlex.split(line.partition(" #")[0])
    if words in ([], ["..."], ["--help"]):
        return
    scenes = typer.main.get_command(app).commands["scenes"]  # type: ignore[attr-defined]
    command, *arguments = words
    assert command in scenes.commands
    # Parses, and complains of anything unknown or missing; runs nothing.
    scenes.commands[command].make_context(command, arguments)
