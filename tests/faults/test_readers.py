"""A damaged file ends in a result or in an error of this package, within seconds and a gigabyte of memory.

More of the same: ``python tests/faults/worker.py SEED CASES``.
"""

from __future__ import annotations

import json
from typing import Any

import pytest

NAMES = [
    "checkpoint", "agent",
    "scene", "scene, raw", "index", "compact", "fetch", "archives", "picture", "features", "poses", "edges",
    "row log", "plan", "goals", "goal names", "manifest", "cell.json", "episodes", "exact", "metrics.csv",
    "resumed log", "episodes.csv", "config.json", "zero_shot.json",
]  # fmt: skip
CASES = 40


@pytest.fixture(scope="module")
def results(program: Any, tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """What the readers did, by name; all in one process."""
    done = program("tests/faults/worker.py", 0, CASES, folder=tmp_path_factory.mktemp("readers"))
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert done.returncode == 0, f"died after: {done.stderr[-3000:]}"
    return {line["reader"]: line for line in lines}


@pytest.mark.parametrize("name", NAMES)
def test_a_damaged_file_is_read_or_refused(results: dict[str, dict[str, Any]], name: str) -> None:
    result = results[name]
    assert not result["faults"], "\n".join(f"case {case}: {what}" for case, what in result["faults"])
    assert result["read"] + result["refused"] == CASES
    assert result["refused"] > CASES // 10 or name == "row log"  # which begins anew


def test_every_reader_is_tested(results: dict[str, dict[str, Any]]) -> None:
    assert sorted(results) == sorted(NAMES)
