"""Readers refuse what is too large, too deep or of another kind before they make anything of it."""

from __future__ import annotations

import io
import os
import struct
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vusfa.errors import ConfigError, ResultError
from vusfa.reading import parse_yaml, read_csv, read_json, read_npy, read_npz, read_text

MEND = "write it again"
#: Keys that are merged from two copies of what was merged before, 30 times over.
_MERGES = "a0: &a0 {x: 1}\n" + "".join(f"a{n}: &a{n} {{<<: [*a{n - 1}, *a{n - 1}]}}\n" for n in range(1, 30))


def npz(path: Path, **members: bytes) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            file.writestr(f"{name}.npy", content)
    return path


def npy(array: Any, header: tuple[str, str] | None = None) -> bytes:
    """The bytes of a .npy file; ``header`` replaces a part of its head by a lie of the same length."""
    buffer = io.BytesIO()
    np.save(buffer, array)
    content = buffer.getvalue()
    if header is not None:
        old, new = (text.encode() for text in header)
        assert old in content
        content = content.replace(old, new).replace(b" " * (len(new) - len(old)) + b"\n", b"\n", 1)
    return content


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        pytest.param(npy(np.zeros(3), ("(3,)", "(99999999999,)")), "holds 24 bytes", id="huge"),
        pytest.param(npy(np.zeros(3), ("(3,)", "(2,)")), "holds 24 bytes", id="short"),
        pytest.param(npy(np.zeros(3), ("(3,)", "(-3,)")), "declares float64", id="negative"),
        pytest.param(npy(np.zeros(3), ("'<f8'", "'|O'")), "header is damaged|declares object", id="pickles"),
        pytest.param(npy(np.zeros(3), ("(3,)", "(" * 40)), "header is damaged", id="no shape"),
        pytest.param(b"\x93NUMPY\x02\x00\xff\xff\xff\x7f{", "header is damaged", id="header of 2 GB"),
        pytest.param(npy(np.zeros(3))[:-1], "holds 23 bytes", id="cut"),
        pytest.param(npy(np.zeros(2, "M8[s]")), "declares datetime64", id="dates"),
    ],
)
def test_arrays_whose_headers_lie(tmp_path: Path, content: bytes, fault: str) -> None:
    with pytest.raises(ResultError, match=rf"m\.npz: .*a\.npy: .*{fault}"):
        read_npz(npz(tmp_path / "m.npz", a=content))
    (tmp_path / "a.npy").write_bytes(content)
    with pytest.raises(ConfigError, match=rf"a\.npy: .*{fault}"):
        read_npy(tmp_path / "a.npy", ConfigError, MEND)


def test_arrays_that_swell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = npz(tmp_path / "m.npz", a=npy(np.zeros(1 << 20)))
    assert path.stat().st_size < 1 << 16
    assert read_npz(path)["a"].size == 1 << 20
    monkeypatch.setattr("vusfa.limits.MAX_NPZ_ELEMENTS", 1000)
    with pytest.raises(ResultError, match="more than 1000 elements"):
        read_npz(path)
    monkeypatch.setattr("vusfa.limits.MAX_NPZ_BYTES", 1 << 20)
    with pytest.raises(ResultError, match="more than 1048576 bytes"):
        read_npz(path)


@pytest.mark.parametrize("shape", ["(3,)", "(1048576,)"])
def test_members_longer_than_the_archive_says(tmp_path: Path, shape: str) -> None:
    """No more is decompressed than is declared: 8 MB here, whatever is in the file."""
    content = npy(np.zeros(1 << 20))
    path = npz(tmp_path / "m.npz", a=npy(np.zeros(3), ("(3,)", shape))[:-24] + content)
    size = struct.pack("<I", len(content) + 128)
    assert path.read_bytes().count(size) == 2  # of the member, and of the list of contents
    path.write_bytes(path.read_bytes().replace(size, struct.pack("<I", 152)))
    tracemalloc.start()
    try:
        with pytest.raises(ResultError, match=r"m\.npz: cannot be read \("):
            read_npz(path)
        assert tracemalloc.get_traced_memory()[1] < 1 << 22
    finally:
        tracemalloc.stop()


