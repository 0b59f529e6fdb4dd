"""recipes/report.py from the command line."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest


@pytest.fixture
def call(program: Callable[..., Any], tmp_path: Path) -> Callable[..., Any]:
    """The program."""
    return partial(program, "recipes/report.py", folder=tmp_path)


def test_page_tables_and_wandb(
    call: Callable[..., Any], run_folders: list[Path], tmp_path: Path, wandb_records
):
    options = ["--goals-per-scene", 2, "--walks", 1, "--max-steps", 5, "--wandb", "offline"]
    done = call(f"ours={run_folders[0]}", run_folders[2], "--out", tmp_path / "page.html", *options)
    assert done.returncode == 0, done.stderr
    paths = [Path(line) for line in done.stdout.splitlines()]
    assert paths[0] == tmp_path / "page.html"
    assert all(path.is_file() for path in paths)
    assert (tmp_path / "page_tables" / "summary.csv").read_text().splitlines()[1].startswith("ours,model,")
    (log,) = (tmp_path / "wandb").glob("offline-run-*/*.wandb")
    rows = [record["history"]["item"] for record in wandb_records(log) if record["type"] == "history"]
    logged = {name.partition(".")[0] for row in rows for name in row}
    assert {"summary", "seeds", "distance", "goals", "runs"} <= logged


def test_faults_in_one_line(call: Callable[..., Any], tmp_path: Path):
    done = call(tmp_path / "none", "--out", tmp_path / "page.html")
    assert done.returncode == 1
    assert (
        done.stderr
        == f"error: {tmp_path / 'none'} is not a folder; give the folder of a run or of results, or"
        " a pretrained agent (gvf, sfdp, usfa, vusfa, vusfa-replay-search)\n"
    )
    assert not list(tmp_path.iterdir())
