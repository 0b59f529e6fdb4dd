"""Small copies of scene files: half-precision features, JPEG pictures, compressed tables."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from vusfa.errors import SceneError
from vusfa.scenes import pictures as picture_files
from vusfa.scenes import store
from vusfa.scenes.graph import default_actions
from vusfa.scenes.validation import raise_faults

__all__ = ["compact"]


def compact(source: str | os.PathLike[str], target: str | os.PathLike[str], pictures: bool = True) -> None:
    """A small copy of a scene file: features as float16, raw pictures as JPEG files of quality 92.

    Pictures that are JPEG files already are kept byte for byte. Rounding to float16 changes a feature by at
    most one part in 2048 (one below 6.1e-5 by at most 3e-8).

    Args:
        source: scene file.
        target: file to write.
        pictures: keep them, and datasets that are not those of a scene.

    Raises:
        SceneError: the source has faults, or a feature is beyond the range of float16, or the
            target cannot be written.
    """
    source = Path(source)
    dump = store.read(source)
    raise_faults(source, dump.faults())
    features = dump.arrays["resnet_feature"]
    for state, row in enumerate(features):
        with np.errstate(over="ignore"):
            features[state] = row.astype(np.float16)
        if not np.isfinite(features[state]).all():
            raise SceneError(
                f"{source}: dataset 'resnet_feature', state {state}: a value is beyond float16's range of"
                f" +-65504; scale the features down"
            )
    num_states, num_actions = dump.arrays["graph"].shape
    kept, blocks = picture_files.stored(source, num_states) if pictures else (None, None)
    if blocks is not None:
        kept = [picture_files.to_jpeg(picture) for block in blocks for picture in block]
    store.write(
        target,
        dump.arrays,
        name=dump.name,
        actions=dump.actions or default_actions(num_actions),
        attributes=dump.attributes,
        pictures=kept,
        source=source if pictures else None,
    )
