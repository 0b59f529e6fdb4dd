"""A scene from Habitat: places on the navigation mesh, pictures by its renderer.

    python examples/sources/habitat.py apartment_1.glb apartment.h5

Needs habitat-sim (https://github.com/facebookresearch/habitat-sim) and a scene of its own. This file uses of
the simulator its path finder (``get_bounds``, ``snap_point``, ``try_step``), ``agents[0].set_state`` and
``get_sensor_observations``; the test of this file runs it with a stand-in that answers these.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import numpy as np

from vusfa.scenes import Scene
from vusfa.scenes.graph import default_actions
from vusfa.scenes.provenance import Provenance, today
from vusfa.sources.capture import PoseGraph, capture
from vusfa.sources.thor import HEADINGS, successors

AHEAD = {0.0: (0, -1), 90.0: (1, 0), 180.0: (0, 1), 270.0: (-1, 0)}  # x and z of Habitat, whose -z is ahead


def free_places(finder: Any, height: float, step: float) -> np.ndarray:
    """Points (P, 3) of a grid where the agent can stand, on the floor at a height."""
    low, high = np.asarray(finder.get_bounds())
    grid = np.stack(np.meshgrid(np.arange(low[0], high[0], step), np.arange(low[2], high[2], step)), -1)
    places = []
    for x, z in grid.reshape(-1, 2):
        point = np.array([x, height, z], np.float32)
        off = np.asarray(finder.snap_point(point)) - point  # NaN where the mesh is nowhere near
        if np.hypot(off[0], off[2]) < step / 10 and abs(off[1]) < step:
            places.append(point + off)
    return np.array(places)


def walked(finder: Any, places: np.ndarray, step: float) -> PoseGraph:
    """All places in four headings; a move leads where the mesh lets the agent slide, if a place is there."""
    poses = [(place, heading) for place in places for heading in HEADINGS]
    location = np.array([[place[0], -place[2]] for place, _ in poses])  # ours has +z ahead
    rotation = np.array([heading for _, heading in poses])
    landing = np.zeros((len(poses), 4, 4))
    for state, (place, heading) in enumerate(poses):
        for action, sign in ((0, 1), (3, -1)):
            x, z = AHEAD[heading]
            end = finder.try_step(place, place + sign * step * np.array([x, 0, z], np.float32))
            landing[state, action] = 1, end[0], -end[2], heading
        for action, turn in ((1, 90), (2, -90)):
            landing[state, action] = 1, *location[state], (heading + turn) % 360
    graph, _ = successors(location, rotation, landing, step)
    return PoseGraph(graph, location, rotation, default_actions(4))


def seen(simulator: Any, places: np.ndarray, sensor: str = "color_sensor") -> np.ndarray:
    """Pictures (N, H, W, 3) uint8 of every place in every heading."""
    pictures = []
    for place in places:
        for heading in HEADINGS:
            half = -math.radians(heading) / 2  # counterclockwise, seen from above
            rotation = [0.0, math.sin(half), 0.0, math.cos(half)]  # x, y, z, w
            state = simulator.agents[0].get_state()
            state.position, state.rotation = place, np.array(rotation)
            simulator.agents[0].set_state(state)
            pictures.append(np.array(simulator.get_sensor_observations()[sensor])[..., :3])
    return np.stack(pictures)


def export(simulator: Any, target: Path, step: float = 0.5, **options: Any) -> Scene:
    """Write the scene that a simulator has open; ``options`` are those of ``capture``, such as a backbone."""
    height = float(simulator.agents[0].get_state().position[1])
    places = free_places(simulator.pathfinder, height, step)
    states = walked(simulator.pathfinder, places, step)
    origin = Provenance(made_with="habitat-sim", made_on=today())
    return capture(target, target.stem, states, seen(simulator, places), origin, **options)


def open_simulator(file: str, width: int = 400, height: int = 300) -> Any:
    """A simulator with one color camera at eye height."""
    import habitat_sim

    camera = habitat_sim.CameraSensorSpec()
    camera.uuid, camera.resolution, camera.position = "color_sensor", [height, width], [0.0, 1.5, 0.0]
    scene = habitat_sim.SimulatorConfiguration()
    scene.scene_id = file
    agent = habitat_sim.agent.AgentConfiguration(sensor_specifications=[camera])
    return habitat_sim.Simulator(habitat_sim.Configuration(scene, [agent]))


if __name__ == "__main__":
    file, target = sys.argv[1:3]
    room = export(open_simulator(file), Path(target))
    print(f"{target}: {room.num_states} states; next: vusfa scenes show {target}")
