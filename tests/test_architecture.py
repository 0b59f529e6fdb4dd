"""The rooms of the package: which may import which, how long files are, and no private names of TorchRL.

docs/architecture.md says why. The table below is the whole rule: a room imports the rooms beneath it.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "vusfa"

#: Each room and the rooms that it may import; single modules count as rooms.
MAY_IMPORT: dict[str, set[str]] = {}
for _room, _beneath in {
    "errors": "",
    "deprecated": "",
    "files": "errors",
    "limits": "",
    "cluster": "errors files limits",
    "reading": "errors limits",
    "torchrl_private": "errors",
    "conf": "errors files reading",
    "scenes": "conf",
    "sources": "scenes",
    "envs": "scenes torchrl_private",
    "modules": "envs",
    "objectives": "modules",
    "algorithms": "objectives",
    "training": "algorithms cluster",
    "evaluation": "modules",
    "experiments": "training evaluation",
    "deploy": "experiments sources",
    "report": "deploy",
    "cli": "report",
}.items():
    _direct = set(_beneath.split())
    MAY_IMPORT[_room] = _direct.union({"errors", "deprecated"}, *(MAY_IMPORT[name] for name in _direct))

FILES = sorted(PACKAGE.rglob("*.py"))
#: Rooms that a training does not need, and whose files may be longer.
AROUND = {"sources", "report", "deploy", "cluster", "cli"}
MAX_LINES = 300
MAX_RECIPE_LINES = 80
#: All rooms but those around them. 12,000 is the aim; whoever deletes lowers this number.
MAX_CORE_LINES = 25_563

PRIVATE = re.compile(
    r"\._(?:carrier|cursor|new_unsafe|set_str|step_mdp|module_iter|select_before_return|weight_sync_schemes)\b"
    r"|\"_cursor\"|__dict__\["
)


def room(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported_rooms(path: Path) -> Iterator[tuple[int, str]]:
    """Line and room of every import of this package, those within functions and for types included."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            parts = node.module.split(".")
            if parts[0] == "vusfa":
                names = parts[1:2] or [alias.name for alias in node.names]
                yield from ((node.lineno, name) for name in names)
        elif isinstance(node, ast.Import):
            for alias in node.names:
                parts = alias.name.split(".")
                if parts[0] == "vusfa" and len(parts) > 1:
                    yield node.lineno, parts[1]


def lines(path: Path) -> int:
    return len(path.read_text(encoding="utf-8").splitlines())


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_room_imports_only_rooms_beneath_it(path: Path) -> None:
    here = room(path)
    if here == "__init__":
        return
    allowed = MAY_IMPORT[here] | {here, "__version__"}
    upward = [f"line {line}: vusfa.{name}" for line, name in imported_rooms(path) if name not in allowed]
    assert not upward, f"{path.relative_to(ROOT)} imports what is not beneath vusfa.{here}: {upward}"


def test_training_does_not_know_evaluation_nor_the_other_way_round() -> None:
    assert "evaluation" not in MAY_IMPORT["training"]
    assert "training" not in MAY_IMPORT["evaluation"]


def test_every_room_is_in_the_table() -> None:
    rooms = {room(path) for path in FILES} - {"__init__"}
    assert rooms == set(MAY_IMPORT)


def test_files_can_be_read_at_one_sitting() -> None:
    core = {str(path.relative_to(ROOT)): lines(path) for path in FILES if room(path) not in AROUND}
    assert not {name for name, length in core.items() if length > MAX_LINES}


def test_recipes_are_thin() -> None:
    long = {p.name: lines(p) for p in (ROOT / "recipes").glob("*.py") if lines(p) > MAX_RECIPE_LINES}
    assert not long


def test_the_core_does_not_grow() -> None:
    assert sum(lines(path) for path in FILES if room(path) not in AROUND) <= MAX_CORE_LINES


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_private_names_of_torchrl_stand_in_one_file(path: Path) -> None:
    if room(path) != "torchrl_private":
        assert not PRIVATE.findall(path.read_text(encoding="utf-8"))
