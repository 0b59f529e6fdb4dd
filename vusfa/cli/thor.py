"""``vusfa scenes export-thor``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

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
    scenes.command("export-thor")(export_thor)


def export_thor(
    scene: Annotated[
        str,
        typer.Argument(
            help="The simulator's scene, FloorPlan212, or a ProcTHOR house, a .json file.", show_default=False
        ),
    ],
    target: Annotated[Path, typer.Argument(help="File to write.", show_default=False)],
    grid: Annotated[float, typer.Option(min=0.05, help="Metres between places.")] = 0.5,
    width: Width = 400,
    height: Height = 300,
    field_of_view: Annotated[float, typer.Option(help="Vertical field of view in degrees.")] = 90,
    horizon: Annotated[float, typer.Option(help="Degrees by which the camera points down.")] = 0,
    headless: Annotated[
        bool, typer.Option("--headless", help="Render without a display (the simulator's CloudRendering).")
    ] = False,
    backbone: Network = "efficientnet-lite0",
    weights: Weights = None,
    layer: Layer = None,
    crops: Crops = None,
    batch: Batch = 32,
    force: Force = False,
) -> None:
    """Make a scene from a live AI2-THOR 5 simulator (`pip install 'vusfa[thor]'`).

    Every reachable place is photographed in four headings, and every action is tried from every pose.
    If stopped, it resumes when the same command is given again. This command is tested with a
    stand-in for the simulator that answers the same calls: its build is not available everywhere.

    Examples:

        vusfa scenes export-thor FloorPlan212 living_room.h5

        vusfa scenes export-thor FloorPlan401 bathroom.h5 --grid 0.25 --headless

        vusfa scenes export-thor house.json house.h5
    """
    from vusfa.cli.resumed import resumed
    from vusfa.errors import ConfigError
    from vusfa.sources.backbones import load_backbone
    from vusfa.sources.thor import export

    check_target(target, force)
    house = _house(scene)
    network = load_backbone(backbone, weights=weights, layer=layer, crops=crops)
    try:
        from ai2thor import __version__ as version
        from ai2thor.controller import Controller
        from ai2thor.platform import CloudRendering
    except ModuleNotFoundError as error:
        raise ConfigError("AI2-THOR is missing: pip install 'vusfa[thor]'") from error
    settings = {"fieldOfView": field_of_view, "gridSize": grid, "width": width, "height": height}
    platform = {"platform": CloudRendering} if headless else {}
    controller = Controller(
        scene=house or scene, snapToGrid=True, rotateStepDegrees=90, **settings, **platform
    )
    try:
        with resumed("visiting", "poses") as visited, resumed("encoding", "pictures") as encoded:
            room = export(
                controller,
                target,
                name=scene if house is None else Path(scene).stem,
                step=grid,
                horizon=horizon,
                backbone=network,
                batch=batch,
                attributes={"simulator_settings": [f"{key}={value}" for key, value in settings.items()]},
                versions={"ai2thor": version},
                visited=visited,
                encoded=encoded,
            )
    finally:
        controller.stop()
    say_exported(room, target)


def _house(scene: str) -> dict[str, Any] | None:
    """The house in a file of ProcTHOR's JSON; None where the scene is a name."""
    if not scene.endswith(".json"):
        return None
    from vusfa.errors import SceneError
    from vusfa.reading import read_json

    mend = "give the JSON object of one house"
    house = read_json(scene, SceneError, mend)
    missing = [key for key in ("rooms", "walls", "metadata") if key not in house]
    if missing:
        raise SceneError(f"{scene}: no ProcTHOR house ({missing[0]!r} is missing); {mend}")
    return house
