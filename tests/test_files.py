"""Files are whole or not there."""

from __future__ import annotations

import csv
import hashlib
import json
import math
import os
from pathlib import Path

import pytest

from vusfa.errors import ConfigError, SceneError, check_choices
from vusfa.files import check_file, check_folder, file_sha256, plain_cell, replacing, write_csv, write_json


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


def test_a_file_that_cannot_be_written_is_found_before_the_work(tmp_path: Path) -> None:
    pipe, long = tmp_path / "pipe", tmp_path / ("x" * 250)
    os.mkfifo(pipe)
    assert check_file(tmp_path / "new" / "a.gif") == tmp_path / "new" / "a.gif"
    for path, words in {
        "/proc/x.gif": r"the file to write is '/proc/x\.gif', but /proc may not be written \(",
        tmp_path: "is a folder; name the file to write",
        Path("."): "is a folder",
        pipe: "pipe: is no regular file",
        "/dev/null": "/dev/null: is no regular file",
        "/dev/stdout": "/dev/stdout: is no regular file",
        pipe / "a.gif": "pipe is not a folder; give another",
        long: "File name too long; name another",
    }.items():
        with pytest.raises(ConfigError, match=words):
            check_file(path)
    assert list(tmp_path.iterdir()) == [pipe]
    with pytest.raises(ConfigError, match=r"results is '/proc/x/y', but /proc may not be written \(No such"):
        check_folder("/proc/x/y", "results")


def test_long_values_of_a_command_line_are_cut() -> None:
    assert str(ConfigError(f"folder is '{'x' * 100_000}'; give another")).count("x") < 1000
    assert str(ConfigError("a path of " + "x" * 900)).count("x") == 900


def test_words_that_are_no_choice_name_the_choices() -> None:
    check_choices("models", ["gvf"], ["gvf", "vusfa"])
    with pytest.raises(ConfigError, match="seeds has '7'; there are 0, 1"):
        check_choices("seeds", [0, 7], [0, 1])
    with pytest.raises(ConfigError, match="models has 'vufsa'; did you mean 'vusfa'"):
        check_choices("models", ["vufsa"], ["gvf", "vusfa"])
