"""Files are whole or not there."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from vusfa.files import replacing, write_csv, write_json


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path: Path):
    path = tmp_path / "result.txt"
    path.write_text("old")

    def fail() -> None:
        with replacing(path) as unfinished:
            unfinished.write_text("half of the n")
            assert path.read_text() == "old"
            raise RuntimeError("out of disk")

    with pytest.raises(RuntimeError, match="out of disk"):
        fail()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_rows_that_cannot_be_written_leave_the_old_file(tmp_path: Path):
    path = write_csv(tmp_path / "a.csv", [{"a": 1}])
    with pytest.raises(ValueError, match="b"):
        write_csv(path, [{"a": 1}, {"b": 2}])
    assert path.read_text() == "a\n1\n"


def test_no_number_is_an_empty_field_and_a_null(tmp_path: Path):
    row = {"name": "ä, b", "rate": math.nan, "count": 3}
    assert write_csv(tmp_path / "a.csv", [row]).read_text() == 'name,rate,count\n"ä, b",,3\n'
    assert write_csv(tmp_path / "b.csv", [], ["x", "y"]).read_text() == "x,y\n"
    read = json.loads(write_json(tmp_path / "c.json", {"rows": (row,)}).read_text())
    assert read == {"rows": [{"name": "ä, b", "rate": None, "count": 3}]}
