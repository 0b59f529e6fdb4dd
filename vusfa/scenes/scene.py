"""One scene: a room as a finite graph of photographed poses.

A state is a pose (a place and a heading) with its picture's features; an action leads to another state or is
blocked. No file stays open: a scene can be pickled, forked and spawned, and pictures are read on request.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from vusfa.errors import SceneError
from vusfa.limits import brief
from vusfa.scenes import store
from vusfa.scenes.arrays import from_arrays, save
from vusfa.scenes.features import FeaturesField, StoredFeatures
from vusfa.scenes.graph import as_states, default_actions, weak_components
from vusfa.scenes.paths import DistanceField, ShortestPaths
from vusfa.scenes.pictures import read_pictures
from vusfa.scenes.validation import array_faults, name_faults, raise_faults

__all__ = ["Scene"]


@dataclass(frozen=True, eq=False, repr=False)
class Scene:
    """A room: its graph, its pictures' features, its poses. All tensors are on the CPU.

    Args:
        name: the scene's name.
        graph: (N, A) integers, next state, -1 = blocked.
        features: (N, C, F) floats, C crops (augmented views) of F features; kept as float32.
        location: (N, 2) metres; zeros when not given.
        rotation: (N,) degrees; zeros when not given.
        distance: (N, N) integers, ``[s, g]`` actions from s to g, -1 = unreachable; checked against the
            graph. When not given, the table is made on request, for at most 16,384 states;
            :meth:`distances_to` needs none.
        actions: A names; those of the THOR v1 dumps when not given and A is 4.
        attributes: provenance: str, int, float, or lists of these.
        path: the file that pictures are read from; None for a scene in memory.
        picture_shape: (H, W, 3) of the pictures in that file; None without pictures.

    Raises:
        SceneError: arguments that do not fit; the message lists every fault.

    >>> corridor = Scene("corridor", torch.tensor([[1, -1], [2, 0], [-1, 1]]), torch.rand(3, 1, 8))
    >>> corridor.distance.tolist()
    [[0, 1, 2], [1, 0, 1], [2, 1, 0]]
    >>> Scene("broken", torch.tensor([[1, -1], [5, 0]]), torch.rand(2, 1, 8))
    Traceback (most recent call last):
    ...
    vusfa.errors.SceneError: scene 'broken': dataset 'graph', state 1: action 0 leads to 5, but states are ...
    """

    name: str
    graph: Tensor
    features: Tensor = FeaturesField()  # type: ignore[assignment]  # noqa: RUF009
    location: Tensor = None  # type: ignore[assignment]
    rotation: Tensor = None  # type: ignore[assignment]
    distance: Tensor = DistanceField()  # type: ignore[assignment]  # noqa: RUF009
    actions: tuple[str, ...] = None  # type: ignore[assignment]
    attributes: dict[str, Any] = field(default_factory=dict)
    path: Path | None = None
    picture_shape: tuple[int, int, int] | None = None
    _paths: ShortestPaths = field(init=False)

    def __post_init__(self) -> None:
        given = {
            "graph": self.graph,
            "resnet_feature": self.features,
            "location": self.location,
            "rotation": self.rotation,
            "shortest_path_distance": vars(self).pop("_distance"),
        }
        arrays = {
            key: np.array(value.detach().cpu().numpy() if isinstance(value, Tensor) else value)
            for key, value in given.items()
            if value is not None
        }
        num_states = len(arrays["graph"]) if arrays["graph"].ndim else 0
        arrays.setdefault("location", np.zeros((num_states, 2)))
        arrays.setdefault("rotation", np.zeros(num_states))
        actions = None if self.actions is None else tuple(self.actions)
        faults = array_faults(arrays, actions, optional=["shortest_path_distance"])
        raise_faults(self.path or f"scene {brief(self.name)}", [*name_faults(self.name), *faults])
        self._set(arrays, actions)

    def _set(
        self,
        arrays: dict[str, np.ndarray],
        actions: tuple[str, ...] | None,
        stored: StoredFeatures | None = None,
    ) -> None:
        """Set the fields from checked arrays, which the scene then owns."""
        graph = _tensor(arrays["graph"], np.int64)
        values = {
            "graph": graph,
            "features": stored or _tensor(arrays["resnet_feature"], np.float32),
            "location": _tensor(arrays["location"], np.float32),
            "rotation": _tensor(arrays["rotation"], np.float32),
            "_paths": ShortestPaths(graph.numpy(), arrays.get("shortest_path_distance")),
            "actions": actions or default_actions(arrays["graph"].shape[1]),
            "attributes": dict(self.attributes),
            # Workers may run in another working directory.
            "path": stored.path if stored else None if self.path is None else Path(self.path).resolve(),
        }
        for key, value in values.items():
            object.__setattr__(self, key, value)

    @classmethod
    def load(cls, path: str | os.PathLike[str], lazy: bool = False) -> Scene:
        """Read and check a scene file; the file is closed on return.

        Args:
            path: the file.
            lazy: leave the features in the file; each access reads and checks them. The file's table of
                shortest paths is not read either.

        Raises:
            SceneError: the file is missing, truncated or has faults; the message lists all of them.
        """
        dump = store.read(path, lazy)
        raise_faults(path, dump.faults())
        return cls.of_dump(dump, Path(path))

    @classmethod
    def of_dump(cls, dump: store.Dump, path: Path | None = None) -> Scene:
        """The scene of a dump that has been checked, without another copy or check.

        Args:
            dump: which the scene then owns.
            path: the file that pictures are read from; that of the features by default.
        """
        scene = object.__new__(cls)
        vars(scene).update(
            name=dump.name, attributes=dump.attributes, path=path, picture_shape=dump.picture_shape
        )
        scene._set(dump.arrays, dump.actions, dump.stored)
        return scene

    @classmethod
    def bundled(cls, name: str) -> Scene:
        """One of the rooms that come with the package.

        >>> room = Scene.bundled("bathroom")
        >>> room.num_states, room.num_actions, room.num_crops, room.feature_size, room.islands
        (176, 4, 1, 1280, ())
        >>> room.pictures([3, 0]).shape
        torch.Size([2, 150, 200, 3])
        """
        return cls.load(store.bundled_path(name))

    @classmethod
    def open(cls, source: str | os.PathLike[str], lazy: bool = False) -> Scene:
        """A bundled room by name, or a scene file by path.

        A string without suffix and folder is a bundled name, anything else a file; ``lazy`` as in
        :meth:`load`.

        Raises:
            SceneError: there is no such scene or file, or the file has faults.
        """
        if isinstance(source, str) and not Path(source).suffix and os.sep not in source:
            if source in store.bundled_names():
                return cls.load(store.bundled_path(source), lazy)
            if not os.path.isfile(source):
                raise SceneError(
                    f"{brief(source)} is neither a bundled scene ({', '.join(store.bundled_names())}) nor a"
                    " file; check the name"
                )
        return cls.load(source, lazy)

    from_arrays = classmethod(from_arrays)
    save = save

    def pictures(self, ids: Any) -> Tensor:
        """Read the pictures of some states from the scene's file.

        Args:
            ids: state ids of any shape, in any order, repeats allowed.

        Returns:
            (*ids.shape, H, W, 3) uint8.

        Raises:
            SceneError: the scene has no pictures, the file is gone, or a state is out of range.
        """
        if self.path is None or not self.has_pictures:
            raise SceneError(
                f"scene {self.name!r} has no pictures; load it from a file with dataset 'observation'"
            )
        states = torch.as_tensor(ids, dtype=torch.int64).cpu()
        found = torch.from_numpy(read_pictures(self.path, states.reshape(-1).numpy()))
        return found.reshape(*states.shape, *found.shape[1:])

    def distances_to(self, goals: Any) -> Tensor:
        """Lengths of the shortest paths from every state to some goals, searched on first request.

        Args:
            goals: one state id, or (G,).

        Returns:
            (G, N) int16, or int32 where a path is too long for it, in actions; -1: there is none.

        Raises:
            GoalError: a goal that is not a state.

        >>> corridor = Scene("corridor", torch.tensor([[1, -1], [2, 0], [-1, 1]]), torch.rand(3, 1, 8))
        >>> corridor.distances_to([2]).tolist()
        [[2, 1, 0]]
        """
        return self._paths.to_goals(torch.from_numpy(as_states(goals, self.num_states, "goal")))

    def all_distances(self) -> Iterator[Tensor]:
        """:meth:`distances_to` all states, some (G, N) at a time."""
        return map(self.distances_to, torch.arange(self.num_states).split((1 << 22) // self.num_states))

    @cached_property
    def longest_path(self) -> int:
        """Length of the longest of all shortest paths, in actions."""
        return max(int(distances.max()) for distances in self.all_distances())

    def path_lengths(self, state: Tensor, goal: Tensor) -> Tensor:
        """Lengths (n,) int64 of the shortest paths from states (n,) to goals (n,); -1: there is none."""
        return self._paths.between(state, goal)

    def __getstate__(self) -> dict[str, Any]:
        # as arrays: a tensor would be moved to shared memory, features the whole table shared with a set
        held = {key: x for key, x in vars(self).items() if key != "graph"}  # which the paths have, too
        return {key: x.numpy() if isinstance(x, Tensor) else x for key, x in held.items()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(
            {key: torch.from_numpy(x) if isinstance(x, np.ndarray) else x for key, x in state.items()}
        )
        vars(self)["graph"] = torch.from_numpy(self._paths.graph)

    def __repr__(self) -> str:
        return f"Scene({self.name!r}, {self.num_states} states, {self.num_actions} actions)"

    @property
    def _held(self) -> Tensor | StoredFeatures:
        return vars(self)["_features"]

    @property
    def stored(self) -> StoredFeatures | None:
        """Where the features are, if they are in the scene's file alone."""
        return self._held if isinstance(self._held, StoredFeatures) else None

    @property
    def has_pictures(self) -> bool:
        """Whether the scene has pictures."""
        return self.picture_shape is not None

    @property
    def num_states(self) -> int:
        """N."""
        return self.graph.shape[0]

    @property
    def num_actions(self) -> int:
        """A."""
        return self.graph.shape[1]

    @property
    def num_crops(self) -> int:
        """C."""
        return self._held.shape[1]

    @property
    def feature_size(self) -> int:
        """F."""
        return self._held.shape[2]

    @cached_property
    def islands(self) -> tuple[tuple[int, ...], ...]:
        """States cut off from the largest connected part, one sorted tuple per island; often empty.

        >>> Scene("two parts", torch.tensor([[1], [0], [0], [3]]), torch.rand(4, 1, 2)).islands
        ((3,),)
        """
        return weak_components(self.graph)[1:]


def _tensor(values: np.ndarray, dtype: Any) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=dtype))
