"""Encoding of pictures into features.

:func:`encode_pictures` is for pictures in memory, :func:`encode_scene` for a scene file. The latter can be
stopped at any moment and started again; it goes on where it was, and writes the new file in one piece. The
file's attributes say which network made the features, by which weights (SHA-256), layer and preprocessing.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from vusfa.errors import ConfigError, SceneError
from vusfa.files import file_sha256
from vusfa.limits import TABLE_STATES
from vusfa.scenes import store
from vusfa.scenes.graph import default_actions, shortest_path_distances
from vusfa.scenes.pictures import read_pictures
from vusfa.scenes.scene import Scene
from vusfa.scenes.validation import array_faults, feature_faults, raise_faults
from vusfa.sources.backbones import DEFAULT, Backbone, load_backbone
from vusfa.sources.crops import prepare
from vusfa.sources.row_log import RowLog

__all__ = ["bfloat16_is_as_good", "encode_in_steps", "encode_pictures", "encode_scene"]

#: ``progress(done, total)``: first with what was done before, then after every step
Progress = Callable[[int, int], None]

_AT_ONCE = 8  # images
_AS_GOOD = 0.999  # lowest cosine of bfloat16's features with float32's


def _crops(pictures: np.ndarray, backbone: Backbone, bfloat16: bool) -> np.ndarray:
    """Features (n, C, F) of some pictures, all at once."""
    num_crops = backbone.preprocessing.num_crops
    # On a processor few images at a time are 2 to 3 times faster: their maps fit the memory that is at hand.
    at_once = max(1, _AT_ONCE // num_crops) if backbone.device == "cpu" else len(pictures)
    found = [
        backbone(prepare(pictures[first : first + at_once], backbone.preprocessing), bfloat16)
        for first in range(0, len(pictures), at_once)
    ]
    return torch.cat(found).reshape(len(pictures), num_crops, -1).numpy()


def _checked(pictures: Any) -> np.ndarray:
    array = pictures.cpu().numpy() if isinstance(pictures, Tensor) else np.asarray(pictures)
    if array.dtype != np.uint8 or array.ndim != 4 or array.shape[3] != 3 or 0 in array.shape:
        raise SceneError(f"pictures are {array.dtype} of shape {array.shape}; give uint8 (N, H, W, 3)")
    return array


def bfloat16_is_as_good(pictures: Any, backbone: Backbone) -> bool:
    """Whether a network's features in bfloat16 agree with those in float32, for these pictures.

    Every crop's cosine between the two must be 0.999 or more; states that are more alike than that count as
    look-alikes. (EfficientNet-lite0, whose activations are clipped, stays below: about 0.997.)

    Args:
        pictures: (n, H, W, 3) uint8; a sample is enough.
        backbone: the network.

    Raises:
        ConfigError: the network runs in float32 only.
    """
    if not backbone.mixed:
        raise ConfigError(f"{backbone.name}: runs in float32 only; leave out bfloat16")
    array = _checked(pictures)
    full, half = (torch.from_numpy(_crops(array, backbone, flag)).double() for flag in (False, True))
    return bool((torch.cosine_similarity(full, half, dim=-1) >= _AS_GOOD).all())


def encode_pictures(
    pictures: Any, backbone: str | Backbone = DEFAULT, *, batch: int = 32, bfloat16: bool = False
) -> np.ndarray:
    """Features of pictures in memory.

    Args:
        pictures: (N, H, W, 3) uint8, array or tensor.
        backbone: a network of :func:`vusfa.sources.backbones.load_backbone`, or its name.
        batch: pictures at a time.
        bfloat16: faster where the processor has it; used if :func:`bfloat16_is_as_good` for the first batch.

    Returns:
        (N, C, F) float32, C crops of F features.

    Raises:
        SceneError: the pictures have another type or shape.
        ConfigError: there is no such network, or its weights or packages are missing.

    >>> room = Scene.bundled("bathroom")
    >>> encode_pictures(room.pictures([0, 1])).shape
    (2, 1, 1280)
    """
    array = _checked(pictures)
    network = load_backbone(backbone) if isinstance(backbone, str) else backbone
    half = bfloat16 and bfloat16_is_as_good(array[:batch], network)
    blocks = [_crops(array[k : k + batch], network, half) for k in range(0, len(array), batch)]
    return np.concatenate(blocks)


def encode_in_steps(
    read: Callable[[int, int], np.ndarray],
    num_pictures: int,
    backbone: Backbone,
    log_path: str | os.PathLike[str],
    work: Mapping[str, Any],
    *,
    batch: int = 32,
    bfloat16: bool = False,
    progress: Progress | None = None,
) -> tuple[np.ndarray, dict[str, str], RowLog]:
    """Features of pictures that are read batch by batch; every finished batch is kept in a log.

    Args:
        read: ``read(first, last)`` gives these pictures, (last - first, H, W, 3) uint8.
        num_pictures: N.
        backbone: the network.
        log_path: where finished features are kept; those of the same work are not computed again.
        work: what identifies this work, besides the network.
        batch: pictures at a time. A run that was stopped and resumed with the same batch gives the same
            numbers; with another, the same within rounding.
        bfloat16: as for :func:`encode_pictures`.
        progress: called with pictures done and N.

    Returns:
        features (N, C, F) float32; attributes that say where they come from; and the log, for the caller to
        remove when the features are where they belong.

    Raises:
        SceneError: a picture cannot be read, or the features are not finite.
    """
    half = bfloat16 and bfloat16_is_as_good(read(0, min(batch, num_pictures)), backbone)
    attributes = {**backbone.attributes(), "feature_precision": "bfloat16" if half else "float32"}
    row = _crops(read(0, 1), backbone, half)[0]
    log = RowLog(log_path, {"features of": dict(work), **attributes}, np.dtype((np.float32, row.shape)))
    # The same batches as without a stop: the last digits depend on what is computed together.
    if len(log) < num_pictures:
        log.cut(len(log) // batch * batch)
    report = progress or (lambda done, total: None)
    report(len(log), num_pictures)
    while len(log) < num_pictures:
        first = len(log)
        features = _crops(_checked(read(first, min(first + batch, num_pictures))), backbone, half)
        raise_faults(f"{backbone.name}, from state {first} on", feature_faults(features))
        log.append(features)
        report(len(log), num_pictures)
    return log.read(), attributes, log


def encode_scene(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    backbone: str | Backbone = DEFAULT,
    *,
    batch: int = 32,
    bfloat16: bool = False,
    progress: Progress | None = None,
) -> Scene:
    """Write a copy of a scene file with features of its pictures by another network, atomically.

    The source needs its graph, poses and pictures; features are replaced when there are any, and shortest
    paths are computed when there are none. Stopped, it goes on where it was when it is called again.

    Args:
        source: scene file with pictures.
        target: file to write; may be the source itself.
        backbone: a network of :func:`vusfa.sources.backbones.load_backbone`, or its name.
        batch: pictures at a time.
        bfloat16: as for :func:`encode_pictures`.
        progress: called with pictures done and N.

    Raises:
        SceneError: the source has faults or no pictures, or the target cannot be written.
        ConfigError: there is no such network, or its weights or packages are missing.
    """
    source, target = Path(source), Path(target)
    network = load_backbone(backbone) if isinstance(backbone, str) else backbone
    dump = store.read(source)
    dump.arrays.pop("resnet_feature", None)
    faults = [line for line in dump.reading_faults if "'resnet_feature'" not in line]
    optional = ["resnet_feature", "shortest_path_distance"]
    raise_faults(source, faults + array_faults(dump.arrays, dump.actions, optional=optional))
    if dump.picture_shape is None:
        raise SceneError(f"{source}: has no pictures to encode; write dataset 'observation', (N, H, W, 3)")
    num_states, num_actions = dump.arrays["graph"].shape
    features, attributes, log = encode_in_steps(
        lambda first, last: read_pictures(source, np.arange(first, last)),
        num_states,
        network,
        target.with_name(f".{target.name}.encode"),
        {"source": file_sha256(source)},
        batch=batch,
        bfloat16=bfloat16,
        progress=progress,
    )
    arrays = {**dump.arrays, "resnet_feature": features}
    if "shortest_path_distance" not in arrays and num_states <= TABLE_STATES:
        arrays["shortest_path_distance"] = shortest_path_distances(arrays["graph"]).numpy()
    store.write(
        target,
        arrays,
        name=dump.name,
        actions=dump.actions or default_actions(num_actions),
        attributes={**dump.attributes, **attributes},
        source=source,
        stale=["resnet_feature"],
    )
    log.remove()
    return Scene.load(target)
