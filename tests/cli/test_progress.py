"""How far a command is, on a terminal and elsewhere."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from vusfa.cli import progress as module
from vusfa.cli.progress import progress


class Clock:
    """Time that passes by hand."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        monkeypatch.setattr(module.time, "monotonic", lambda: self.now)


def test_in_a_file_there_is_a_line_every_ten_seconds_and_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, output = Clock(monkeypatch), io.StringIO()
    with progress("reading", 30, "pictures", Console(file=output)) as advance:
        for _ in range(30):
            clock.now += 1.0
            advance()
    assert output.getvalue().splitlines() == [
        "reading: 10 of 30 pictures | 1.0 per second | 0:20 to go",
        "reading: 20 of 30 pictures | 1.0 per second | 0:10 to go",
        "reading: 30 of 30 pictures | 1.0 per second",
    ]


def test_what_is_done_at_once_needs_no_line(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, output = Clock(monkeypatch), io.StringIO()
    with progress("reading", 3, "pictures", Console(file=output)) as advance:
        for _ in range(3):
            clock.now += 0.5
            advance()
    assert output.getvalue() == ""


def test_on_a_terminal_there_is_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    output = io.StringIO()
    console = Console(file=output, force_terminal=True, width=100)
    with progress("fetching", 5e6, "B", console) as advance:
        advance(5e6)
    assert "fetching" in output.getvalue()
    assert "5.0 of 5.0 MB" in output.getvalue()
