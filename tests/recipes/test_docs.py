"""The command lines in the documentation are ones that work."""

from __future__ import annotations

import inspect
import re
import shlex
from pathlib import Path

import pytest

from vusfa.cli.launch import compose
from vusfa.conf import FOLDER as CONF

ROOT = Path(__file__).parents[2]
PAGES = [path for path in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))) if path.is_file()]
LINES = [
    pytest.param(line, id=f"{page.name}: {line}")
    for page in PAGES
    for line in re.findall(r"(?:^|`)(python recipes/[^`\n]*)", page.read_text(), re.MULTILINE)
]


def test_there_are_some():
    assert len(LINES) >= 2


@pytest.mark.parametrize("line", LINES)
def test_a_recipe_line_is_one_that_works(recipe, line: str):
    _, script, *arguments = shlex.split(line.partition(" #")[0])
    name = Path(script).stem
    assert (ROOT / script).is_file()
    given = [word for word in arguments if not word.startswith("--")]
    module = recipe(name)
    if name not in ("train", "demo"):  # typed functions; settings of a training may come first
        function = getattr(module, given.pop(0) if name == "transfer" else name)
        known = inspect.signature(function).parameters
        assert {word[2:].replace("-", "_") for word in arguments if word.startswith("--")} <= known.keys()
        given, name = [word for word in given if "=" in word], "train"
    for override in given:
        key, _, values = override.partition("=")
        # a sweep is several command lines
        for value in values.split(",") if "--multirun" in arguments else [values]:
            compose(CONF, name, [f"{key}={value}"])
