"""A scene from Matterport3D: the connectivity graph of Room-to-Room, panoramas by the Matterport3D Simulator.

    python examples/sources/matterport.py 17DRP5sb8fy connectivity/ house.h5

``connectivity/SCAN_connectivity.json`` comes with https://github.com/peteanderson80/Matterport3DSimulator;
the pictures need its module MatterSim and the dataset. A state is a viewpoint and one of twelve headings;
forward leads to the viewpoint nearest to the middle of the picture, within half a turn, with the same
heading. The test of this file has a graph of its own and a stand-in for the simulator.
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np

from vusfa.scenes import Scene
from vusfa.scenes.graph import default_actions
from vusfa.scenes.provenance import Provenance, today
from vusfa.sources.capture import PoseGraph, capture

TURN = 30.0  # degrees, the simulator's discrete headings


def read_graph(file: Path) -> tuple[list[str], PoseGraph]:
    """Names of the included viewpoints, and the graph of all their headings."""
    entries = json.loads(file.read_text(encoding="utf-8"))
    kept = [number for number, entry in enumerate(entries) if entry["included"]]
    place = np.array([np.array(entries[number]["pose"]).reshape(4, 4)[:2, 3] for number in kept])  # z is up
    clear = np.array([[entries[a]["unobstructed"][b] for b in kept] for a in kept])
    headings = np.arange(0, 360, TURN)
    turns = len(headings)
    graph = np.full((len(kept) * turns, 4), -1)
    for here in range(len(kept)):
        offset = place - place[here]
        bearing = np.degrees(np.arctan2(offset[:, 0], offset[:, 1]))  # 0 along +y, clockwise
        for number, heading in enumerate(headings):
            state = here * turns + number
            graph[state, 1] = here * turns + (number + 1) % turns  # RotateRight
            graph[state, 2] = here * turns + (number - 1) % turns  # RotateLeft
            for action, ahead in ((0, heading), (3, heading + 180)):  # MoveForward, MoveBackward
                off = np.abs((bearing - ahead + 180) % 360 - 180)
                off[~clear[here] | (np.arange(len(kept)) == here)] = np.inf
                if off.min() <= TURN / 2:
                    graph[state, action] = int(off.argmin()) * turns + number
    location, rotation = np.repeat(place, turns, axis=0), np.tile(headings, len(kept))
    return [entries[number]["image_id"] for number in kept], PoseGraph(
        graph, location, rotation, default_actions(4)
    )


def seen(simulator: Any, scan: str, viewpoints: list[str]) -> np.ndarray:
    """Pictures (N, H, W, 3) uint8 of every viewpoint in every heading."""
    pictures = []
    for viewpoint in viewpoints:
        for heading in np.arange(0, 360, TURN):
            simulator.newEpisode([scan], [viewpoint], [math.radians(heading)], [0.0])
            pictures.append(np.array(simulator.getState()[0].rgb)[..., ::-1])  # the simulator's are BGR
    return np.stack(pictures)


def export(simulator: Any, scan: str, connectivity: Path, target: Path, **options: Any) -> Scene:
    """Write the scene of a scan; ``options`` are those of ``capture``, such as a backbone."""
    viewpoints, states = read_graph(connectivity / f"{scan}_connectivity.json")
    origin = Provenance(
        made_with="Matterport3DSimulator", made_on=today(), licences=("Matterport3D Terms of Use",)
    )
    return capture(target, scan, states, seen(simulator, scan, viewpoints), origin, **options)


def open_simulator(connectivity: Path, width: int = 400, height: int = 300) -> Any:
    """The simulator with discrete headings."""
    import MatterSim

    simulator = MatterSim.Simulator()
    simulator.setNavGraphPath(str(connectivity))
    simulator.setCameraResolution(width, height)
    simulator.setCameraVFOV(math.radians(60))
    simulator.setDiscretizedViewingAngles(True)
    simulator.initialize()
    return simulator


if __name__ == "__main__":
    scan, connectivity, target = sys.argv[1:4]
    house = export(open_simulator(Path(connectivity)), scan, Path(connectivity), Path(target))
    print(f"{target}: {house.num_states} states; next: vusfa scenes show {target}")
