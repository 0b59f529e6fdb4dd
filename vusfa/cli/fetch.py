"""``vusfa scenes fetch``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["register"]


def register(scenes: typer.Typer) -> None:
    """Add the command to ``vusfa scenes``."""
    scenes.command("fetch")(fetch)


def fetch(
    name: Annotated[str, typer.Argument(help="What to fetch: thor-v1.", show_default=False)],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the scenes.")] = Path("scenes"),
    mirror: Annotated[
        list[str] | None, typer.Option(help="Address to try; may be given several times.")
    ] = None,
    config: Annotated[
        Path | None, typer.Option(help="YAML file of archives, mirrors and timeouts.", show_default=False)
    ] = None,
) -> None:
    """Fetch published scenes: the original THOR v1 dumps, four rooms of 180 to 676 states.

    An interrupted download resumes, also after Ctrl-C and in the next run; mirrors are tried in turn. The
    archive is unpacked to a temporary folder and accepted only if its checksums, its schema, its numbers of
    states and a breadth-first search of every graph agree.

    Examples:

        vusfa scenes fetch thor-v1 --out dumps

        vusfa scenes fetch thor-v1 --mirror http://host.example/thor_v1_scene_dumps.zip
    """
    from vusfa.cli.resumed import resumed
    from vusfa.errors import ConfigError
    from vusfa.sources.fetch import archives
    from vusfa.sources.fetch import fetch as fetch_archive

    entries = archives(config)
    if name not in entries:
        raise ConfigError(f"no archive is called {name!r}; there are {', '.join(entries)}")
    with resumed("fetching", "B") as report:
        paths = fetch_archive(
            entries[name],
            out,
            mirrors=mirror or None,
            progress=report,
            say=lambda line: typer.echo(line, err=True),
        )
    for path in paths:
        typer.echo(f"{path}: {entries[name].scenes[path.stem]} states")
