"""Pipeline from poses, moves and pictures to a scene file, shared by all sources of scenes.

A source finds out what the states are and where the actions lead (:class:`PoseGraph`) and how to get their
pictures. :func:`capture` encodes the pictures, in steps that are kept on disk, adds the provenance, checks
everything and writes the file.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vusfa.scenes.pictures import decode
from vusfa.scenes.provenance import Provenance
from vusfa.scenes.scene import Scene
from vusfa.scenes.validation import array_faults, raise_faults
from vusfa.sources.backbones import DEFAULT, Backbone, load_backbone
from vusfa.sources.encode import Progress, encode_in_steps

__all__ = ["Pictures", "PoseGraph", "capture"]

#: (N, H, W, 3) uint8, N JPEG files, or ``read(first, last)`` that gives these pictures as (n, H, W, 3) uint8.
Pictures = np.ndarray | Sequence[bytes] | Callable[[int, int], np.ndarray]


@dataclass(frozen=True)
class PoseGraph:
    """The states of a scene and where the actions lead.

    Attributes:
        graph: (N, A) integers, next state, -1 = blocked.
        location: (N, 2) float64 metres; zeros when nothing says where the pictures were taken.
        rotation: (N,) float64 degrees.
        actions: A names.
    """

    graph: np.ndarray
    location: np.ndarray
    rotation: np.ndarray
    actions: tuple[str, ...]


def capture(
    target: str | os.PathLike[str],
    name: str,
    states: PoseGraph,
    pictures: Pictures,
    origin: Provenance,
    *,
    attributes: Mapping[str, Any] | None = None,
    features: np.ndarray | None = None,
    backbone: str | Backbone = DEFAULT,
    batch: int = 32,
    progress: Progress | None = None,
) -> Scene:
    """Encode pictures and write a scene file, atomically.

    Interrupted while it encodes, it continues when it is called again with the same pictures and network:
    finished features are kept in ``.NAME.encode`` beside the target until the file is written.

    Args:
        target: file to write; replaced if it exists.
        name: the scene's name.
        states: what the states are, and where the actions lead.
        pictures: one per state. JPEG files are kept byte for byte, arrays as they are.
        origin: where the scene comes from.
        attributes: further attributes of the file.
        features: (N, C, F) floats, where they exist already; nothing is encoded then.
        backbone: a network of :func:`vusfa.sources.backbones.load_backbone`, or its name.
        batch: pictures that are encoded at a time.
        progress: called with the number of encoded pictures and N.

    Returns:
        the scene, read from the file.

    Raises:
        SceneError: faults in the states, their pictures or features; or the file cannot be written.
        ConfigError: there is no such network, or its weights or packages are missing.

    >>> import tempfile
    >>> corridor = PoseGraph(np.array([[1], [0]]), np.array([[0, 0], [0, 1.0]]), np.zeros(2), ("forward",))
    >>> grey, embedding = np.full((2, 24, 32, 3), 128, np.uint8), np.eye(2)[:, None]
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder, "corridor.h5")
    ...     capture(file, "corridor", corridor, grey, Provenance(), features=embedding).actions
    ('forward',)
    """
    target = Path(target)
    arrays = {"graph": states.graph, "location": states.location, "rotation": states.rotation}
    raise_faults(
        f"scene {name!r}",
        array_faults(arrays, states.actions, optional=["resnet_feature", "shortest_path_distance"]),
    )
    log = None
    described: dict[str, Any] = {}
    if features is None:
        read, num_states = _reader(pictures), len(states.graph)
        features, described, log = encode_in_steps(
            read,
            num_states,
            load_backbone(backbone) if isinstance(backbone, str) else backbone,
            target.with_name(f".{target.name}.encode"),
            {"pictures": _digest(read, num_states, batch)},
            batch=batch,
            progress=progress,
        )
    scene = Scene(
        name,
        states.graph,  # type: ignore[arg-type]
        features,  # type: ignore[arg-type]
        states.location,  # type: ignore[arg-type]
        states.rotation,  # type: ignore[arg-type]
        actions=states.actions,
        attributes={**(attributes or {}), **origin.attributes(), **described},
    )
    scene.save(target, pictures(0, scene.num_states) if callable(pictures) else pictures)
    if log is not None:
        log.remove()
    return Scene.load(target)


def _reader(pictures: Pictures) -> Callable[[int, int], np.ndarray]:
    """``read(first, last)`` of pictures in any form."""
    if callable(pictures):
        return pictures
    if isinstance(pictures, np.ndarray):
        return lambda first, last: pictures[first:last]
    return lambda first, last: np.stack([decode(picture) for picture in pictures[first:last]])


def _digest(read: Callable[[int, int], np.ndarray], num_pictures: int, batch: int) -> str:
    """SHA-256 of all pictures; with the network it identifies the encoding."""
    digest = hashlib.sha256()
    for first in range(0, num_pictures, batch):
        digest.update(read(first, min(first + batch, num_pictures)).tobytes())
    return digest.hexdigest()
