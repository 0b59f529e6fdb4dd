"""``vusfa scenes compact``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vusfa.cli.sources import Force, check_target, scene_path

__all__ = ["register"]


def register(scenes: typer.Typer) -> None:
    """Add the command to ``vusfa scenes``."""
    scenes.command("compact")(compact)


def compact(
    source: Annotated[str, typer.Argument(help="Bundled name or scene file.", show_default=False)],
    target: Annotated[Path, typer.Argument(help="Scene file to write.", show_default=False)],
    force: Force = False,
) -> None:
    """Make a small copy of a scene: float16 features, JPEG pictures, compressed tables.

    The bundled rooms were made with it. JPEG pictures are kept byte for byte.

    Examples:

        vusfa scenes compact room.h5 room_small.h5
    """
    from vusfa.sources.compact import compact as write_compact

    path = scene_path(source)
    check_target(target, force)
    write_compact(path, target)
    typer.echo(f"{target}: {target.stat().st_size / 1e6:.1f} MB, from {path.stat().st_size / 1e6:.1f} MB")
