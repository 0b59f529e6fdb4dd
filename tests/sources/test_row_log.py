"""The log of finished rows: what arrived whole is kept, what was torn or belongs to other work is not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from vusfa.errors import SceneError
from vusfa.sources.row_log import RowLog

PAIR = np.dtype((np.float32, (2, 3)))


def rows(first: int, last: int) -> np.ndarray:
    return np.arange(first * 6, last * 6, dtype=np.float32).reshape(-1, 2, 3)


def test_rows_come_back_in_another_run(tmp_path: Path) -> None:
    log = RowLog(tmp_path / "log", {"a": 1}, PAIR)
    log.append(rows(0, 2))
    log.append(rows(2, 3))
    log.append(rows(3, 3))
    again = RowLog(tmp_path / "log", {"a": 1}, PAIR)
    assert len(again) == 3
    assert np.array_equal(again.read(), rows(0, 3))
    assert np.array_equal(again.read(1, 2), rows(1, 2))
    assert again.read(3, 9).shape == (0, 2, 3)
    again.append(rows(3, 4))
    assert np.array_equal(RowLog(tmp_path / "log", {"a": 1}, PAIR).read(), rows(0, 4))
    again.remove()
    again.remove()
    assert not (tmp_path / "log").exists()


def test_structured_rows(tmp_path: Path) -> None:
    dtype = np.dtype([("stood", "?"), ("frame", "u1", (2, 2, 3))])
    record = np.zeros(2, dtype)
    record["stood"], record["frame"] = [True, False], np.arange(24).reshape(2, 2, 2, 3)
    log = RowLog(tmp_path / "log", {}, dtype)
    assert len(log.read()) == 0
    log.append(record)
    assert np.array_equal(RowLog(tmp_path / "log", {}, dtype).read(), record)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_torn_and_damaged_rows_are_dropped_with_all_that_follows(tmp_path: Path, data: st.DataObject) -> None:
    path = tmp_path / "log"
    path.unlink(missing_ok=True)
    RowLog(path, {}, PAIR).append(rows(0, 5))
    whole = path.read_bytes()
    head, record = len(whole) - 5 * 28, 28
    at = data.draw(st.integers(0, len(whole) - 1))
    if data.draw(st.booleans(), "torn"):
        path.write_bytes(whole[:at])
    else:
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
    survivors = max(0, (at - head) // record)
    again = RowLog(path, {}, PAIR)
    assert len(again) == survivors
    assert np.array_equal(again.read(), rows(0, survivors))
    again.append(rows(survivors, 5))
    assert path.read_bytes() == whole


@pytest.mark.parametrize("other", [({"a": 2}, PAIR), ({"a": 1}, np.dtype((np.float32, (3, 2))))])
def test_other_work_begins_anew(tmp_path: Path, other: tuple) -> None:
    RowLog(tmp_path / "log", {"a": 1}, PAIR).append(rows(0, 2))
    assert len(RowLog(tmp_path / "log", *other)) == 0


def test_cutting(tmp_path: Path) -> None:
    log = RowLog(tmp_path / "log", {}, PAIR)
    log.append(rows(0, 5))
    log.cut(7)
    assert len(log) == 5
    log.cut(2)
    assert np.array_equal(log.read(), rows(0, 2))
    assert len(RowLog(tmp_path / "log", {}, PAIR)) == 2


def test_rows_of_another_size_are_refused(tmp_path: Path) -> None:
    log = RowLog(tmp_path / "log", {}, PAIR)
    with pytest.raises(ValueError, match="24 bytes, not 48"):
        log.append(rows(0, 2).astype(np.float64))
    assert len(RowLog(tmp_path / "log", {}, PAIR)) == 0


def test_a_folder_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="cannot be written"):
        RowLog(tmp_path / "no" / "log", {}, PAIR)
    log = RowLog(tmp_path / "log", {}, PAIR)
    log.path = tmp_path  # a folder
    with pytest.raises(SceneError, match="cannot be written"):
        log.append(rows(0, 1))
