"""Common parts of commands that read or write scene files: names, folders, ``--force``."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vusfa.errors import ConfigError, SceneError

if TYPE_CHECKING:
    from vusfa.scenes import Scene

__all__ = [
    "Batch",
    "Crops",
    "Force",
    "Height",
    "Layer",
    "Network",
    "Weights",
    "Width",
    "check_target",
    "has_graph",
    "say_exported",
    "say_next",
    "scene_path",
    "scene_paths",
]

#: The option of commands that write a file.
Force = Annotated[bool, typer.Option("--force", help="Replace the file if it exists.")]
#: Options of commands that compute features.
Network = Annotated[
    str, typer.Option(help="Network that computes the features; see `vusfa scenes encode --help`.")
]
Weights = Annotated[Path | None, typer.Option(help="File of the network's weights.")]
Layer = Annotated[str | None, typer.Option(help="Layer whose output is taken, such as avgpool.")]
Crops = Annotated[str | None, typer.Option(help="whole (squashed), centre, or ten.")]
Batch = Annotated[int, typer.Option(min=1, help="Pictures encoded at a time.")]
#: Options of commands that take pictures in a simulator.
Width = Annotated[int, typer.Option(min=1, help="Width of the pictures in pixels.")]
Height = Annotated[int, typer.Option(min=1, help="Height of the pictures.")]


def check_target(target: Path, force: bool) -> None:
    """Refuse a target file that exists or that cannot be written, before the work begins.

    Raises:
        ConfigError: it exists and ``force`` is not given, or its folder cannot be written.
    """
    from vusfa.files import check_file

    if os.path.isfile(target) and not force:
        raise ConfigError(f"{target}: exists; choose another name, or replace it with --force")
    check_file(target)


def say_next(target: Path) -> None:
    """Print the next commands for a new scene file on standard error."""
    typer.echo(
        f"next: vusfa scenes show {target}; vusfa train preset=replay_search scenes=[{target}]",
        err=True,
    )


def say_exported(scene: Scene, target: Path) -> None:
    """Print what came out of a simulator, and the next commands."""
    left_out, astray = (scene.attributes[key] for key in ("places_left_out", "moves_astray"))
    typer.echo(
        f"{target}: {scene.num_states} states; {left_out} places left out because the agent could not be put"
        f" there, {astray} moves taken for blocked because they ended at no known pose"
    )
    say_next(target)


def scene_path(source: str | Path) -> Path:
    """The file of a scene: a bundled name, or a path.

    Raises:
        SceneError: there is no such scene or file.

    >>> scene_path("kitchen").name, scene_path("rooms/mine.h5").name
    ('kitchen.h5', 'mine.h5')
    """
    from vusfa.scenes import bundled_names
    from vusfa.scenes.store import bundled_path

    path = Path(source)
    if str(source) in bundled_names():
        return bundled_path(str(source))
    if not path.is_file() and not path.suffix:
        raise SceneError(
            f"{str(source)!r} is neither a bundled scene ({', '.join(bundled_names())}) nor a file or folder;"
            f" check the name"
        )
    return path


def scene_paths(sources: Sequence[str]) -> list[Path]:
    """Scene files of names, files, folders and patterns, each once; of a folder's files those with a graph.

    Raises:
        SceneError: a name is unknown, a folder has no scene files, or no file matches a pattern.
    """
    from vusfa.scenes.places import expanded

    return list(dict.fromkeys(map(scene_path, expanded(sources, has_graph))))


def has_graph(path: str | Path) -> bool:
    """Whether an HDF5 file has a scene's graph; true of a damaged file, whose fault is reported later."""
    from vusfa.scenes.hdf5 import opened

    try:
        with opened(Path(path)) as file:
            return file.get("graph", getlink=True) is not None
    except SceneError:
        return True
