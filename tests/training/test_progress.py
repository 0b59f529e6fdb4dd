"""The progress line, on a terminal and off it."""

from __future__ import annotations

import io
import math

from rich.console import Console

from vusfa.training import EvaluationProgress, ProgressLine
from vusfa.training.progress import describe


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_what_is_not_known_is_left_out():
    assert describe(5, 10, math.nan, math.nan, math.nan) == "5 of 10 frames"
    assert describe(0, 36_000, 2.0, 0.5, math.nan).endswith("| 2 per second | success 50.0 % | 5:00:00 to go")
    assert describe(12, 10, 2.0, 0.5, math.nan).endswith("0:00 to go")


def test_a_file_gets_a_line_now_and_then():
    page, clock = io.StringIO(), Clock()
    line = ProgressLine(1000, Console(file=page, width=60), every=10.0, clock=clock)
    with line:
        for second in range(25):
            clock.now = float(second)
            line.update(second * 4)
            if second == 5:
                line.rates({"success": 0.25, "length_ratio": 3.0})
                line.rates({"success": math.nan, "length_ratio": math.nan})
    lines = page.getvalue().splitlines()
    assert [text.split()[0] for text in lines] == ["0", "40", "80", "96"]
    shown = "success 25.0 % | length / shortest 3.00 | 4:00 to go"
    assert lines[1] == f"40 of 1,000 frames | 4 per second | {shown}"


def test_with_evaluations_the_line_shows_these_and_not_the_episodes_that_ended():
    page = io.StringIO()
    with ProgressLine(100, Console(file=page, width=120)) as line:
        line.update(50)
        line.rates({"success": 1.0, "length_ratio": 1.0}, validated=True)
        line.update(60)
        line.rates({"success": 1.0, "eval/trained/success": 0.5, "eval/validation/success": 0.25}, True)
        line.update(100)
    first, last = page.getvalue().splitlines()[0], page.getvalue().splitlines()[-1]
    assert "success" not in first
    assert "success 50.0 %, validation goals 25.0 %" in last
    assert "shortest" not in last


def test_a_terminal_keeps_one_line():
    page = io.StringIO()
    console = Console(file=page, width=120, force_terminal=True)
    with ProgressLine(100, console) as line:
        line.update(50)
        line.rates({"success": 1.0, "length_ratio": 1.25})
        line.update(100)
    text = page.getvalue()
    assert "100 of 100 frames" in text
    assert "success 100.0 % | length / shortest 1.25" in text
    assert text.count("\n") <= 2


def test_the_rate_is_that_of_the_last_half_minute():
    page, clock = io.StringIO(), Clock()
    line = ProgressLine(10**6, Console(file=page, width=200), every=1.0, clock=clock)
    frames = 0
    for second in range(100):
        clock.now = float(second)
        frames += 1000 if second < 50 else 10
        line.update(frames)
    assert " 10 per second" in page.getvalue().splitlines()[-1]


def test_an_evaluation_has_a_line_for_each_policy():
    page = io.StringIO()
    with EvaluationProgress(Console(file=page, width=200), every=0.0) as progress:
        progress("vusfa", 1, 4)
        progress("vusfa", 4, 4)
        progress("untrained", 2, 4)
    lines = page.getvalue().splitlines()
    assert lines[0] == "1 of 4 episodes of vusfa"
    assert any(line.startswith("4 of 4 episodes of vusfa |") for line in lines)
    assert lines[-1].startswith("2 of 4 episodes of untrained")
