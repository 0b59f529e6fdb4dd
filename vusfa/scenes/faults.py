"""What can be wrong with a scene's numbers, said so that it can be mended.

Pure functions of arrays, each of which gives a list of faults: one line per kind of fault, naming the dataset, the
first state concerned and how many there are. An empty list means that the scene can be used. Islands (states that
some others cannot reach) are no fault; :attr:`vusfa.scenes.Scene.islands` reports them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from vusfa.scenes.graph import shortest_path_distances

__all__ = [
    "DATASETS",
    "array_faults",
    "distance_faults",
    "feature_faults",
    "graph_faults",
    "pose_faults",
    "shape_faults",
]

#: The datasets that a scene must have, with their shapes. N states, A actions, C crops, F features.
DATASETS = {
    "graph": "(N, A)",
    "resnet_feature": "(N, C, F)",
    "location": "(N, 2)",
    "rotation": "(N,)",
    "shortest_path_distance": "(N, N)",
}

_KINDS = {
    "graph": ("iu", "integers"),
    "resnet_feature": ("f", "floats"),
    "location": ("fiu", "numbers"),
    "rotation": ("fiu", "numbers"),
    "shortest_path_distance": ("iu", "integers"),
}


def _how_many(count: int) -> str:
    return "" if count == 1 else f" (the first of {count})"


def shape_faults(shapes: Mapping[str, tuple[int, ...]], dtypes: Mapping[str, np.dtype]) -> list[str]:
    """Datasets that are missing, or have a dtype or a shape that does not fit.

    Args:
        shapes: shape of each dataset there is.
        dtypes: dtype of each dataset there is.

    >>> shape_faults({"graph": (3, 4)}, {"graph": np.dtype("float32")})[0]
    "dataset 'graph' holds float32; write it as integers (N, A)"
    """
    faults = []
    num_states = _number_of_states(shapes)
    for name, wanted in DATASETS.items():
        if name not in shapes:
            faults.append(f"dataset {name!r} is missing; write it as {_KINDS[name][1]} {wanted}")
            continue
        shape = tuple(shapes[name])
        if dtypes[name].kind not in _KINDS[name][0]:
            faults.append(f"dataset {name!r} holds {dtypes[name]}; write it as {_KINDS[name][1]} {wanted}")
        if len(shape) != wanted.count(",") + (not wanted.endswith(",)")):
            faults.append(f"dataset {name!r} has shape {shape}; write it as {wanted}")
        elif 0 in shape:
            faults.append(f"dataset {name!r} has shape {shape}, which is empty; write it as {wanted}")
        elif shape[0] != num_states:
            faults.append(
                f"dataset {name!r} has shape {shape}, of {shape[0]} states where the graph has {num_states};"
                f" write one entry per state, {wanted}"
            )
        elif (name == "location" and shape[1] != 2) or (
            name == "shortest_path_distance" and shape[1] != shape[0]
        ):
            faults.append(f"dataset {name!r} has shape {shape}; write it as {wanted}")
    return faults


def _number_of_states(shapes: Mapping[str, tuple[int, ...]]) -> int | None:
    """As the graph has it, or else the first dataset that can tell."""
    return next((shapes[name][0] for name in DATASETS if name in shapes and shapes[name]), None)


def graph_faults(graph: np.ndarray, actions: Sequence[str] | None = None) -> list[str]:
    """Successors that are neither a state nor -1, and actions that do not fit the columns.

    >>> graph_faults(np.array([[1, -1], [7, 0]]))
    ["dataset 'graph', state 1: action 0 leads to 7, but the states are 0..1 and -1 is a blocked move; correct it"]
    """
    faults = []
    num_states, num_actions = graph.shape
    if actions is not None and len(actions) != num_actions:
        faults.append(
            f"attribute 'actions' names {len(actions)} actions, but dataset 'graph' has {num_actions} columns;"
            f" name every action, or leave the attribute out"
        )
    wrong = np.argwhere((graph < -1) | (graph >= num_states))
    if len(wrong):
        state, action = (int(i) for i in wrong[0])
        faults.append(
            f"dataset 'graph', state {state}{_how_many(len(wrong))}: action {action} leads to {graph[state, action]},"
            f" but the states are 0..{num_states - 1} and -1 is a blocked move; correct it"
        )
    return faults


def feature_faults(features: np.ndarray) -> list[str]:
    """Features that are NaN, infinite, or too large for float32.

    >>> feature_faults(np.array([[[1.0]], [[np.nan]]]))
    ["dataset 'resnet_feature', state 1: crop 0, feature 0 is nan; compute the features of this state again"]
    """
    # A float64 beyond float32's range would become infinite when it is loaded.
    wrong = ~(np.abs(features) <= np.finfo(np.float32).max)
    if not wrong.any():
        return []
    state, crop, feature = (int(i) for i in np.argwhere(wrong)[0])
    count = int(wrong.any(axis=(1, 2)).sum())
    return [
        f"dataset 'resnet_feature', state {state}{_how_many(count)}: crop {crop}, feature {feature} is"
        f" {features[state, crop, feature]}; compute the features of this state again"
    ]


def pose_faults(name: str, values: np.ndarray) -> list[str]:
    """Locations (metres) or rotations (degrees) that are NaN or infinite."""
    wrong = np.flatnonzero(~np.isfinite(values.reshape(len(values), -1)).all(axis=1))
    if not len(wrong):
        return []
    return [
        f"dataset {name!r}, state {wrong[0]}{_how_many(len(wrong))}: {values[wrong[0]].tolist()} is not finite;"
        f" give every state a pose"
    ]


def distance_faults(graph: np.ndarray, distance: np.ndarray) -> list[str]:
    """Distances that disagree with a breadth-first search of the graph.

    >>> graph = np.array([[1], [-1]])
    >>> distance_faults(graph, np.array([[0, 2], [-1, 0]]))[0][:82]
    "dataset 'shortest_path_distance', state 0 to state 1: 2, but the graph's is 1; rep"
    """
    found = shortest_path_distances(graph).numpy()
    wrong = np.argwhere(found != distance)
    if not len(wrong):
        return []
    start, goal = (int(i) for i in wrong[0])
    return [
        f"dataset 'shortest_path_distance', state {start} to state {goal}{_how_many(len(wrong))}:"
        f" {distance[start, goal]}, but the graph's is {found[start, goal]}; replace the dataset by"
        f" vusfa.scenes.graph.shortest_path_distances(graph)"
    ]


def array_faults(arrays: Mapping[str, np.ndarray], actions: Sequence[str] | None = None) -> list[str]:
    """All faults of a scene's arrays at once: shapes first, then the values of those whose shape is right.

    Args:
        arrays: the datasets by their THOR names; some may be missing, which is a fault.
        actions: names of the graph's columns, where they are given.
    """
    faults = shape_faults({k: v.shape for k, v in arrays.items()}, {k: v.dtype for k, v in arrays.items()})
    sound = {name for name in arrays if not any(f"dataset {name!r}" in fault for fault in faults)}
    if "graph" in sound:
        of_graph = graph_faults(arrays["graph"], actions)
        faults += of_graph
        # Without a sound graph there is nothing that the distances could be checked against.
        if "shortest_path_distance" in sound and not any("dataset 'graph'," in f for f in of_graph):
            faults += distance_faults(arrays["graph"], arrays["shortest_path_distance"])
    if "resnet_feature" in sound:
        faults += feature_faults(arrays["resnet_feature"])
    for name in ("location", "rotation"):
        if name in sound:
            faults += pose_faults(name, arrays[name])
    return faults
