"""Results of a suite: rows, requirements, and their file."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vusfa.files import write_json

__all__ = ["Options", "Report", "Requirement", "Row", "read_reports", "write_reports"]


@dataclass(frozen=True)
class Options:
    """Options of a measurement.

    Attributes:
        quick: tiny sizes, to see that everything runs; the numbers mean nothing.
        repetitions: turns of each workload.
        seconds: length of a turn.
        threads: threads of torch, in measurements on two cores.
        cap: seconds after which a training counts as not solving the task.
        overrides: settings of the recipe that are not its default ones.
        avx2: torch may use AVX2 alone, an imitation of a processor without bfloat16 units.
    """

    quick: bool = False
    repetitions: int = 5
    seconds: float = 1.0
    threads: int = 2
    cap: float = 900.0
    overrides: tuple[str, ...] = ()
    avx2: bool = False


@dataclass(frozen=True)
class Row:
    """One measurement.

    Attributes:
        name: what was measured.
        value, unit: the result and its unit.
        peer: the alternative that it is compared with.
        ratio: ours over the peer's, more is better for us; None without a peer.
        note: remark for the reader.
        samples: the turns that ``value`` is the median of.
    """

    name: str
    value: float
    unit: str
    peer: str = ""
    ratio: float | None = None
    note: str = ""
    samples: tuple[float, ...] = ()


@dataclass(frozen=True)
class Requirement:
    """A bound that the library must keep.

    >>> Requirement("fast", value=3.0, bound=2.0, unit="times").line()
    'PASS  fast: 3 times (at least 2)'
    >>> Requirement("brief", value=3.0, bound=2.0, unit="s", at_least=False).passed
    False
    """

    text: str
    value: float
    bound: float
    unit: str
    at_least: bool = True

    @property
    def passed(self) -> bool:
        """Whether it holds; a value that was not reached (NaN) fails."""
        return self.value >= self.bound if self.at_least else self.value <= self.bound

    def line(self) -> str:
        """The requirement as a printed line."""
        verdict, side = "PASS" if self.passed else "FAIL", "at least" if self.at_least else "at most"
        return f"{verdict}  {self.text}: {number(self.value)} {self.unit} ({side} {number(self.bound)})"


@dataclass
class Report:
    """The rows and requirements of a suite, or the reason why it was skipped."""

    suite: str
    rows: list[Row] = field(default_factory=list)
    requirements: list[Requirement] = field(default_factory=list)
    skipped: str = ""

    def value(self, name: str) -> float:
        """The value of the row of that name."""
        return next(row.value for row in self.rows if row.name == name)


def number(value: float) -> str:
    """Format a number for people.

    >>> number(1234567.0), number(12.345), number(0.01234), number(float("nan"))
    ('1,234,567', '12.3', '0.0123', 'not reached')
    """
    if math.isnan(value):
        return "not reached"
    if abs(value) >= 100:
        return f"{value:,.0f}"
    return f"{value:.3g}"


def counted(number: int, noun: str) -> str:
    """A number with its noun.

    >>> counted(1, "thread"), counted(2, "thread")
    ('1 thread', '2 threads')
    """
    return f"{number} {noun}{'s' * (number != 1)}"


def write_reports(path: Path, machine: dict[str, Any], options: Options, reports: Sequence[Report]) -> Path:
    """Write everything to a JSON file, atomically; NaN becomes null."""
    content = {
        "machine": machine,
        "options": dataclasses.asdict(options),
        "suites": [_plain(report) for report in reports],
    }
    return write_json(path, _finite(content))


def read_reports(path: Path) -> list[Report]:
    """The suites of a file that :func:`write_reports` wrote."""
    suites = json.loads(path.read_text(encoding="utf-8"))["suites"]
    nan = math.nan
    return [
        Report(
            suite["suite"],
            [
                Row(
                    **{
                        **row,
                        "value": nan if row["value"] is None else row["value"],
                        "samples": tuple(row["samples"]),
                    }
                )
                for row in suite["rows"]
            ],
            [_requirement(line) for line in suite["requirements"]],
            suite["skipped"],
        )
        for suite in suites
    ]


def _requirement(line: dict[str, Any]) -> Requirement:
    fields = {key: value for key, value in line.items() if key != "passed"}
    fields["value"] = math.nan if line["value"] is None else line["value"]
    return Requirement(**fields)


def _plain(report: Report) -> dict[str, Any]:
    plain = dataclasses.asdict(report)
    for line, requirement in zip(plain["requirements"], report.requirements, strict=True):
        line["passed"] = requirement.passed
    return plain


def _finite(content: Any) -> Any:
    if isinstance(content, dict):
        return {key: _finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_finite(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content
