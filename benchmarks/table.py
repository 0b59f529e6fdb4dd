"""Reports as tables that people read."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from benchmarks.report import Report, number

__all__ = ["describe", "print_machine", "print_report"]


def describe(machine: dict[str, Any]) -> str:
    """One line about a machine of :func:`benchmarks.machine.describe_machine`."""
    flags = f" ({', '.join(machine['cpu_flags'])})" if machine["cpu_flags"] else ""
    gpu = f", {machine['gpu']}" if machine["gpu"] else ", no GPU"
    return (
        f"{machine['cpu']}{flags}, {machine['cores']} cores, {machine['memory_gib']} GiB{gpu};"
        f" torch {machine['torch']}, torchrl {machine['torchrl']}, commit {machine['commit']}"
    )


def print_machine(machine: dict[str, Any], console: Console) -> None:
    """Print one line that describes the machine."""
    console.print(Text(describe(machine)))


def print_report(report: Report, console: Console, quick: bool = False) -> None:
    """Print a suite's rows, then its requirements, one per line."""
    if report.skipped:
        console.print(Text(f"{report.suite}: skipped, {report.skipped}"))
        return
    table = Table(
        title=f"{report.suite}{' (quick: the numbers mean nothing)' if quick else ''}", title_justify="left"
    )
    for name, justify in (
        ("what", "left"),
        ("value", "right"),
        ("unit", "left"),
        ("times", "right"),
        ("peer", "left"),
    ):
        table.add_column(name, justify=justify, overflow="fold")  # type: ignore[arg-type]
    for row in report.rows:
        times = "" if row.ratio is None else number(row.ratio)
        table.add_row(row.name, number(row.value), row.unit, times, row.peer)
    console.print(table)
    for note in dict.fromkeys(f"{row.name}: {row.note}" for row in report.rows if row.note):
        console.print(Text(f"  {note}", style="dim"))
    for requirement in report.requirements:
        style = "green" if requirement.passed else "bold red"
        console.print(Text(requirement.line(), style="dim" if quick else style), soft_wrap=True)
