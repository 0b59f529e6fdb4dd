"""Scenes from arrays, pictures and graphs of any other program, and scenes to files."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from vusfa.errors import SceneError
from vusfa.limits import TABLE_STATES
from vusfa.scenes import store

if TYPE_CHECKING:
    from vusfa.scenes.scene import Scene

__all__ = ["from_arrays", "save"]

Array = np.ndarray | Tensor | Sequence[Any]


def from_arrays(
    cls: type[Scene],
    path: str | os.PathLike[str],
    graph: Array,
    features: Array | Callable[[Any], Array],
    *,
    pictures: np.ndarray | Tensor | Sequence[bytes] | None = None,
    location: Array | None = None,
    rotation: Array | None = None,
    actions: Sequence[str] | None = None,
    name: str | None = None,
    attributes: Mapping[str, Any] | None = None,
) -> Scene:
    """Write arrays as a scene file, atomically, and load it.

    Args:
        path: file to write; replaced if it exists.
        graph: (N, A) integers, next state, -1 = blocked.
        features: (N, F) or (N, C, F) floats; or a function that computes them from the pictures, such as
            :func:`vusfa.sources.encode.encode_pictures`.
        pictures: (N, H, W, 3) uint8, or N JPEG files as bytes.
        location: (N, 2) metres, x and z; zeros when not given.
        rotation: (N,) degrees, 0 along +z, 90 along +x; zeros when not given.
        actions: A names; those of the THOR v1 dumps when not given and A is 4.
        name: name of the scene; the file's when not given.
        attributes: provenance: str, int, float, or lists of these.

    Raises:
        SceneError: arguments that do not fit; the message lists every fault, and no file is written.

    >>> import tempfile
    >>> from vusfa.scenes import Scene
    >>> grey = np.full((3, 30, 40, 3), 128, np.uint8)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     corridor = Scene.from_arrays(
    ...         f"{folder}/corridor.h5", [[1, -1], [2, 0], [-1, 1]], np.eye(3), pictures=grey,
    ...         actions=["ahead", "back"])
    ...     corridor.name, corridor.num_states, corridor.features.shape, corridor.picture_shape
    ('corridor', 3, torch.Size([3, 1, 3]), (30, 40, 3))
    """
    if callable(features):
        if pictures is None:
            raise SceneError(f"{os.fspath(path)}: features are a function of pictures; give pictures, too")
        features = features(pictures)
    values = np.asarray(features.detach().cpu() if isinstance(features, Tensor) else features)
    scene = cls(
        name or Path(path).stem,
        np.asarray(graph),  # type: ignore[arg-type]
        values[:, None] if values.ndim == 2 else values,  # type: ignore[arg-type]
        location,  # type: ignore[arg-type]
        rotation,  # type: ignore[arg-type]
        actions=None if actions is None else tuple(actions),  # type: ignore[arg-type]
        attributes=dict(attributes or {}),
    )
    scene.save(path, pictures)
    return cls.load(path)


def save(
    self: Scene,
    path: str | os.PathLike[str],
    pictures: Tensor | np.ndarray | Sequence[bytes] | None = None,
) -> None:
    """Write the scene, atomically; :meth:`Scene.load` reads exactly equal numbers.

    Other entries of the scene's file (further datasets, attributes of datasets) are copied, too.

    Args:
        path: file to write; replaced if it exists.
        pictures: (N, H, W, 3) uint8, or N JPEG files as bytes; None copies those of the scene's file as
            they are.

    Raises:
        SceneError: the pictures do not fit, an attribute cannot be written, or the folder does not exist.
    """
    in_file = self.path is not None and (self.has_pictures or self.path.is_file())
    small = self.num_states <= TABLE_STATES
    store.write(
        path,
        {
            "graph": self.graph.numpy(),
            "resnet_feature": self.features.numpy(),
            "location": self.location.numpy(),
            "rotation": self.rotation.numpy(),
            **({"shortest_path_distance": self.distance.numpy()} if small else {}),
        },
        name=self.name,
        actions=self.actions,
        attributes=self.attributes,
        pictures=pictures.cpu().numpy() if isinstance(pictures, Tensor) else pictures,
        source=self.path if in_file else None,
    )
