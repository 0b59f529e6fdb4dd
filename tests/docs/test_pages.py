"""The documentation's structure: every page is reached, links lead somewhere, commands and names exist."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import shlex
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from typer.main import get_command

from tests.docs.pages import DOCS, PAGES, ROOT, blocks
from vusfa.cli import FUNCTIONS
from vusfa.cli.app import app
from vusfa.conf import FOLDER
from vusfa.experiments.training import compose_settings

NAMES = [str(page.relative_to(DOCS)) for page in PAGES]
BESIDE = [ROOT / name for name in ("README.md", "CONTRIBUTING.md")]
LINK = re.compile(r"\]\(([^)\s]+)\)")


def toctree(page: Path) -> list[Path]:
    """The pages that a page's toctrees name."""
    found = []
    for block in blocks(page):
        if block.language == "{toctree}":
            entries = [line.strip() for line in block.code.splitlines() if line.strip()]
            found += [
                (page.parent / f"{entry}.md").resolve() for entry in entries if not entry.startswith(":")
            ]
    return found


def test_every_page_is_in_the_toctree() -> None:
    reached: set[Path] = set()
    waiting = [DOCS / "index.md"]
    while waiting:
        page = waiting.pop()
        assert page.is_file(), page
        if page not in reached:
            reached.add(page)
            waiting += toctree(page)
    assert reached == set(PAGES)


@pytest.mark.parametrize("page", [*PAGES, *BESIDE], ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    for link in LINK.findall(text):
        if re.match(r"[a-z]+:", link):
            parts = urlsplit(link)
            assert parts.scheme == "https", f"{page.name}: {link}"
            assert "." in parts.netloc, f"{page.name}: {link}"
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), f"{page.name} links to {link}"
        if anchor:
            titles = re.findall(r"^#+ (.*)$", target.read_text(encoding="utf-8"), flags=re.MULTILINE)
            anchors = {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles}
            assert anchor in anchors, f"{page.name} links to {link}"


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_python_parses(page: Path) -> None:
    for block in blocks(page):
        if block.language in ("python", "{code-cell} ipython3"):
            ast.parse(block.code, filename=page.name)


def commands(page: Path) -> Iterator[list[str]]:
    """The words of every ``vusfa ...`` on a page, in blocks and in text, up to a shell's operator."""
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    found = re.findall(r"^(?:.*; do )?(vusfa [^\n#;]*)", text, flags=re.MULTILINE)
    found += re.findall(r"`(vusfa [^`]*)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
    for command in found:
        yield shlex.split(re.split(r"&&|\|", " ".join(command.split()))[0])


@cache
def command_line() -> Any:
    """The command ``vusfa`` with all that it takes."""
    return get_command(app)


@cache
def settings_of_training() -> set[str]:
    """Every name that ``vusfa train NAME=VALUE`` takes, with some preset."""

    def names(values: Any, prefix: str = "") -> Iterator[str]:
        for key, value in values.items():
            yield f"{prefix}{key}"
            if hasattr(value, "items"):
                yield from names(value, f"{prefix}{key}.")

    groups = {folder.name for folder in FOLDER.iterdir() if folder.is_dir()}
    presets = [path.stem for path in (FOLDER / "preset").glob("*.yaml")]
    composed = [compose_settings([]), *(compose_settings([f"preset={preset}"]) for preset in presets)]
    return groups | {str(name) for settings in composed for name in names(settings)}


def options_of(words: list[str]) -> tuple[str, list[str], set[str]]:
    """A command's name, the words that follow it, and the options that it has."""
    command, rest = command_line(), words[1:]
    while hasattr(command, "commands") and rest and re.fullmatch(r"[a-z][\w-]*", rest[0]):
        assert rest[0] in command.commands, shlex.join(words)
        command, rest = command.commands[rest[0]], rest[1:]
    options = {name for option in command.params for name in (*option.opts, *option.secondary_opts)}
    if command.name in FUNCTIONS:  # commands made from a function when they are called
        functions = FUNCTIONS[command.name][1]
        chosen = functions[""] if "" in functions else functions[rest.pop(0)]
        module, _, function = chosen.rpartition(".")
        names = inspect.signature(getattr(importlib.import_module(module), function)).parameters
        options |= {f"--{name.replace('_', '-')}" for name in names}
    return command.name, rest, options | {"--help", "--version"}


@pytest.mark.parametrize("page", [*PAGES, *BESIDE], ids=lambda page: page.name)
def test_commands_exist(page: Path) -> None:
    for words in commands(page):
        command, rest, options = options_of(words)
        for word in rest:
            name = word.split("=")[0]
            if word.startswith("-") and command != "train":  # what Hydra takes is its own
                assert name in options, f"{page.name}: {shlex.join(words)} has no option {name}"
            elif "=" in word and command in ("train", "table1", "generalise"):
                known = name in settings_of_training() or name.startswith(("objective.terms.", "hydra"))
                known = known or f"--{name.replace('_', '-')}" in options
                assert known, f"{page.name}: no setting {name}"


def test_paths_in_the_pages_exist() -> None:
    missing = set()
    for page in [*PAGES, *BESIDE]:
        for path in re.findall(
            r"`((?:vusfa|recipes|examples|tests|benchmarks|docs)/[\w./-]+)`", page.read_text()
        ):
            if not (ROOT / path).exists():
                missing.add(f"{page.name}: {path}")
    assert not missing


def listed_modules() -> list[str]:
    """The modules that the API reference lists."""
    return re.findall(
        r"^   (vusfa[\w.]+)$", (DOCS / "api.md").read_text(encoding="utf-8"), flags=re.MULTILINE
    )


def test_the_reference_has_every_public_name() -> None:
    listed = listed_modules()
    for package in sorted(path.parent.name for path in (ROOT / "vusfa").glob("*/__init__.py")):
        if package in ("cli", "conf"):  # commands and files; their reference is --help
            continue
        name = f"vusfa.{package}"
        assert name in listed, f"docs/api.md does not list {name}"
        module = importlib.import_module(name)
        # Sphinx lists the names of __all__; where there is none, conf.py has it list the modules.
        folders = re.search(r'"folders": \{([^}]*)\}', (DOCS / "conf.py").read_text(encoding="utf-8"))
        assert folders is not None
        assert hasattr(module, "__all__") != (name in folders[1]), name
    for name in listed:
        module = importlib.import_module(name)
        assert all(hasattr(module, public) for public in getattr(module, "__all__", ())), name
