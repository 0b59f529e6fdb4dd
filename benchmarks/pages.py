"""Write the tables of docs/speed.md: python benchmarks/pages.py [FILE ...]

Each FILE that ``benchmarks/run.py`` wrote is taken over into results/benchmarks, one file per suite, with the
machine's description reduced to what the page shows. Then every suite becomes docs/generated/speed-SUITE.md;
one without a file there says that it has not been measured. What was measured on a processor without bfloat16
units, or with --avx2, goes to SUITE-avx2.json and has a second table, speed-SUITE-avx2.md.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

sys.path.insert(0, str(Path(__file__).parents[1]))  # a script's own folder is there, not the one above

from benchmarks.report import Options, Report, Row, number, read_reports
from benchmarks.run import MODULES
from benchmarks.table import describe
from vusfa.errors import ConfigError
from vusfa.files import write_json, write_text

__all__ = ["COMMAND", "document", "documents", "take_over"]

ROOT = Path(__file__).parents[1]
COMMAND = "python benchmarks/pages.py"
#: Facts of a machine that are kept.
FACTS = (
    "cpu", "cores", "cpu_flags", "memory_gib", "gpu", "python", "torch", "torchrl", "vusfa", "commit",
    "threads", "foreign_load",
)  # fmt: skip


def take_over(path: Path, results: Path) -> list[Path]:
    """Copy the suites of a file into a folder, one file per suite, each replaced atomically.

    Raises:
        ConfigError: the file was written with ``--quick``, or is no report.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        quick, suites = content["options"]["quick"], content["suites"]
        machine = {name: content["machine"][name] for name in FACTS}
        bfloat16 = {"avx512_bf16", "amx_bf16"} & set(machine["cpu_flags"])
        ending = "-avx2" * (content["options"].get("avx2", False) or not bfloat16)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{path}: is no report of benchmarks/run.py ({error})") from error
    if quick:
        raise ConfigError(f"{path}: was written with --quick, and its numbers mean nothing; measure in full")
    return [
        write_json(
            results / f"{suite['suite']}{ending}.json", {**content, "machine": machine, "suites": [suite]}
        )
        for suite in suites
        if not suite["skipped"]
    ]


def documents(results: Path) -> dict[str, str]:
    """The tables of all suites, from a folder of reports, Markdown, by the names of their files."""
    return {
        f"speed-{suite}.md": f"<!-- {COMMAND} -->\n\n{document(results / f'{suite}.json')}\n"
        for suite in [*MODULES, *sorted(path.stem for path in results.glob("*-avx2.json"))]
    }


def document(path: Path) -> str:
    """One suite: its command and machine, its rows, its requirements."""
    if not path.exists():
        return f"Not measured with this version: `python benchmarks/run.py --suite {path.stem}` does."
    content, (report,) = json.loads(path.read_text(encoding="utf-8")), read_reports(path)
    machine = content["machine"]
    limited = "; torch, oneDNN and MKL limited to AVX2" * content["options"].get("avx2", False)
    parts = [
        f"`{_command(report.suite, content['options'])}`",
        f"{describe(machine)}{limited}. "
        f"Other programs kept {machine['foreign_load']} cores busy at the start.",
        "\n".join(_rows(report.rows)),
    ]
    notes = dict.fromkeys(f"- {row.name}: {row.note}" for row in report.rows if row.note)
    parts += ["\n".join(notes)] if notes else []
    parts += ["\n".join(_requirements(report))] if report.requirements else []
    return "\n\n".join(parts)


def _command(suite: str, options: dict[str, Any]) -> str:
    """The command line that measured it: what differs from the defaults."""
    words = ["python benchmarks/run.py --suite", suite]
    for name in ("repetitions", "seconds", "threads", "cap"):
        if options[name] != getattr(Options(), name):
            words.append(f"--{name} {options[name]:g}")
    words += ["--avx2"] * options.get("avx2", False)
    return " ".join([*words, *(f"--set {override}" for override in options["overrides"])])


def _rows(rows: list[Row]) -> list[str]:
    """A table with one line per name: a row that is compared with several peers names them all."""
    peers: dict[str, list[str]] = {}
    for row in rows:
        peers.setdefault(row.name, [])
        if row.ratio is not None:
            peers[row.name].append(f"{number(row.ratio)} × {row.peer}")
    values = {row.name: f"{number(row.value)} | {row.unit}" for row in rows}
    lines = [f"| {name} | {values[name]} | {', '.join(beside)} |" for name, beside in peers.items()]
    return ["| what | value | unit | beside |", "|---|---:|---|---|", *lines]


def _requirements(report: Report) -> list[str]:
    lines = ["| | requirement | measured | bound |", "|---|---|---:|---:|"]
    for line in report.requirements:
        verdict, side = "PASS" if line.passed else "**FAIL**", "at least" if line.at_least else "at most"
        lines.append(
            f"| {verdict} | {line.text} | {number(line.value)} {line.unit} | {side} {number(line.bound)} |"
        )
    return lines


def main(
    files: Annotated[list[Path] | None, typer.Argument(help="reports to take over")] = None,
    results: Annotated[Path, typer.Option(help="folder of the reports")] = ROOT / "results" / "benchmarks",
    docs: Annotated[Path, typer.Option(help="folder of the tables")] = ROOT / "docs" / "generated",
) -> None:
    """Take reports over, and write the tables of all."""
    try:
        for path in files or []:
            for taken in take_over(path, results):
                print(taken)
        for name, text in documents(results).items():
            print(write_text(docs / name, text))
    except ConfigError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    typer.run(main)
