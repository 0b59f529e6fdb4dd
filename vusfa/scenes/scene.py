"""One scene: a room as a finite graph of photographed poses.

A state is a pose (a place and a heading) with its picture's features; an action leads to another state or is
blocked. No file stays open: a scene can be pickled, forked and spawned, and pictures are read when asked for.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from vusfa.errors import SceneError
from vusfa.scenes import store
from vusfa.scenes.graph import default_actions, narrow_distances, shortest_path_distances, weak_components
from vusfa.scenes.pictures import read_pictures
from vusfa.scenes.validation import array_faults, raise_faults

__all__ = ["Scene"]


@dataclass(frozen=True, eq=False)
class Scene:
    """A room: its graph, its pictures' features, its poses. All tensors are on the CPU.

    Args:
        name: the scene's name.
        graph: (N, A) integers, next state, -1 = blocked.
        features: (N, C, F) floats, C crops (augmented views) of F features; kept as float32.
        location: (N, 2) metres; zeros when not given.
        rotation: (N,) degrees; zeros when not given.
        distance: (N, N) integers, ``[s, g]`` actions from s to g, -1 = unreachable; computed when not given,
            else checked against the graph.
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
    features: Tensor = field(repr=False)
    location: Tensor = field(default=None, repr=False)  # type: ignore[assignment]
    rotation: Tensor = field(default=None, repr=False)  # type: ignore[assignment]
    distance: Tensor = field(default=None, repr=False)  # type: ignore[assignment]
    actions: tuple[str, ...] = None  # type: ignore[assignment]
    attributes: dict[str, Any] = field(default_factory=dict, repr=False)
    path: Path | None = None
    picture_shape: tuple[int, int, int] | None = None

    def __post_init__(self) -> None:
        given = {
            "graph": self.graph,
            "resnet_feature": self.features,
            "location": self.location,
            "rotation": self.rotation,
            "shortest_path_distance": self.distance,
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
        source = f"scene {self.name!r}" if self.path is None else self.path
        raise_faults(source, array_faults(arrays, actions, optional=["shortest_path_distance"]))
        if "shortest_path_distance" not in arrays:
            arrays["shortest_path_distance"] = shortest_path_distances(arrays["graph"]).numpy()
        self._set(arrays, actions)

    def _set(self, arrays: dict[str, np.ndarray], actions: tuple[str, ...] | None) -> None:
        """Set the fields from arrays that are sound, and are the scene's own from now on."""
        values = {
            "graph": _tensor(arrays["graph"], np.int64),
            "features": _tensor(arrays["resnet_feature"], np.float32),
            "location": _tensor(arrays["location"], np.float32),
            "rotation": _tensor(arrays["rotation"], np.float32),
            "distance": narrow_distances(arrays["shortest_path_distance"]),
            "actions": actions or default_actions(arrays["graph"].shape[1]),
            "attributes": dict(self.attributes),
            # Workers may run in another folder.
            "path": None if self.path is None else Path(self.path).resolve(),
        }
        for key, value in values.items():
            object.__setattr__(self, key, value)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Scene:
        """Read and check a scene file; the file is closed again when this returns.

        Raises:
            SceneError: the file is missing, truncated or has faults; the message lists every one of them.
        """
        dump = store.read(path)
        raise_faults(path, dump.faults())
        scene = object.__new__(cls)
        fields = {"attributes": dump.attributes, "path": Path(path), "picture_shape": dump.picture_shape}
        for key, value in {"name": dump.name, **fields}.items():
            object.__setattr__(scene, key, value)
        scene._set(dump.arrays, dump.actions)  # without another copy, and without looking at them again
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
    def open(cls, source: str | os.PathLike[str]) -> Scene:
        """A bundled room by name, or a scene file by path.

        A string without suffix and folder is a bundled name, anything else a file.

        Raises:
            SceneError: neither a bundled name nor a file, or a file with faults.
        """
        if isinstance(source, str) and not Path(source).suffix and os.sep not in source:
            if source in store.bundled_names():
                return cls.bundled(source)
            if not Path(source).is_file():
                raise SceneError(
                    f"{source!r} is neither a bundled scene ({', '.join(store.bundled_names())}) nor a file;"
                    f" check the name"
                )
        return cls.load(source)

    def save(
        self, path: str | os.PathLike[str], pictures: Tensor | np.ndarray | Sequence[bytes] | None = None
    ) -> None:
        """Write the scene, atomically; what is read back is equal, number for number.

        What else the scene's own file holds (further datasets, attributes of datasets) is copied along.

        Args:
            path: file to write; replaced if it exists.
            pictures: (N, H, W, 3) uint8, or N JPEG files as bytes; None copies those of the scene's file as
                they are.

        Raises:
            SceneError: the pictures do not fit, an attribute cannot be written, or the folder does not exist.
        """
        in_file = self.path is not None and (self.has_pictures or self.path.is_file())
        store.write(
            path,
            {
                "graph": self.graph.numpy(),
                "resnet_feature": self.features.numpy(),
                "location": self.location.numpy(),
                "rotation": self.rotation.numpy(),
                "shortest_path_distance": self.distance.numpy(),
            },
            name=self.name,
            actions=self.actions,
            attributes=self.attributes,
            pictures=pictures.cpu().numpy() if isinstance(pictures, Tensor) else pictures,
            source=self.path if in_file else None,
        )

    def pictures(self, ids: Any) -> Tensor:
        """Pictures of some states, read from the scene's file now.

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

    @property
    def has_pictures(self) -> bool:
        """Whether :meth:`pictures` can give any."""
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
        return self.features.shape[1]

    @property
    def feature_size(self) -> int:
        """F."""
        return self.features.shape[2]

    @cached_property
    def islands(self) -> tuple[tuple[int, ...], ...]:
        """States cut off from the largest connected part, a sorted tuple for each island; often empty.

        >>> Scene("two parts", torch.tensor([[1], [0], [0], [3]]), torch.rand(4, 1, 2)).islands
        ((3,),)
        """
        return weak_components(self.graph)[1:]


def _tensor(values: np.ndarray, dtype: Any) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=dtype))
