"""``vusfa scenes export-miniworld``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vusfa.cli.sources import (
    Batch,
    Crops,
    Force,
    Height,
    Layer,
    Network,
    Weights,
    Width,
    check_target,
    say_exported,
)

__all__ = ["register"]


def register(scenes: typer.Typer) -> None:
    """Add the command to ``vusfa scenes``."""
    scenes.command("export-miniworld")(export)


def numbers(words: list[str]) -> dict[str, int | float]:
    """Settings of words such as "size=6".

    Raises:
        ConfigError: a word is no name with a number.

    >>> numbers(["num_rows=3", "room_size=2.5"])
    {'num_rows': 3, 'room_size': 2.5}
    """
    from vusfa.errors import ConfigError

    found: dict[str, int | float] = {}
    for word in words:
        name, _, value = word.partition("=")
        try:
            found[name] = int(value) if value.isdecimal() else float(value)
        except ValueError as error:
            raise ConfigError(f"settings has {word!r}; give NAME=NUMBER, settings=[size=6]") from error
    return found


def export(
    environment: Annotated[
        str, typer.Argument(help="Name of the environment, MiniWorld-FourRooms-v0.", show_default=False)
    ],
    target: Annotated[Path, typer.Argument(help="File to write.", show_default=False)],
    seed: Annotated[
        int, typer.Option(help="Random seed of the environment: the same seed, the same room.")
    ] = 0,
    grid: Annotated[float, typer.Option(min=0.05, help="Metres between places.")] = 0.5,
    width: Width = 200,
    height: Height = 150,
    domain_rand: Annotated[
        bool,
        typer.Option(
            "--domain-rand", help="Let the seed also draw textures, colors, light and the camera's position."
        ),
    ] = False,
    settings: Annotated[
        list[str] | None, typer.Option(help="Settings of the environment, size=6; may be repeated.")
    ] = None,
    backbone: Network = "efficientnet-lite0",
    weights: Weights = None,
    layer: Layer = None,
    crops: Crops = None,
    batch: Batch = 32,
    force: Force = False,
) -> None:
    """Make a scene from a live MiniWorld simulator (`pip install 'vusfa[miniworld]'`).

    Every reachable place is photographed in four headings, and every action is tried from every pose. The
    simulator renders without a display, with EGL and Mesa (Debian: libegl1 libgl1 libglu1-mesa
    libfontconfig1). The goal of its task is a piece of furniture here. If stopped, it resumes when the same
    command is given again.

    Examples:

        vusfa scenes export-miniworld MiniWorld-FourRooms-v0 four_rooms.h5 seed=3

        vusfa scenes export-miniworld MiniWorld-Maze-v0 maze.h5 settings=[num_rows=4,num_cols=4] grid=1

        vusfa scenes export-miniworld MiniWorld-RoomObjects-v0 objects.h5 domain_rand=true
    """
    from vusfa.cli.resumed import resumed
    from vusfa.sources.backbones import load_backbone
    from vusfa.sources.miniworld import export_miniworld, open_miniworld

    check_target(target, force)
    network = load_backbone(backbone, weights=weights, layer=layer, crops=crops)
    env = open_miniworld(
        environment, seed=seed, width=width, height=height, domain_rand=domain_rand, **numbers(settings or [])
    )
    with resumed("visiting", "poses") as visited, resumed("encoding", "pictures") as encoded:
        room = export_miniworld(
            env, target, grid=grid, backbone=network, batch=batch, visited=visited, encoded=encoded
        )
    if cut_off := room.attributes["places_cut_off"]:
        typer.echo(f"{cut_off} places that no move on this grid leads to are not in it", err=True)
    say_exported(room, target)
