"""Progress that begins in the middle, and begins anew."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from vusfa.cli.resumed import resumed


class Clock:
    """Time that passes by hand."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        monkeypatch.setattr("vusfa.cli.progress.time.monotonic", lambda: self.now)


def test_the_rate_is_of_this_run(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, output = Clock(monkeypatch), io.StringIO()
    with resumed("encoding", "pictures", Console(file=output)) as report:
        report(70, 100)
        for done in range(71, 101):
            clock.now += 1.0
            report(done, 100)
    assert output.getvalue().splitlines() == [
        "encoding (some was there already): 10 of 30 pictures | 1.0 per second | 0:20 to go",
        "encoding (some was there already): 20 of 30 pictures | 1.0 per second | 0:10 to go",
        "encoding (some was there already): 30 of 30 pictures | 1.0 per second",
    ]


def test_what_begins_anew_has_a_line_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, output = Clock(monkeypatch), io.StringIO()
    with resumed("fetching", "B", Console(file=output)) as report:
        report(0, 2_000_000)
        clock.now += 10.0
        report(1_000_000, 2_000_000)
        report(0, 2_000_000)
        clock.now += 20.0
        report(2_000_000, 2_000_000)
    assert output.getvalue().splitlines() == [
        "fetching: 1.0 of 2.0 MB | 0.1 MB per second | 0:10 to go",
        "fetching: 2.0 of 2.0 MB | 0.1 MB per second",
    ]


def test_nothing_to_do_says_nothing() -> None:
    output = io.StringIO()
    with resumed("encoding", "pictures", Console(file=output)) as report:
        report(5, 5)
    with resumed("encoding", "pictures", Console(file=output)):
        pass
    assert output.getvalue() == ""
