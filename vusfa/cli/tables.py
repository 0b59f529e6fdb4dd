"""Tables of ``vusfa scenes list``."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from vusfa.errors import SceneError, printable
from vusfa.sources.summary import Group, Summary

__all__ = ["print_wide", "table_of_groups", "table_of_scenes"]


def table_of_scenes(rows: Sequence[tuple[str, Summary | SceneError]], walk_steps: int) -> Table:
    """Table with one row per scene.

    Args:
        rows: path of each scene, and its numbers or its fault.
        walk_steps: limit of actions of the random walk.

    >>> table_of_scenes([("a.h5", SceneError("a.h5: is empty"))], 500).row_count
    1
    """
    table = Table()
    table.add_column("scene")
    for column in ("states", "cells", "actions", "features", "islands"):
        table.add_column(column, justify="right")
    table.add_column("look\nalike", justify="right")
    table.add_column(f"random walk,\n{walk_steps} steps", justify="right")
    table.add_column("mean\npath", justify="right")
    table.add_column("longest\npath", justify="right")
    table.add_column("pictures", justify="right")
    table.add_column("file", overflow="fold")
    for label, found in rows:
        if isinstance(found, SceneError):
            table.add_row(Text("faulty", "red"), *[""] * 10, Text(printable(label)))
            continue
        height, width = found.picture_shape[:2] if found.picture_shape else (0, 0)
        crops = f"{found.crops} x " if found.crops > 1 else ""
        table.add_row(
            Text(printable(found.name)),
            *(str(number) for number in (found.states, found.cells, found.actions)),
            f"{crops}{found.features}",
            str(found.islands),
            f"{100 * found.look_alikes:.1f} %",
            f"{100 * found.random_walk:.1f} %",
            f"{found.mean_path:.1f}",
            str(found.longest_path),
            f"{width} x {height}" if found.picture_shape else "none",
            Text(printable(label)),
        )
    return table


def table_of_groups(groups: Sequence[Group]) -> Table:
    """Table with one row per name of scenes.

    >>> table_of_groups([Group("hall", 10, 2120, 0.001, 0.01)]).row_count
    1
    """
    table = Table("scenes")
    for column in ("number", "states", "distinguishable", "in the worst"):
        table.add_column(column, justify="right")
    for group in groups:
        table.add_row(
            Text(printable(group.name)),
            str(group.scenes),
            str(group.states),
            f"{100 * (1 - group.look_alikes):.2f} %",
            f"{100 * (1 - group.most):.2f} %",
        )
    return table


def print_wide(table: Table) -> None:
    """Print to standard output; in a file or a pipe a table has its full width."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=max(console.width, console.measure(table).maximum, 200))
    console.print(table)
