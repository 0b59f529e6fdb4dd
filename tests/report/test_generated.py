"""docs/generated holds what the command prints from the committed results."""

from __future__ import annotations

from pathlib import Path

import pytest

from vusfa.errors import ResultError
from vusfa.report.generated import COMMAND, documents, write_documents

ROOT = Path(__file__).parents[2]


def test_the_committed_tables_are_what_the_command_prints(tmp_path: Path) -> None:
    made = {path.name: path.read_text() for path in write_documents(ROOT / "results", tmp_path / "made")}
    parted = made["generalise.md"]  # a table per set of rooms
    assert parted.startswith(f"<!-- {COMMAND} -->\n\n**Tested in ")
    assert all(text.startswith(f"<!-- {COMMAND} -->\n\n| ") for text in made.values() if text != parted)
    kept = {name: (ROOT / "docs/generated" / name).read_text() for name in made}
    assert {name for name in made if made[name] != kept[name]} == set(), f"run {COMMAND}, and commit"


def test_missing_results_leave_nothing_behind(tmp_path: Path) -> None:
    with pytest.raises(ResultError, match="no results of table1"):
        write_documents(tmp_path, tmp_path / "made")
    with pytest.raises(ResultError, match="no results"):
        documents(tmp_path / "nowhere")
    assert not list(tmp_path.iterdir())
