"""A scene from a live AI2-THOR 5 simulator: every reachable pose photographed, every action tried.

:func:`export` needs only a controller that answers ``step(action=...)`` with events, as
``ai2thor.controller.Controller`` does (Kolve et al., arXiv 1712.05474); this module does not import ai2thor.
It calls ``GetReachablePositions``, ``Teleport``, ``MoveAhead``, ``RotateRight``, ``RotateLeft`` and
``MoveBack``, and reads ``event.frame`` and, of ``event.metadata``, ``lastActionSuccess``, ``actionReturn``,
``errorMessage`` and ``agent``. AI2-THOR's build cannot be had everywhere: this package's tests drive the
exporter with a stand-in controller that serves a bundled room through the same calls, and with another live
simulator that answers them (:class:`vusfa.sources.miniworld.MiniWorldController`), not with AI2-THOR itself.

The graph is measured, not derived from geometry: from every pose each action is taken once, and leads
to the pose where the agent was found afterwards. The simulator's list of reachable positions is not trusted
either: a place where it refuses to put the agent in any heading is left out.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from vusfa.errors import SceneError
from vusfa.scenes.provenance import Provenance, this_tool, today
from vusfa.scenes.scene import Scene
from vusfa.sources.backbones import DEFAULT, Backbone, load_backbone
from vusfa.sources.capture import PoseGraph, capture
from vusfa.sources.row_log import RowLog

__all__ = ["ACTIONS", "HEADINGS", "Controller", "export", "successors"]

#: The dump's actions, in the THOR v1 order, and what the simulator calls them.
ACTIONS = {
    "MoveForward": "MoveAhead",
    "RotateRight": "RotateRight",
    "RotateLeft": "RotateLeft",
    "MoveBackward": "MoveBack",
}
#: Degrees; 0 looks along +Z, 90 along +X, as the simulator has it.
HEADINGS = (0.0, 90.0, 180.0, 270.0)

_TURN = 2.0  # degrees by which a heading may be off


class Controller(Protocol):
    """The part of a simulator that the export needs."""

    def step(self, *, action: str, **arguments: Any) -> Any:
        """Take an action; an event with ``metadata`` and ``frame`` (H, W, 3) uint8."""


def export(
    controller: Controller,
    target: str | os.PathLike[str],
    *,
    name: str,
    step: float = 0.5,
    horizon: float = 0.0,
    backbone: str | Backbone = DEFAULT,
    batch: int = 32,
    attributes: Mapping[str, Any] | None = None,
    versions: Mapping[str, str] | None = None,
    origin: Provenance | None = None,
    visited: Callable[[int, int], None] | None = None,
    encoded: Callable[[int, int], None] | None = None,
) -> Scene:
    """Write a scene file of the room that a controller stands in, atomically.

    Every pose is kept in ``.NAME.export`` beside the target as soon as it is done; stopped at any moment, the
    export goes on where it was when it is called again with a controller in the same room.

    Args:
        controller: just after its reset, with ``gridSize=step`` and ``snapToGrid=True``.
        target: file to write.
        name: the scene's name.
        step: metres between places.
        horizon: degrees that the camera looks down.
        backbone: a network of :func:`vusfa.sources.backbones.load_backbone`, or its name.
        batch: pictures that are encoded at a time.
        attributes: further attributes on the origin.
        versions: of the simulator, for ``made_with``; with others, an export begins anew.
        origin: of another simulator's scene; AI2-THOR's by default.
        visited: called with poses visited and poses in all.
        encoded: called with pictures encoded and pictures in all.

    Raises:
        SceneError: the simulator fails, or no place can be stood at; what is done is kept.
    """
    target = Path(target)
    network = load_backbone(backbone) if isinstance(backbone, str) else backbone
    places, shape = _places(controller)
    poses = [(place, heading) for place in places for heading in HEADINGS]
    row = np.dtype([("stood", "?"), ("frame", "u1", shape), ("landing", "<f8", (len(ACTIONS), 4))])
    work: dict[str, Any] = {"scene": name, "step": step, "horizon": horizon, "places": places}
    work["more"] = [dict(attributes or {}), dict(versions or {})]
    log = RowLog(target.with_name(f".{target.name}.export"), work, row)
    report = visited or (lambda done, total: None)
    report(len(log), len(poses))
    for place, heading in poses[len(log) :]:
        record = np.zeros(1, row)
        record[0] = _visit(controller, place, heading, step, horizon, shape)
        log.append(record)
        report(len(log), len(poses))

    at_all_headings = _column(log, "stood").reshape(len(places), len(HEADINGS)).all(axis=1)
    rows = np.flatnonzero(np.repeat(at_all_headings, len(HEADINGS)))
    if not len(rows):
        raise SceneError(f"scene {name!r}: the simulator let the agent stand nowhere; check step ({step} m)")
    location = np.array([[poses[r][0]["x"], poses[r][0]["z"]] for r in rows], dtype=np.float64)
    rotation = np.array([poses[r][1] for r in rows])
    graph, astray = successors(location, rotation, _column(log, "landing")[rows], step)
    scene = capture(
        target,
        name,
        PoseGraph(graph, location, rotation, tuple(ACTIONS)),
        lambda first, last: np.concatenate([log.read(r, r + 1)["frame"] for r in rows[first:last]]),
        origin
        or Provenance(
            made_with=this_tool("scenes export-thor", **(versions or {})),
            made_on=today(),
            licences=("AI2-THOR: Apache License 2.0",),
            credits=("AI2-THOR, Kolve et al., arXiv 1712.05474",),
        ),
        attributes={
            **(attributes or {}),
            "cell_m": step,
            "horizon_deg": horizon,
            "frame": "location=(X right, Z forward); heading 0 = +Z, 90 = +X; RotateRight adds 90",
            "places_left_out": int((~at_all_headings).sum()),
            "moves_astray": astray,
        },
        backbone=network,
        batch=batch,
        progress=encoded,
    )
    log.remove()
    return scene


def _step(controller: Controller, action: str, **arguments: Any) -> Any:
    try:
        return controller.step(action=action, **arguments)
    except Exception as error:  # the simulator's process dies in many ways
        raise SceneError(
            f"the simulator failed at {action} {arguments} ({type(error).__name__}: {error}); start it again:"
            f" the export goes on where it was"
        ) from error


def _places(controller: Controller) -> tuple[list[dict[str, float]], tuple[int, ...]]:
    """Reachable positions in an order that does not depend on the simulator's, and the shape of frames."""
    event = _step(controller, "GetReachablePositions")
    found = event.metadata.get("actionReturn")
    if not event.metadata["lastActionSuccess"] or not found:
        reason = event.metadata.get("errorMessage") or "none found"
        raise SceneError(f"the simulator gives no reachable positions ({reason}); reset it into a scene")
    # Rounded to a tenth of a millimetre: the last digits differ from run to run.
    rounded = [{axis: round(float(place[axis]), 4) + 0.0 for axis in "xyz"} for place in found]
    return sorted(rounded, key=lambda place: (place["x"], place["z"])), np.shape(event.frame)


