"""Files are whole or not there."""

from __future__ import annotations

import csv
import hashlib
import json
import math
from pathlib import Path

import pytest

from vusfa.errors import ConfigError, SceneError
from vusfa.files import file_sha256, plain_cell, replacing, write_csv, write_json


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


@pytest.mark.parametrize("text", ["=1+1", "+cmd|' /C calc'!A0", "-2+3", "@SUM(A1)", "\t=1", "\r=1"])
def test_a_formula_is_text_and_comes_back(tmp_path: Path, text: str):
    path = write_csv(tmp_path / "a.csv", [{text: text, "value": -0.5}])
    with open(path, newline="", encoding="utf-8") as file:
        head, row = csv.reader(file)
    assert head[0][0] == row[0][0] == "'"
    assert row[1] == "-0.5"
    if text.isprintable():
        assert plain_cell(row[0]) == plain_cell(head[0]) == text


@pytest.mark.parametrize("text", ["-0.5", "+3", "-inf", "1e-3", "", "hall", "a=b", "'quoted'"])
def test_numbers_and_plain_text_stay(tmp_path: Path, text: str):
    path = write_csv(tmp_path / "a.csv", [{"x": text, "y": 0}])
    assert path.read_text() == f"x,y\n{text},0\n"
    assert plain_cell(text) == text


@pytest.mark.parametrize(
    "name", ["hall\x1b[2J\x1b]0;x\x07", "a\x9b31m", "a\u202etxt.exe", "caf\udce9", "a\rb"]
)
def test_names_move_no_cursor(tmp_path: Path, name: str):
    for text in (
        str(ConfigError(f"{name}: damaged")),
        write_csv(tmp_path / "a.csv", [{"x": name}]).read_text(),
    ):
        assert "\\" in text
        assert not set(text) & set("\x1b\x07\x9b\u202e\udce9\r")


def test_the_hash_of_a_file(tmp_path: Path) -> None:
    content = bytes(range(256)) * 9000
    (tmp_path / "f").write_bytes(content)
    assert file_sha256(tmp_path / "f") == hashlib.sha256(content).hexdigest()
    with pytest.raises(SceneError, match="cannot be read"):
        file_sha256(tmp_path / "g")
