"""Fingerprint and statistics of many scenes: one pass over their files, cached beside them.

The cache is one small file, ``.vusfa-KEY.npz``, in the folder of the first scene; where that folder may not
be written there is none. It is believed only if every scene's file still has the size, the times and the
number of then, or else the same SHA-256; what it holds is data, bounded and checked.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from vusfa.errors import ResultError
from vusfa.files import file_sha256, write_npz
from vusfa.reading import read_npz

if TYPE_CHECKING:
    from vusfa.scenes.scene import Scene

__all__ = ["FeatureSummary", "fingerprint", "summarize"]


class FeatureSummary(NamedTuple):
    """Fingerprint of scenes, and statistics of each feature over all states, crop 0; (F,) float64.

    Attributes:
        fingerprint: see :attr:`vusfa.scenes.SceneSet.fingerprint`.
        mean, deviation: of the feature.
        largest: its largest absolute value.
    """

    fingerprint: str
    mean: Tensor
    deviation: Tensor
    largest: Tensor


def fingerprint(scenes: Sequence[Scene]) -> str:
    """16 hexadecimal digits of a SHA-256 over names, actions, graphs and features."""
    digest = hashlib.sha256()
    for scene in scenes:
        _add(digest, scene, scene.features)
    return digest.hexdigest()[:16]


def _add(digest: Any, scene: Scene, features: Tensor) -> None:
    head = (scene.name, scene.actions, tuple(scene.graph.shape), tuple(features.shape))
    digest.update(repr(head).encode())
    digest.update(np.ascontiguousarray(scene.graph.numpy(), "<i8").data)
    digest.update(np.ascontiguousarray(features.numpy(), "<f4").data)


def summarize(scenes: Sequence[Scene]) -> FeatureSummary:
    """Summarize scenes, those in files from the cache where there is one.

    Raises:
        SceneError: a file has gone or changed since it was opened, or its features have faults.
    """
    files = [scene.stored for scene in scenes]
    stored = [file for file in files if file is not None]
    if len(stored) < len(files):
        return _computed(scenes)
    names = "\n".join(f"{file.path.name} {scene.name}" for file, scene in zip(stored, scenes, strict=True))
    key = hashlib.sha256(names.encode()).hexdigest()[:16]
    cache = stored[0].path.parent / f".vusfa-{key}.npz"
    if cache.parent == Path(__file__).resolve().parent / "bundled":  # nothing is written into the package
        return _computed(scenes)
    paths, stamps = [file.path for file in stored], np.array([file.stamp for file in stored], np.int64)
    found = _read(cache, len(scenes), scenes[0].feature_size)
    if found is not None:
        changed = np.flatnonzero((found["stamp"] != stamps).any(1))
        if all(np.array_equal(_sha256(paths[file]), found["sha256"][file]) for file in changed):
            if len(changed):
                _write(cache, {**found, "stamp": stamps})
            columns = (torch.from_numpy(found[name]) for name in ("mean", "deviation", "largest"))
            return FeatureSummary(str(found["fingerprint"]), *columns)
    summary = _computed(scenes)
    sums = np.stack([_sha256(path) for path in paths])
    content = {name: np.asarray(value) for name, value in summary._asdict().items()}
    _write(cache, {**content, "stamp": stamps, "sha256": sums})
    return summary


def _computed(scenes: Sequence[Scene]) -> FeatureSummary:
    """One pass; means and sums of squares of parts are joined as by Chan, Golub and LeVeque (1983)."""
    digest, seen = hashlib.sha256(), 0
    mean = squares = largest = np.zeros(scenes[0].feature_size)
    for scene in scenes:
        features = scene.features
        _add(digest, scene, features)
        values = features[:, 0].numpy().astype(np.float64)
        of_scene, count = values.mean(0), len(values)
        apart, seen = of_scene - mean, seen + count
        mean = mean + apart * (count / seen)
        squares = squares + values.var(0) * count + apart**2 * (count * (seen - count) / seen)
        largest = np.maximum(largest, np.abs(values).max(0))
    columns = (torch.from_numpy(column) for column in (mean, np.sqrt(squares / seen), largest))
    return FeatureSummary(digest.hexdigest()[:16], *columns)


def _sha256(path: Path) -> np.ndarray:
    """(32,) uint8."""
    return np.frombuffer(bytes.fromhex(file_sha256(path)), np.uint8)


def _read(path: Path, scenes: int, features: int) -> dict[str, np.ndarray] | None:
    """A cache's arrays; None for a file that is missing or holds anything else."""
    try:
        found = read_npz(path)
    except ResultError:
        return None
    shapes = {
        "fingerprint": ("U", ()),
        "mean": ("f", (features,)),
        "deviation": ("f", (features,)),
        "largest": ("f", (features,)),
        "stamp": ("i", (scenes, 4)),
        "sha256": ("u", (scenes, 32)),
    }
    for name, (kind, shape) in shapes.items():
        if name not in found or found[name].dtype.kind != kind or found[name].shape != shape:
            return None
        if kind == "f" and (found[name].dtype != np.float64 or not np.isfinite(found[name]).all()):
            return None
    if (found["deviation"] < 0).any():
        return None
    return found if re.fullmatch("[0-9a-f]{16}", str(found["fingerprint"])) else None


def _write(path: Path, arrays: dict[str, np.ndarray]) -> None:
    with suppress(ResultError):
        write_npz(path, arrays)
