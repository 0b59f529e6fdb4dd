"""A new source of scenes in one file: a grid world, drawn with Pillow.

    python examples/extending/scene_source.py grid-world maze.h5 --columns 6 --rows 4
    vusfa scenes check maze.h5

A source gives the states, the successors of the actions and a picture per state;
:func:`vusfa.sources.capture.capture` does the rest: features, provenance, checks, the file.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from PIL import Image, ImageDraw

from vusfa.cli import COMMANDS, main
from vusfa.scenes.graph import default_actions
from vusfa.scenes.provenance import Provenance, this_tool, today
from vusfa.sources.capture import PoseGraph, capture

HEADINGS = [(0, 1), (1, 0), (0, -1), (-1, 0)]  # +Z, +X, -Z, -X: one step ahead, clockwise


def build(columns: int, rows: int) -> PoseGraph:
    """All cells in four headings, with a wall around the room and a pillar in every second cell."""
    cells = [(x, z) for x in range(columns) for z in range(rows) if not (x % 2 and z % 2)]
    state = {(x, z, h): 4 * i + h for i, (x, z) in enumerate(cells) for h in range(4)}
    graph = np.full((len(state), 4), -1)
    for (x, z, h), index in state.items():
        dx, dz = HEADINGS[h]
        graph[index, 0] = state.get((x + dx, z + dz, h), -1)  # MoveForward
        graph[index, 1] = state[x, z, (h + 1) % 4]  # RotateRight
        graph[index, 2] = state[x, z, (h - 1) % 4]  # RotateLeft
        graph[index, 3] = state.get((x - dx, z - dz, h), -1)  # MoveBackward
    location = np.repeat(np.array(cells, dtype=np.float64), 4, axis=0)
    return PoseGraph(graph, location, np.tile([0.0, 90.0, 180.0, 270.0], len(cells)), default_actions(4))


def draw(states: PoseGraph, size: int = 64) -> np.ndarray:
    """Draw a corridor as deep as the free way ahead, colored by place; (N, H, W, 3) uint8."""
    extent = np.maximum(states.location.max(0), 1)
    pictures = []
    for index, (place, heading) in enumerate(zip(states.location, states.rotation, strict=True)):
        red, green = (int(value) for value in 255 * place / extent)
        image = Image.new("RGB", (size, size), (red, green, int(heading) // 2))
        free, ahead = 0, states.graph[index, 0]
        while ahead >= 0:
            free, ahead = free + 1, states.graph[ahead, 0]
        margin = size // 2 - size // (2 * (free + 2))
        box = (margin, margin, size - margin, size - margin)
        ImageDraw.Draw(image).rectangle(box, fill=(255 - red, 255 - green, 90), outline="white")
        pictures.append(np.asarray(image))
    return np.stack(pictures)


def grid_world(
    target: Annotated[Path, typer.Argument(help="File to write.", show_default=False)],
    columns: Annotated[int, typer.Option(min=1, help="Cells along X.")] = 5,
    rows: Annotated[int, typer.Option(min=1, help="Cells along Z.")] = 5,
) -> None:
    """Make a scene of a drawn grid world."""
    states = build(columns, rows)
    origin = Provenance(made_with=this_tool("scenes grid-world"), made_on=today())
    scene = capture(target, target.stem, states, draw(states), origin, attributes={"cell_m": 1.0})
    typer.echo(f"{target}: {scene.num_states} states")


def register(scenes: typer.Typer) -> None:
    """Add the command to ``vusfa scenes``."""
    scenes.command("grid-world")(grid_world)


COMMANDS.append(__name__)  # the registry line; to stay: the module's name in vusfa/cli/__init__.py

if __name__ == "__main__":
    main(["scenes", *sys.argv[1:]])