def test_archives_with_a_long_list_or_another_compression(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = npz(tmp_path / "m.npz", **{f"a{n}": b"" for n in range(100)})
    monkeypatch.setattr("vusfa.limits.MAX_ZIP_READ", 1000)
    with pytest.raises(ResultError, match="list of contents has more than 1000 bytes"):
        read_npz(path)
    with zipfile.ZipFile(tmp_path / "l.npz", "w", zipfile.ZIP_LZMA) as file:
        file.writestr("a.npy", npy(np.zeros(3)))
    with pytest.raises(ResultError, match="another method than deflate"):
        read_npz(tmp_path / "l.npz")


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        pytest.param("a: &a [*a]", "repeats itself", id="recursion"),
        pytest.param(_MERGES, "100000 entries", id="merge keys"),
        pytest.param("- " * 500, "nested more than 20", id="depth"),
        pytest.param("[" + "1," * 200_000 + "1]", "100000 entries", id="entries"),
        pytest.param("a: " + ":1" * 100_000, "10000 characters", id="base 60"),
        pytest.param("a: !!python/object:os.system {}", "has a tag", id="tag"),
        pytest.param("a: 2001-99-99", "cannot be read as YAML", id="date"),
        pytest.param("a: 0x_", "cannot be read as YAML", id="number"),
        pytest.param("a: \x00", "cannot be read as YAML", id="control character"),
        pytest.param("a: [1", "expected ',' or ']'", id="not closed"),
        pytest.param("a: 1\nb: 2\na: 3", "has the key 'a' twice", id="key twice"),
        pytest.param("a: {b: {1: x, 1: y}}", "has the key '1' twice", id="key twice, deeper"),
        pytest.param(
            "".join(f"k{n}: 1\n" for n in range(8000)) + "k7: 2", "'k7' twice", id="key twice, late"
        ),
    ],
)
def test_yaml_beyond_its_limits(text: str, fault: str) -> None:
    with pytest.raises(ConfigError, match=rf"x\.yaml: .*{fault}") as caught:
        parse_yaml(text, "x.yaml", ConfigError, MEND)
    assert len(str(caught.value)) < 1000
    assert len(str(caught.value).splitlines()) == 1


def test_aliases_within_the_limits_are_read() -> None:
    assert parse_yaml("a: &a [1, 2]\nb: *a", "x", ConfigError, MEND) == {"a": [1, 2], "b": [1, 2]}


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("[" * 100_000, "cannot be read as JSON"),
        ("9" * 10_000, "cannot be read as JSON"),
        ("[1]", r"holds \[1\] in place of an object"),
        ("", "cannot be read as JSON"),
    ],
)
def test_json_of_another_kind(tmp_path: Path, text: str, fault: str) -> None:
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(ConfigError, match=rf"a\.json: {fault}"):
        read_json(tmp_path / "a.json", ConfigError, MEND)


def test_columns_of_a_csv_file(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text('name,x\n"a, b",1\nc\n')
    columns = read_csv(path, ConfigError, MEND, words=["name"])
    assert columns["name"] == ["a, b", "c"]
    np.testing.assert_array_equal(columns["x"], [1.0, np.nan])
    for text, fault in (
        ("x\n1,2\n", "row 2 .2 fields, and 1 columns"),
        ("x,x\n", "a column is named twice"),
        ("x\n1\nb\n", "row 3 .could not convert string"),
        ("x\n" + "1" * 200_000, "field larger than field limit"),
    ):
        path.write_text(text)
        with pytest.raises(ConfigError, match=rf"a\.csv: .*{fault}"):
            read_csv(path, ConfigError, MEND)
    path.write_bytes(b"x\n\xfc\n")
    with pytest.raises(ConfigError, match="codec can't decode"):
        read_csv(path, ConfigError, MEND)


def test_only_regular_files_of_bounded_size(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")  # opening it would hang
    for path in ("/dev/zero", str(tmp_path / "pipe")):
        for read in (read_json, read_text, read_csv, read_npy):
            with pytest.raises(ConfigError, match=f"{path}: cannot be read .it is no regular file"):
                read(path, ConfigError, MEND)
        with pytest.raises(ResultError, match="no regular file"):
            read_npz(path)
    with open(tmp_path / "sparse", "wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(ConfigError, match="more than 1048576 bytes"):
        read_text(tmp_path / "sparse", ConfigError, MEND)


def test_what_a_parser_says_is_one_bounded_line(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("frames\n" + "x" * 100_000 + "\n")
    with pytest.raises(ConfigError, match=r"a\.csv: cannot be read as CSV, row 2 \(could not") as caught:
        read_csv(tmp_path / "a.csv", ConfigError, MEND)
    assert len(str(caught.value)) < 1000
    for text in ("hall: [3, {", "hall: 'x", "- a\n b: [", "? " + "x" * 5000 + "\n: ]"):
        with pytest.raises(ConfigError, match=r"goals\.yaml: cannot be read as YAML") as caught:
            parse_yaml(text, "goals.yaml", ConfigError, MEND)
        assert "\n" not in str(caught.value)
        assert len(str(caught.value)) < 1000
    for text in (rb'{"a": "\ud800"}', rb'{"\uDFFFx": 1}', rb'{"a": ["\udc00\ud800"]}'):
        (tmp_path / "a.json").write_bytes(text)
        with pytest.raises(ConfigError, match=r"a\.json: cannot be read as JSON \(.*surrogates"):
            read_json(tmp_path / "a.json", ConfigError, MEND)
