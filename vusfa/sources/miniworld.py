"""Scenes from MiniWorld, a live simulator, by the exporter of :mod:`vusfa.sources.thor`.

MiniWorld (Chevalier-Boisvert et al., arXiv 2306.13831) is the Farama Foundation's simulator of rooms, mazes
and objects. It renders with OpenGL, here through EGL, without a display. :class:`MiniWorldController` answers
the calls of AI2-THOR's controller, so that one exporter serves both.

The goal of a task, such as a red box, stays where the seed has put it, as do all objects: in a scene every
state can be a goal, and the box is furniture. It blocks the way, and it tells apart what would look the same
in an empty room. Rewards, terminations and step limits of the task are ignored.

At 0 degrees MiniWorld looks along +X, with its +z to the right, and it counts angles to the left. A scene's
frame is AI2-THOR's: its +Z is MiniWorld's -z, and its heading 0, along +Z, is MiniWorld's 90 degrees.
"""

from __future__ import annotations

import contextlib
import io
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from vusfa.errors import ConfigError, SceneError, near
from vusfa.limits import MAX_STATES, brief, listing, one_line
from vusfa.scenes.graph import strong_components
from vusfa.scenes.provenance import Provenance, this_tool, today
from vusfa.scenes.scene import Scene
from vusfa.sources.thor import HEADINGS, export

__all__ = ["Event", "MiniWorldController", "export_miniworld", "find_miniworld", "open_miniworld"]

_EDGE = 1e-6  # metres by which a place may lie outside a room


@dataclass(frozen=True)
class Event:
    """What a step answers, as AI2-THOR's events do; ``render`` draws the frame.

    >>> Event({"lastActionSuccess": True}, lambda: np.zeros((60, 80, 3), np.uint8)).frame.shape
    (60, 80, 3)
    """

    metadata: dict[str, Any]
    render: Callable[[], np.ndarray]

    @property
    def frame(self) -> np.ndarray:
        """What the agent saw, (H, W, 3) uint8; rendered when it is asked for."""
        return self.render()


