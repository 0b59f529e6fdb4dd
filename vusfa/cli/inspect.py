"""``vusfa scenes check``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["register"]


def register(scenes: typer.Typer) -> None:
    """Add the commands to ``vusfa scenes``."""
    scenes.command("check")(check)


def check(
    files: Annotated[list[Path], typer.Argument(help="Scene files.", metavar="FILE...", show_default=False)],
) -> None:
    """Say everything that is wrong with scene files; exit code 1 if anything is.

    The loader's own rules: shapes and types, every move of the graph, the shortest paths by a search of
    it, the features, the poses, and every picture.

    Examples:

        vusfa scenes check room.h5
        vusfa scenes check dumps/*.h5
    """
    from vusfa.scenes import validate

    faulty = 0
    for path in files:
        faults = validate(path)
        faulty += bool(faults)
        typer.echo("\n".join(faults) if faults else f"{path}: sound")
    if faulty:
        typer.echo(f"{faulty} of {len(files)} files have faults", err=True)
        raise typer.Exit(1)
