"""Features that stay on the disk: read scene by scene when they are asked for.

A set of ten thousand rooms has gigabytes of features, of which a training in a few active scenes needs some
megabytes at a time. A lazily opened :class:`~vusfa.scenes.SceneSet` holds graphs and poses in memory, and in
place of a tensor of features a :class:`LazyFeatures`. Networks keep the rows that they have read in
:class:`SceneRows`, as they need them (normalized, on their device): the only copy in memory, of bounded size.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from vusfa.errors import SceneError
from vusfa.limits import RESIDENT_BYTES
from vusfa.scenes.hdf5 import dataset_in, opened, read_features
from vusfa.scenes.statistics import FeatureSummary, summarize
from vusfa.scenes.validation import feature_faults, raise_faults

if TYPE_CHECKING:
    from vusfa.scenes.scene import Scene

__all__ = ["FeaturesField", "LazyFeatures", "SceneRows", "StoredFeatures"]


class FeaturesField:
    """The field ``Scene.features``: a tensor, or features in a file, which are read at each access."""

    def __get__(self, scene: Scene | None, owner: type) -> Any:
        if scene is None:
            raise AttributeError("features")  # as for any field without a default
        held = vars(scene)["_features"]
        return held.read() if isinstance(held, StoredFeatures) else held

    def __set__(self, scene: Scene, value: Any) -> None:
        vars(scene)["_features"] = value


@dataclass(frozen=True)
class StoredFeatures:
    """Features of a scene that are in its file alone.

    Args:
        path: the file.
        shape: (N, C, F).
        stamp: of the file, when the rest of it was read, see :func:`stamp_of`.
    """

    path: Path
    shape: torch.Size
    stamp: tuple[int, int, int, int]

    def read(self) -> Tensor:
        """(N, C, F) float32.

        Raises:
            SceneError: the file has gone or changed since it was opened, or its features have faults.
        """
        if not self.path.is_file():
            raise SceneError(
                f"{self.path}: has gone since it was opened; its features are read when they are needed: put"
                " it back, and resume"
            )
        with opened(self.path) as file:
            if stamp_of(self.path) != self.stamp:
                raise SceneError(
                    f"{self.path}: has changed since it was opened; leave scenes in place while a run needs"
                    " them, and begin anew"
                )
            dataset = dataset_in(file, "resnet_feature")
            if dataset is None or dataset.shape != tuple(self.shape):
                raise SceneError(f"{self.path}: dataset 'resnet_feature' is not {tuple(self.shape)} any more")
            values = read_features(dataset)
        raise_faults(self.path, feature_faults(values))
        return torch.from_numpy(np.ascontiguousarray(values, np.float32))


def stamp_of(path: Path) -> tuple[int, int, int, int]:
    """Size, times of the last change of content and of status in nanoseconds, and number of a file."""
    facts = os.stat(path)
    return facts.st_size, facts.st_mtime_ns, facts.st_ctime_ns, facts.st_ino


class LazyFeatures:
    """Features (S, C, F) of the states of a set of scenes, which are read when they are asked for.

    Indexing reads the scenes of the ids that are asked for, once per call.

    Args:
        scenes: in the order of their ids.

    >>> import tempfile
    >>> from vusfa.scenes import SceneSet
    >>> rooms = SceneSet.open(["bathroom", "kitchen"], lazy=True)
    >>> rooms.features.shape, rooms.features[torch.tensor([3, 200]), 0].shape
    (torch.Size([856, 1, 1280]), torch.Size([2, 1280]))
    """

    def __init__(self, scenes: Sequence[Scene]) -> None:
        self._scenes = scenes
        sizes = [scene.num_states for scene in scenes]
        self.offsets = torch.from_numpy(np.cumsum([0, *sizes]))
        first = scenes[0]
        self.shape = torch.Size([sum(sizes), first.num_crops, first.feature_size])
        self._clear()

    def _clear(self) -> None:
        self._pool: ThreadPoolExecutor | None = None
        self._coming: dict[int, Future[Tensor]] = {}
        self._process = os.getpid()
        self._used = False

    def of_scene(self, index: int) -> Tensor:
        """Features (N, C, F) float32 of one scene, read now unless :meth:`prefetch` has.

        Raises:
            SceneError: see :meth:`StoredFeatures.read`.
        """
        self._used = True
        waiting = self._coming.pop(index, None) if self._process == os.getpid() else None
        return self._scenes[index].features if waiting is None else waiting.result()

    def prefetch(self, scenes: Iterable[int]) -> None:
        """Begin to read scenes in the background, in place of those that were to be read before.

        Nothing is read for a reader that has never asked for features.
        """
        if not self._used:
            return
        if self._process != os.getpid():  # threads do not survive a fork
            self._clear()
        wanted = set(scenes)
        for index in [index for index in self._coming if index not in wanted]:
            self._coming.pop(index).cancel()
        if self._pool is None:
            self._pool = ThreadPoolExecutor(1, thread_name_prefix="scenes")
        for index in sorted(wanted - self._coming.keys()):
            self._coming[index] = self._pool.submit(getattr, self._scenes[index], "features")

    @cached_property
    def summary(self) -> FeatureSummary:
        """Fingerprint and statistics of all states, computed scene by scene, or from a cache on the disk."""
        return summarize(self._scenes)

    def __getitem__(self, index: Any) -> Tensor:
        ids, *rest = index if isinstance(index, tuple) else (index,)
        ids = torch.arange(len(self))[ids.cpu() if isinstance(ids, Tensor) else ids]
        found = torch.empty(ids.numel(), *self.shape[1:])
        flat = ids.reshape(-1).contiguous()
        scene = torch.bucketize(flat, self.offsets, right=True) - 1
        for one in scene.unique().tolist():
            rows = scene == one
            found[rows] = self._scenes[one].features[flat[rows] - self.offsets[one]]
        found = found.view(*ids.shape, *self.shape[1:])
        return found[(slice(None),) * ids.dim() + tuple(rest)]

    def __len__(self) -> int:
        return self.shape[0]

    def __deepcopy__(self, memo: dict[int, Any]) -> LazyFeatures:
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        return LazyFeatures, (self._scenes,)


class SceneRows:
    """Rows of a set's states, one each, read scene by scene when they are asked for.

    What has been read stays, up to a limit; then all of it goes, and reading begins with the scenes that are
    asked for. A single request may exceed the limit. Copies and pickles are empty.

    Args:
        offsets: (n_scenes + 1,) of the set.
        limit: bytes.

    >>> rows = SceneRows(torch.tensor([0, 2, 5]))
    >>> rows(torch.tensor([[4, 2]]), lambda scene: torch.full((3, 1), 10.0 * scene)).tolist()
    [[[10.0], [10.0]]]
    """

    def __init__(self, offsets: Tensor, limit: int | None = None) -> None:
        self._offsets, self._limit = offsets.cpu(), RESIDENT_BYTES if limit is None else limit
        self.clear()

    def clear(self) -> None:
        """Forget all rows."""
        self._place: Tensor | None = None
        self._table: Tensor | None = None
        self._used = 0

    @property
    def num_states(self) -> int:
        """S."""
        return int(self._offsets[-1])

    def __call__(self, ids: Tensor | None, read: Callable[[int], Tensor]) -> Tensor:
        """Rows (\\*B, ...) of states (\\*B,), on their device; of all states for None.

        Args:
            ids: global ids.
            read: makes the rows (N, ...) of a scene, given by its index.
        """
        if ids is None:
            ids = torch.arange(self.num_states)
        flat = ids.reshape(-1).contiguous()
        if self._place is None or self._place.device != flat.device:
            self.clear()
            self._place = torch.full((self.num_states,), -1, device=flat.device)
        place = self._place[flat]
        if self._table is None or bool((place < 0).any()):
            self._load(flat.cpu(), read)
            place = self._place[flat]
        assert self._table is not None
        found = self._table.index_select(0, place)
        return found.view(*ids.shape, *found.shape[1:])

    def _load(self, ids: Tensor, read: Callable[[int], Tensor]) -> None:
        assert self._place is not None
        wanted = (torch.bucketize(ids, self._offsets, right=True) - 1).unique().tolist() or [0]
        first = self._offsets.tolist()
        missing = [scene for scene in wanted if self._place[first[scene]] < 0]
        blocks = {missing[0]: read(missing[0])}
        like = blocks[missing[0]]
        most = self._limit // max(1, like[0].nbytes)
        if self._used + sum(first[scene + 1] - first[scene] for scene in missing) > most:
            self._place.fill_(-1)
            self._used, missing = 0, wanted
        self._reserve(self._used + sum(first[scene + 1] - first[scene] for scene in missing), most, like)
        assert self._table is not None
        for scene in missing:
            block = blocks.pop(scene) if scene in blocks else read(scene)
            begin, self._used = self._used, self._used + len(block)
            self._table[begin : self._used] = block
            self._place[first[scene] : first[scene + 1]] = torch.arange(
                begin, self._used, device=self._place.device
            )

    def _reserve(self, rows: int, most: int, like: Tensor) -> None:
        """Make the table large enough."""
        if self._table is not None and rows <= len(self._table):
            return
        assert self._place is not None
        grown = rows if self._table is None else max(rows, min(2 * len(self._table), most))
        table = like.new_empty(grown, *like.shape[1:], device=self._place.device)
        if self._table is not None:
            table[: self._used] = self._table[: self._used]
        self._table = table

    def __deepcopy__(self, memo: dict[int, Any]) -> SceneRows:
        return copy.copy(self)

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_place": None, "_table": None, "_used": 0}