class MiniWorldController:
    """A MiniWorld environment that answers the calls of AI2-THOR's controller.

    Places are the multiples of ``grid`` at which the agent, a cylinder, touches no wall and no object. Of
    these the largest part is reachable in which moves of one grid step lead from every place to every other.
    Moves are the environment's own, ``move_agent`` and ``turn_agent``. A move goes in steps no longer than
    the environment's, which find a wall between two places; one that cannot be finished is taken back, as in
    AI2-THOR.

    MiniWorld keeps what it draws in one OpenGL list per process: be done with an environment before you make
    another.

    Args:
        env: a ``MiniWorldEnv``, reset.
        grid: metres between places.

    Raises:
        SceneError: no two places are connected, or the grid has more places than a scene may have.
    """

    def __init__(self, env: Any, grid: float = 0.5) -> None:
        self.env, self.grid = env, grid
        if not grid > 0:
            raise SceneError(f"a grid of {grid} m; it must be above 0")
        if len(HEADINGS) * sum(float(room.area) for room in env.rooms) > MAX_STATES * grid**2:
            raise SceneError(f"a grid of {grid} m makes over {MAX_STATES:,} states; take a longer one")
        cells = self._free_cells()
        connected = strong_components(self._neighbors(cells))[0] if cells else ()
        if len(connected) < 2:
            raise SceneError(
                f"a grid of {grid} m has no two places that a move connects (places where the agent can"
                f" stand: {len(cells)}); take a shorter one"
            )
        #: How many free places are not reachable.
        self.cut_off = len(cells) - len(connected)
        self._places = [self._at(cells[number]) for number in connected]

    def _at(self, cell: tuple[int, int]) -> dict[str, float]:
        return {"x": cell[0] * self.grid, "y": float(self.env.agent.pos[1]), "z": cell[1] * self.grid}

    def _free_cells(self) -> list[tuple[int, int]]:
        """Multiples of the grid, in the scene's frame, where the agent can stand."""
        env, grid = self.env, self.grid
        columns = range(math.ceil(env.min_x / grid), math.floor(env.max_x / grid) + 1)
        rows = range(math.ceil(-env.max_z / grid), math.floor(-env.min_z / grid) + 1)
        return [(i, j) for i in columns for j in rows if self._is_free(self._at((i, j)))]

    def _is_free(self, place: Mapping[str, float]) -> bool:
        env, (x, z) = self.env, (place["x"], -place["z"])
        point = np.array([x, 0.0, z])
        # Not by Room.point_inside, for which the edge that two rooms share is outside both.
        on_floor = any(
            room.min_x - _EDGE <= x <= room.max_x + _EDGE
            and room.min_z - _EDGE <= z <= room.max_z + _EDGE
            and ((point - room.outline) * room.edge_norms).sum(1).min() >= -_EDGE
            for room in env.rooms
        )
        return on_floor and not env.intersect(env.agent, point, env.agent.radius)

    def _neighbors(self, cells: list[tuple[int, int]]) -> np.ndarray:
        """(N, 4) the number of the cell that a move in each heading leads to, -1 without one."""
        number = {cell: place for place, cell in enumerate(cells)}
        graph = np.full((len(cells), len(HEADINGS)), -1)
        for place, (i, j) in enumerate(cells):
            for column, ahead in enumerate([(i, j + 1), (i + 1, j), (i, j - 1), (i - 1, j)]):
                if ahead in number and self._teleport(self._at((i, j)), {"y": HEADINGS[column]}):
                    graph[place, column] = number[ahead] if self._move(self.grid) else -1
        return graph

    def step(self, *, action: str, **arguments: Any) -> Event:
        """Take an action of :data:`vusfa.sources.thor.ACTIONS`, ``Teleport`` or ``GetReachablePositions``.

        Raises:
            ValueError: there is no such action.
        """
        places, success = None, True
        if action == "GetReachablePositions":
            places = self._places
        elif action == "Teleport":
            success = self._teleport(**arguments)
        elif action in ("MoveAhead", "MoveBack"):
            success = self._move(arguments["moveMagnitude"] * (1 if action == "MoveAhead" else -1))
        elif action in ("RotateLeft", "RotateRight"):
            success = self.env.turn_agent(arguments["degrees"] * (1 if action == "RotateLeft" else -1))
        else:
            raise ValueError(f"no action is called {action!r}")
        agent = self.env.agent
        x, y, z = map(float, agent.pos)
        metadata = {
            "lastActionSuccess": success,
            "actionReturn": places,
            "errorMessage": "" if success else f"{action} is blocked",
            "agent": {
                "position": {"x": x, "y": y, "z": -z},
                "rotation": {"x": 0.0, "y": (90 - math.degrees(agent.dir)) % 360, "z": 0.0},
            },
        }
        seen_from = (agent.pos, agent.dir, agent.cam_pitch)
        return Event(metadata, lambda: self._render(*seen_from))

    def _teleport(
        self, position: Mapping[str, float], rotation: Mapping[str, float], horizon: float | None = None
    ) -> bool:
        if not self._is_free(position):
            return False
        agent = self.env.agent
        agent.pos = np.array([position["x"], position["y"], -position["z"]])
        agent.dir = math.radians(90 - rotation["y"])
        if horizon is not None:
            agent.cam_pitch = -horizon
        return True

    def _move(self, metres: float) -> bool:
        agent = self.env.agent
        start, steps = agent.pos, math.ceil(abs(metres) / self.env.max_forward_step)
        if all(self.env.move_agent(metres / steps, 0.0) for _ in range(steps)):
            return True
        agent.pos = start
        return False

    def _render(self, *pose: Any) -> np.ndarray:
        agent = self.env.agent
        now = (agent.pos, agent.dir, agent.cam_pitch)
        agent.pos, agent.dir, agent.cam_pitch = pose
        frame = self.env.render_obs()
        agent.pos, agent.dir, agent.cam_pitch = now
        return frame


