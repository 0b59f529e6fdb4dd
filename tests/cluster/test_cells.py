"""Cells: run once, skipped when done, shared out among commands."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import pytest

from vusfa.cluster import cells
from vusfa.cluster.cells import Cell, Job, run_cell, run_cells
from vusfa.cluster.locks import FileLock
from vusfa.errors import ConfigError, ResultError, SceneError
from vusfa.files import write_text


def work(path: Path, log: list[str]) -> str:
    log.append(path.name)
    return f"made {write_text(path, 'made').name}"


@pytest.fixture
def three(tmp_path: Path) -> tuple[list[Cell], list[str]]:
    log: list[str] = []
    paths = [tmp_path / "table" / name for name in "abc"]
    return [Cell(path, partial(work, path, log)) for path in paths], log


def test_done_cells_are_skipped(
    three: tuple[list[Cell], list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    some, log = three
    run_cells(some[:1])
    run_cells(some)
    assert log == ["a", "b", "c"]
    printed = capsys.readouterr().out.splitlines()
    assert printed == ["made a", f"{some[0].result}: already there", "made b", "made c"]
    assert sorted(path.name for path in some[0].result.parent.iterdir()) == ["a", "b", "c"]
    run_cells(some[1:], again=True)
    assert log[3:] == ["b", "c"]


def test_the_folder_of_a_run_is_a_result(tmp_path: Path) -> None:
    cell = Cell(tmp_path / "gvf-0", partial(write_text, tmp_path / "gvf-0" / "cell.json", "{}"))
    assert not cell.is_done
    (tmp_path / "gvf-0").mkdir()
    assert not cell.is_done
    run_cells([cell])
    assert cell.is_done


def test_a_cell_that_another_process_works_on_is_left_to_it(
    three: tuple[list[Cell], list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    """And waited for at the end; here it leaves the cell undone, so that the waiting command runs it."""
    some, log = three
    other = FileLock(some[0].result.with_name(".a.lock"))
    some[0].result.parent.mkdir()
    other.acquire()
    threading.Timer(0.15, other.release).start()
    run_cells(some)
    assert log == ["b", "c", "a"]
    assert f"{some[0].result}: process " in capsys.readouterr().err


def test_two_commands_at_once_run_every_cell_once(tmp_path: Path) -> None:
    log: list[str] = []
    paths = [tmp_path / str(number) for number in range(30)]
    some = [Cell(path, partial(work, path, log)) for path in paths]
    others = [threading.Thread(target=run_cells, args=(some,)) for _ in range(3)]
    for other in others:
        other.start()
    for other in others:
        other.join()
    assert sorted(log, key=int) == [path.name for path in paths]


def test_a_cell_that_fails_leaves_nothing(tmp_path: Path) -> None:
    def fail() -> None:
        raise SceneError("hall.h5: dataset 'graph' is missing")

    with pytest.raises(SceneError, match="graph"):
        run_cells([Cell(tmp_path / "results" / "table" / "a", fail)])
    assert list(tmp_path.iterdir()) == []


def test_a_launcher_that_ends_early_is_an_error(
    three: tuple[list[Cell], list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    def lazy(jobs: Sequence[Job], options: Mapping[str, str]) -> None:
        jobs[0]()

    monkeypatch.setitem(cells.LAUNCHERS, "lazy", lazy)
    with pytest.raises(ResultError, match=r"1 of 3 cells are not done, .*c first: run the command again"):
        run_cells(three[0], "lazy")  # two passes, one cell each


@pytest.mark.parametrize(
    ("launcher", "options", "message"),
    [
        ("rai", [], "launcher is 'rai': no such launcher; did you mean 'ray'"),
        ("serial", ["n_jobs=2"], "launcher_options has 'n_jobs', but launcher=serial takes none"),
        ("serial", ["fast"], r"launcher_options has 'fast'; write options as \[num_cpus=2"),
        ("serial", ["=2"], "launcher_options has '=2'"),
    ],
)
def test_what_launchers_refuse(
    three: tuple[list[Cell], list[str]], launcher: str, options: list[str], message: str
) -> None:
    import vusfa.cluster  # noqa: F401

    with pytest.raises(ConfigError, match=message):
        run_cells(three[0], launcher, options)
    assert not three[0][0].result.parent.exists()


def test_a_folder_that_is_a_file_is_refused_first(three: tuple[list[Cell], list[str]]) -> None:
    some, log = three
    some[0].result.parent.write_text("mine")
    with pytest.raises(ConfigError, match="is not a folder"):
        run_cells(some)
    assert log == []


def test_a_finished_cell_is_not_run_by_a_job_that_comes_late(
    three: tuple[list[Cell], list[str]],
) -> None:
    (first, *_), log = three
    assert run_cell(first) == "made a"
    assert run_cell(first, wait=True) is None
    assert run_cell(first, again=True) == "made a"
    assert log == ["a", "a"]
