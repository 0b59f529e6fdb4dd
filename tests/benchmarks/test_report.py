"""Requirements, tables and the file."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path

from rich.console import Console

from benchmarks.machine import describe_machine
from benchmarks.report import Options, Report, Requirement, Row, read_reports, write_reports
from benchmarks.table import print_machine, print_report

REPORT = Report(
    "update",
    [
        Row("ours", 1234.5, "frames/s", "theirs", 2.5, "a note", (1.0, 2.0)),
        Row("never", math.nan, "s"),
    ],
    [
        Requirement("fast enough", 2.5, 2.0, "times"),
        Requirement("solved", math.nan, 15.0, "minutes", at_least=False),
    ],
)


def test_a_file_gives_back_what_was_written(tmp_path: Path):
    path = write_reports(tmp_path / "deep" / "all.json", describe_machine(), Options(), [REPORT])
    (again,) = read_reports(path)
    assert again.rows[0] == REPORT.rows[0]
    assert math.isnan(again.rows[1].value)
    assert again.requirements[0] == REPORT.requirements[0]
    assert math.isnan(again.requirements[1].value)
    content = json.loads(path.read_text(), parse_constant=lambda name: 1 / 0)  # no NaN, which is no JSON
    assert [line["passed"] for line in content["suites"][0]["requirements"]] == [True, False]
    assert content["machine"]["torch"]
    assert list(path.parent.iterdir()) == [path]


def test_what_was_not_reached_fails_either_way():
    assert not Requirement("x", math.nan, 1.0, "s").passed
    assert not Requirement("x", math.nan, 1.0, "s", at_least=False).passed


def test_tables_say_values_ratios_and_verdicts():
    page = io.StringIO()
    console = Console(file=page, width=120)
    print_machine(describe_machine(), console)
    print_report(REPORT, console)
    print_report(Report("gpu", skipped="no device"), console)
    text = page.getvalue()
    for part in ("1,234", "2.5", "theirs", "ours: a note", "PASS  fast enough: 2.5 times (at least 2)"):
        assert part in text
    assert "FAIL  solved: not reached minutes (at most 15)" in text
    assert "gpu: skipped, no device" in text