def find_miniworld() -> list[str]:
    """Import MiniWorld so that it renders without a display, and list its environments.

    Raises:
        ConfigError: a package is missing, or OpenGL does not work without a display.
    """
    try:
        import pyglet

        pyglet.options["headless"] = True
        import_module("miniworld.envs")
        import_module("pyglet.font").load("Arial")  # MiniWorld prepares a line of text
    except ModuleNotFoundError as error:
        raise ConfigError("MiniWorld is missing: pip install 'vusfa[miniworld]'") from error
    except Exception as error:  # pyglet looks for libraries and makes an OpenGL context when it is imported
        raise ConfigError(
            f"MiniWorld cannot render without a display ({type(error).__name__}: {one_line(error)}); install"
            f" EGL and Mesa: apt-get install libegl1 libgl1 libglu1-mesa libfontconfig1"
        ) from error
    return sorted(name for name in gymnasium.registry if name.startswith("MiniWorld-"))


def open_miniworld(
    environment: str,
    *,
    seed: int = 0,
    width: int = 200,
    height: int = 150,
    domain_rand: bool = False,
    **settings: Any,
) -> Any:
    """Make an environment of MiniWorld that renders without a display, and reset it.

    Args:
        environment: a name that Gymnasium knows, ``MiniWorld-FourRooms-v0``.
        seed: random seed of the rooms and of where the objects are.
        width: of the pictures, pixels.
        height: of the pictures.
        domain_rand: whether the seed also draws textures, colors, light, and the camera's height, pitch and
            field of view (MiniWorld's domain randomization), once for all pictures.
        settings: of the environment, such as ``size`` or ``num_rows``.

    Returns:
        the ``MiniWorldEnv``.

    Raises:
        ConfigError: as :func:`find_miniworld`; or there is no such environment, or it refuses the settings.
    """
    names = find_miniworld()
    if environment not in names:
        mend = near(environment, names, f"there are {listing(names, 8)}")
        raise ConfigError(f"no environment of MiniWorld is called {brief(environment)}; {mend}")
    if domain_rand:
        settings = {**settings, "domain_rand": True}
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # on which MiniWorld says how it antialiases
            env = gymnasium.make(
                environment, disable_env_checker=True, obs_width=width, obs_height=height, **settings
            ).unwrapped
    except (AssertionError, RecursionError, TypeError, ValueError) as error:
        raise ConfigError(
            f"{environment} does not take the settings {brief(settings)}"
            f" ({type(error).__name__}: {one_line(error)}); correct them"
        ) from error
    env.reset(seed=seed)
    return env


def export_miniworld(env: Any, target: str | os.PathLike[str], *, grid: float = 0.5, **options: Any) -> Scene:
    """Write a scene file of an environment of MiniWorld, named as the file; resumes as ``export`` does.

    Args:
        env: of :func:`open_miniworld`, or a ``MiniWorldEnv`` of your own, reset with a seed.
        target: file to write.
        grid: metres between places.
        options: ``backbone``, ``batch``, ``visited`` and ``encoded`` of :func:`vusfa.sources.thor.export`.

    Raises:
        SceneError: the grid does not suit the room, or the export fails; what is done is kept.
    """
    from pyglet.gl import gl_info

    controller = MiniWorldController(env, grid)
    versions = {name: version(name) for name in ("miniworld", "pyglet")}
    settings = {} if env.spec is None else env.spec.kwargs
    return export(
        controller,
        target,
        name=Path(target).stem,
        step=grid,
        horizon=0.0 - float(env.agent.cam_pitch),
        attributes={
            "environment": type(env).__name__ if env.spec is None else env.spec.id,
            "simulator_settings": [f"{key}={value}" for key, value in settings.items()],
            "field_of_view": float(env.agent.cam_fov_y),
            "renderer": f"{gl_info.get_renderer()}, OpenGL {gl_info.get_version()}",
            "places_cut_off": controller.cut_off,
        },
        versions=versions,
        origin=Provenance(
            made_with=this_tool("scenes export-miniworld", **versions),
            made_on=today(),
            seed=env.np_random_seed,
            licences=("MiniWorld: Apache License 2.0",),
            credits=("MiniWorld, Chevalier-Boisvert et al., arXiv 2306.13831",),
        ),
        **options,
    )
