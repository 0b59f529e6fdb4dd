"""Validation of a scene's arrays.

Pure functions that return lists of faults, one line per kind: the dataset, the first state concerned, the
number of states, and the remedy. Islands (states that some others cannot reach) are no fault, see
:attr:`vusfa.scenes.Scene.islands`.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from vusfa.errors import SceneError
from vusfa.limits import MAX_FAULTS, MAX_NAME, TABLE_STATES, brief
from vusfa.scenes.graph import shortest_path_distances
from vusfa.scenes.hdf5 import row_blocks

if TYPE_CHECKING:
    from vusfa.scenes.scene import Scene

__all__ = [
    "DATASETS",
    "array_faults",
    "check_alike",
    "check_same_graph",
    "distance_faults",
    "feature_faults",
    "graph_faults",
    "name_faults",
    "pose_faults",
    "raise_faults",
    "shape_fault",
]

#: The datasets of a scene: shape, kinds of dtype, and their name. N states, A actions, C crops, F features.
DATASETS: dict[str, tuple[str, str, str]] = {
    "graph": ("(N, A)", "iu", "integers"),
    "resnet_feature": ("(N, C, F)", "f", "floats"),
    "location": ("(N, 2)", "fiu", "numbers"),
    "rotation": ("(N,)", "fiu", "numbers"),
    "shortest_path_distance": ("(N, N)", "iu", "integers"),
}


def raise_faults(source: str | os.PathLike[str], faults: Sequence[str]) -> None:
    """Raise one SceneError that lists all faults of a scene, if there are any.

    >>> raise_faults("room.h5", ["dataset 'graph' is missing", "dataset 'location' is missing"])
    Traceback (most recent call last):
    ...
    vusfa.errors.SceneError: room.h5: 2 faults
      - dataset 'graph' is missing
      - dataset 'location' is missing
    """
    if len(faults) == 1:
        raise SceneError(f"{source}: {faults[0]}")
    if faults:
        lines = "".join(f"\n  - {fault}" for fault in faults[:MAX_FAULTS])
        if len(faults) > MAX_FAULTS:
            lines += f"\n  - and {len(faults) - MAX_FAULTS} more"
        raise SceneError(f"{source}: {len(faults)} faults{lines}")


def _how_many(count: int) -> str:
    return "" if count == 1 else f" (the first of {count})"


def shape_fault(name: str, values: np.ndarray, num_states: int) -> str | None:
    """Fault of a dataset of :data:`DATASETS` whose dtype or shape does not fit N states; None without one.

    >>> shape_fault("graph", np.zeros((3, 4), np.float32), 3)
    "dataset 'graph' holds float32 of shape (3, 4); write it as integers (N, A)"
    """
    shape, kinds, kinds_name = DATASETS[name]
    fits = values.dtype.kind in kinds and values.ndim == len(shape.strip("()").rstrip(",").split(","))
    if fits and name in ("location", "shortest_path_distance"):
        fits = values.shape[1] == (2 if name == "location" else values.shape[0])
    if not fits or not values.size:
        held = f"holds {values.dtype} of shape {values.shape}" if values.size else f"is empty, {values.shape}"
        return f"dataset {name!r} {held}; write it as {kinds_name} {shape}"
    if len(values) != num_states:
        return (
            f"dataset {name!r} has {len(values)} states, but the graph has {num_states}; write one entry"
            f" per state, {shape}"
        )
    return None


def graph_faults(graph: np.ndarray, actions: Sequence[str] | None = None) -> list[str]:
    """Faults of a graph: successors that are neither a state nor -1, action names that do not fit.

    >>> graph_faults(np.array([[1, -1], [7, 0]]))[0]
    "dataset 'graph', state 1: action 0 leads to 7, but states are 0..1 (-1 is a blocked move); correct it"
    """
    faults = []
    num_states, num_actions = graph.shape
    if actions is not None and len(actions) != num_actions:
        faults.append(
            f"attribute 'actions' names {len(actions)} actions, but dataset 'graph' has {num_actions}"
            f" columns; name every action, or leave the attribute out"
        )
    wrong = np.argwhere((graph < -1) | (graph >= num_states))
    if len(wrong):
        state, action = (int(i) for i in wrong[0])
        faults.append(
            f"dataset 'graph', state {state}{_how_many(len(wrong))}: action {action} leads to"
            f" {graph[state, action]}, but states are 0..{num_states - 1} (-1 is a blocked move); correct it"
        )
    return faults


def feature_faults(features: np.ndarray) -> list[str]:
    """Faults of features: NaN, infinity, or values too large for float32.

    >>> feature_faults(np.array([[[1.0]], [[np.nan]]]))
    ["dataset 'resnet_feature', state 1: crop 0, feature 0 is nan; compute the features of this state again"]
    """
    # A float64 beyond float32's range would become infinite when it is loaded.
    most = np.finfo(np.float32).max
    wrong = [~(np.abs(features[rows]) <= most).all(axis=(1, 2)) for rows in row_blocks(features)]
    states = np.flatnonzero(np.concatenate(wrong))
    if not len(states):
        return []
    state, count = int(states[0]), len(states)
    crop, feature = (int(i) for i in np.argwhere(~(np.abs(features[state]) <= most))[0])
    return [
        f"dataset 'resnet_feature', state {state}{_how_many(count)}: crop {crop}, feature {feature} is"
        f" {features[state, crop, feature]}; compute the features of this state again"
    ]


def pose_faults(name: str, values: np.ndarray) -> list[str]:
    """Faults of locations (metres) or rotations (degrees): NaN or infinity.

    >>> pose_faults("rotation", np.array([0.0, np.nan, np.inf]))
    ["dataset 'rotation', state 1 (the first of 2): nan is not finite; give every state a pose"]
    """
    wrong = np.flatnonzero(~np.isfinite(values.reshape(len(values), -1)).all(axis=1))
    if not len(wrong):
        return []
    state = int(wrong[0])
    return [
        f"dataset {name!r}, state {state}{_how_many(len(wrong))}: {values[state].tolist()} is not finite;"
        f" give every state a pose"
    ]


def distance_faults(graph: np.ndarray, distance: np.ndarray) -> list[str]:
    """Fault of distances: one that differs from a breadth-first search of the graph.

    A table is correct if and only if it has 0 on the diagonal and ``d(s, g) = 1 + min_a d(next(s, a), g)``
    elsewhere (Bellman's equation), which takes a fraction of the time of searches from every state.

    >>> distance_faults(np.array([[1], [-1]]), np.array([[0, 2], [-1, 0]]))[0].split(";")[0]
    "dataset 'shortest_path_distance', state 0 to state 1: 2, but by the graph it is 1"
    """
    suspect = _inconsistent_state(graph, distance)
    if suspect is None:
        return []
    # Either a distance from this state is wrong or one from a state that it leads to.
    for start in [suspect, *graph[suspect][graph[suspect] >= 0].tolist()]:
        found = shortest_path_distances(graph, start)[0].numpy()
        wrong = np.flatnonzero(found != distance[start])
        if len(wrong):
            break
    return [
        f"dataset 'shortest_path_distance', state {start} to state {wrong[0]}: {distance[start, wrong[0]]},"
        f" but by the graph it is {found[wrong[0]]}; correct the graph, or replace the dataset by"
        f" vusfa.scenes.graph.shortest_path_distances(graph)"
    ]


def _inconsistent_state(graph: np.ndarray, distance: np.ndarray) -> int | None:
    """The first state whose distances are out of range or break Bellman's equation."""
    states = np.arange(len(graph))
    successor = np.where(graph < 0, states[:, None], graph)
    block = max(1, (1 << 22) // len(graph))
    for first in range(0, len(graph), block):
        rows = states[first : first + block]
        here = distance[rows]
        off = ((here < -1) | (here >= len(graph))).any(1)
        far = np.iinfo(np.int32).max - 1
        nearest = np.full(here.shape, far, np.int32)
        for action in successor[rows].T:
            after = distance[action].astype(np.int32)
            np.minimum(nearest, np.where(after < 0, far, after), out=nearest)
        expected = np.where(nearest == far, -1, nearest + 1)
        expected[np.arange(len(rows)), rows] = 0
        off |= (expected != here).any(1)
        if off.any():
            return first + int(off.argmax())
    return None


def name_faults(name: object) -> list[str]:
    """The fault of a scene's name, if it has one.

    >>> name_faults("")
    ["attribute 'scene' is ''; give a name of 1 to 200 printable characters"]
    """
    if isinstance(name, str) and 0 < len(name) <= MAX_NAME and name.isprintable():
        return []
    return [f"attribute 'scene' is {brief(name)}; give a name of 1 to {MAX_NAME} printable characters"]


def array_faults(
    arrays: Mapping[str, np.ndarray],
    actions: Sequence[str] | None = None,
    optional: Collection[str] = (),
) -> list[str]:
    """All faults of a scene's arrays at once.

    Args:
        arrays: the datasets of :data:`DATASETS` by name.
        actions: names of the graph's columns, where they are given.
        optional: datasets that may be missing.

    >>> array_faults({"graph": np.zeros((2, 1), int)}, optional=["location", "rotation", "resnet_feature"])
    ["dataset 'shortest_path_distance' is missing; write it as integers (N, N)"]
    """
    faults = []
    sound = {}
    # If the graph is unusable, the first usable dataset gives the number of states.
    num_states = next((len(arrays[name]) for name in DATASETS if name in arrays and arrays[name].ndim), 0)
    for name, (shape, _, kinds_name) in DATASETS.items():
        if name in arrays:
            fault = shape_fault(name, arrays[name], num_states)
            if fault is None:
                sound[name] = arrays[name]
            else:
                faults.append(fault)
        elif name not in optional and not (name == "shortest_path_distance" and num_states > TABLE_STATES):
            faults.append(f"dataset {name!r} is missing; write it as {kinds_name} {shape}")
    if "graph" in sound:
        faults += graph_faults(sound["graph"], actions)
        # A graph that leads out of the room cannot be searched.
        if "shortest_path_distance" in sound and not graph_faults(sound["graph"]):
            faults += distance_faults(sound["graph"], sound["shortest_path_distance"])
    if "resnet_feature" in sound:
        faults += feature_faults(sound["resnet_feature"])
    for name in ("location", "rotation"):
        if name in sound:
            faults += pose_faults(name, sound[name])
    return faults


def check_same_graph(one: Scene, other: Scene) -> None:
    """Check that two scenes have the same states and actions, such as two renderings of a room.

    Raises:
        SceneError: they have not; the message names both files and the first difference.
    """
    if one.actions != other.actions:
        found = f"their actions are {brief(one.actions)} and {brief(other.actions)}"
    elif one.num_states != other.num_states:
        found = f"they have {one.num_states} and {other.num_states} states"
    elif differing := (one.graph != other.graph).nonzero().tolist():
        state, action = differing[0]
        ends = [int(scene.graph[state, action]) for scene in (one, other)]
        found = f"from state {state} action {action} leads to {ends[0]} and to {ends[1]}"
    else:
        return
    places = [f"scene {scene.name!r}" if scene.path is None else scene.path for scene in (one, other)]
    raise SceneError(
        f"{places[0]} and {places[1]} are of different rooms: {found}; give renderings of one room"
    )


def check_alike(scenes: Sequence[Scene]) -> None:
    """Check that scenes can form one set.

    Raises:
        SceneError: two have the same name, or scenes that differ in actions, crops or feature size.
    """
    name, times = Counter(scene.name for scene in scenes).most_common(1)[0]
    if times > 1:
        raise SceneError(f"{times} scenes are called {name!r}; rename all but one (attribute 'scene')")
    first = scenes[0]
    for scene in scenes[1:]:
        for what, of_first, of_this in (
            ("actions", first.actions, scene.actions),
            ("crops", first.num_crops, scene.num_crops),
            ("feature size", first.feature_size, scene.feature_size),
        ):
            if of_first != of_this:
                one, other = (
                    repr(room.name) if room.path is None else f"{room.name!r} ({room.path})"
                    for room in (first, scene)
                )
                raise SceneError(
                    f"scenes {one} and {other} differ in {what} ({of_first}, {of_this});"
                    f" put them in different sets"
                )