def _teleport(controller: Controller, place: Mapping[str, float], heading: float, horizon: float) -> Any:
    rotation = {"x": 0.0, "y": heading, "z": 0.0}
    return _step(controller, "Teleport", position=dict(place), rotation=rotation, horizon=horizon)


def _pose(event: Any) -> tuple[float, float, float]:
    agent = event.metadata["agent"]
    return agent["position"]["x"], agent["position"]["z"], agent["rotation"]["y"] % 360


def _off(heading: Any, other: Any) -> Any:
    """Degrees between two headings."""
    return np.abs((heading - other + 180) % 360 - 180)


def _visit(
    controller: Controller,
    place: Mapping[str, float],
    heading: float,
    step: float,
    horizon: float,
    shape: tuple[int, ...],
) -> tuple[bool, np.ndarray, np.ndarray]:
    """One pose: whether the agent could stand there, what it saw, success, x, z, heading of each action."""
    landing = np.zeros((len(ACTIONS), 4))
    event = _teleport(controller, place, heading, horizon)
    frame = np.array(event.frame, dtype=np.uint8)
    if frame.shape != shape:
        raise SceneError(
            f"the simulator's frames change from {shape} to {frame.shape}; leave their size alone"
        )
    x, z, turned = _pose(event)
    # Teleport has been seen to succeed and to leave the agent where it was.
    there = np.hypot(x - place["x"], z - place["z"]) < step / 10 and _off(turned, heading) < _TURN
    if not (event.metadata["lastActionSuccess"] and there):
        return False, frame, landing
    for number, action in enumerate(ACTIONS.values()):
        if number:
            _teleport(controller, place, heading, horizon)
        how_far = {"degrees": 90} if action.startswith("Rotate") else {"moveMagnitude": step}
        event = _step(controller, action, **how_far)
        landing[number] = (event.metadata["lastActionSuccess"], *_pose(event))
    return True, frame, landing


def _column(log: RowLog, name: str) -> np.ndarray:
    """One field of all rows, without having all frames in memory."""
    return np.stack([log.read(row, row + 1)[name][0] for row in range(len(log))])


def successors(
    location: np.ndarray, rotation: np.ndarray, landing: np.ndarray | Sequence[Any], step: float
) -> tuple[np.ndarray, int]:
    """The graph, from where the agent was found after each action.

    Args:
        location: (N, 2) metres.
        rotation: (N,) degrees.
        landing: (N, A, 4), success (0 or 1), x, z and heading after each action.
        step: metres between places; a landing within a quarter of it is at the place.

    Returns:
        graph (N, A) int64, -1 where the action failed, changed nothing, or led astray; and how many went
        astray: succeeded, and ended at no known pose.

    >>> places, headings = np.array([[0.0, 0.0], [0.5, 0.0]]), np.array([90.0, 90.0])
    >>> successors(places, headings, np.array([[[1, 0.5, 0, 90]], [[1, 0.8, 0, 90]]]), 0.5)
    (array([[ 1],
           [-1]]), 1)
    """
    found = np.asarray(landing, dtype=np.float64)
    num_states, num_actions = found.shape[:2]
    graph = np.full((num_states, num_actions), -1, dtype=np.int64)
    astray = 0
    for state, action in np.argwhere(found[:, :, 0] > 0):
        _, x, z, heading = found[state, action]
        distance = np.hypot(location[:, 0] - x, location[:, 1] - z)
        distance[_off(rotation, heading) >= _TURN] = np.inf
        nearest = int(distance.argmin())
        if distance[nearest] >= step / 4:
            astray += 1
        elif nearest != state:
            graph[state, action] = nearest
    return graph, astray
