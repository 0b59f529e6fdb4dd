"""Several scenes as one space of state ids: scene i has the ids ``offsets[i] .. offsets[i + 1] - 1``.

Environments and networks hold these integers and look up everything else here.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from vusfa.errors import SceneError
from vusfa.limits import listing
from vusfa.scenes.features import LazyFeatures
from vusfa.scenes.graph import successor_table
from vusfa.scenes.places import Sources, listed, open_scenes
from vusfa.scenes.scene import Scene
from vusfa.scenes.statistics import fingerprint
from vusfa.scenes.store import bundled_names
from vusfa.scenes.validation import check_alike

__all__ = ["SceneSet"]


class SceneSet:
    """Several scenes with the same actions, crops and feature size, as one global index space of S states.

    Args:
        scenes: the scenes, in the order of their ids. Names must differ.

    Attributes:
        scenes: tuple of :class:`Scene`, always on the CPU.
        names: their names.
        offsets: (n_scenes + 1,) int64, first global id of each scene, and S.
        successor: (S, A) int64 global ids; a blocked move stays in place.
        blocked: (S, A) bool.
        features: (S, C, F) float32; of a lazily opened set :class:`~vusfa.scenes.features.LazyFeatures`,
            which are read from the files when they are indexed.
        scene_id: (S,) int64, index of the scene.
        location: (S, 2) float32, metres, each scene in its own frame.
        rotation: (S,) float32, degrees.
        sources: names and paths that :meth:`open` has opened.

    Raises:
        SceneError: no scenes, two of one name, or scenes that differ in actions, crops or feature size.

    >>> rooms = SceneSet.bundled(["bathroom", "kitchen"])
    >>> rooms.num_scenes, rooms.num_states, rooms.offsets.tolist()
    (2, 856, [0, 176, 856])
    >>> rooms.distance(torch.tensor([0, 0]), torch.tensor([0, 176])).tolist()  # itself; another room
    [0, -1]
    """

    sources: tuple[str, ...] = ()

    def __init__(self, scenes: Iterable[Scene]) -> None:
        self.scenes: tuple[Scene, ...] = tuple(scenes)
        for scene in self.scenes:
            if not isinstance(scene, Scene):
                raise SceneError(f"{scene!r} is no Scene; open names and files with SceneSet.open")
        if not self.scenes:
            raise SceneError(f"a SceneSet needs at least one scene; bundled are {', '.join(bundled_names())}")
        check_alike(self.scenes)
        self._build()

    def _build(self) -> None:
        # NumPy: torch's threads hang in a forked process whose parent has used them.
        sizes = [scene.num_states for scene in self.scenes]
        offsets = np.cumsum([0, *sizes])
        self._known: list[str] = []  # the fingerprint, once somebody has asked; shared with copies
        tables = [successor_table(scene.graph) for scene in self.scenes]
        self.offsets = torch.from_numpy(offsets)
        self.successor = _joined([t.numpy() + n for (t, _), n in zip(tables, offsets[:-1], strict=True)])
        self.blocked = _joined([blocked.numpy() for _, blocked in tables])
        self.names = tuple(scene.name for scene in self.scenes)
        self.features: Any
        if any(scene.stored for scene in self.scenes):
            self.features = LazyFeatures(self.scenes)
        else:
            self.features = _joined([scene.features.numpy() for scene in self.scenes])
            for scene, first, end in zip(self.scenes, offsets[:-1], offsets[1:], strict=True):
                object.__setattr__(scene, "features", self.features[first:end])  # one copy, not two
        self.location = _joined([scene.location.numpy() for scene in self.scenes])
        self.rotation = _joined([scene.rotation.numpy() for scene in self.scenes])
        self.scene_id = torch.from_numpy(np.repeat(np.arange(len(sizes)), sizes))

    @classmethod
    def bundled(cls, names: Sequence[str] | None = None) -> SceneSet:
        """The rooms that come with the package, or some of them.

        >>> SceneSet.bundled().names
        ('bathroom', 'bedroom', 'kitchen', 'living_room')
        """
        return cls(Scene.bundled(name) for name in (bundled_names() if names is None else listed(names)))

    @classmethod
    def open(cls, scenes: Sources, skip_broken: bool = False, lazy: bool | None = None) -> SceneSet:
        """Open bundled names and files alike: ``SceneSet.open(["bathroom", "my_room.h5"])``.

        Scenes of the same name, such as rooms of a kind from several seeds, are renamed after their files.

        Args:
            scenes: names, files, folders of scene files (``rooms/``) and patterns (``rooms/*_small.h5``).
            skip_broken: leave out files with faults, with a warning that names them.
            lazy: leave features in the files until they are asked for, scene by scene; a fault of theirs is
                found then, or here with ``skip_broken``. None: for 100 scenes or more.

        Raises:
            SceneError: there is no such scene or file, or the file has faults.

        >>> SceneSet.open("kitchen").num_states
        680
        """
        sources, opened = open_scenes(scenes, skip_broken, lazy)
        found = cls(opened)
        found.sources = tuple(sources)
        return found

    @property
    def is_lazy(self) -> bool:
        """Whether features are read from the files when they are asked for."""
        return isinstance(self.features, LazyFeatures)

    @property
    def num_scenes(self) -> int:
        """Number of scenes."""
        return len(self.scenes)

    @property
    def num_states(self) -> int:
        """S, the number of states of all scenes."""
        return self.successor.shape[0]

    @property
    def num_actions(self) -> int:
        """A."""
        return self.successor.shape[1]

    @property
    def actions(self) -> tuple[str, ...]:
        """Names of the A actions."""
        return self.scenes[0].actions

    @property
    def num_crops(self) -> int:
        """C."""
        return self.scenes[0].num_crops

    @property
    def feature_size(self) -> int:
        """F."""
        return self.scenes[0].feature_size

    @property
    def device(self) -> torch.device:
        """Device of the tables."""
        return self.successor.device

    @property
    def distance_tables(self) -> tuple[Tensor, Tensor]:
        """The scenes' tables (N, N) of shortest paths, flattened and concatenated; made at each call.

        Entry ``first[i] + s * N + g`` of the first tensor is the distance from s to g, local ids, in actions.
        The second tensor is ``first``, (n_scenes + 1,). A single scene's table is shared, not copied.
        """
        tables = [scene.distance.numpy().ravel() for scene in self.scenes]
        first = torch.from_numpy(np.cumsum([0, *(len(table) for table in tables)]))
        return _joined(tables).to(self.device), first.to(self.device)

    def distance(self, state: Any, goal: Any) -> Tensor:
        """Lengths of the shortest paths from states to goals, global ids of shapes that broadcast.

        Returns:
            int64 of the broadcast shape, in actions; -1 where the goal is unreachable or in another scene.
        """
        state, goal = torch.broadcast_tensors(self.known(state), self.known(goal))
        scene = torch.where(self.scene_id[state] == self.scene_id[goal], self.scene_id[state], -1).cpu()
        found = torch.full_like(scene, -1)
        for index in scene.unique().tolist():
            if index >= 0:
                rows, first = scene == index, int(self.offsets[index])
                local = (ids.cpu()[rows] - first for ids in (state, goal))
                found[rows] = self.scenes[index].path_lengths(*local)
        return found.to(self.device)

    def scene_index(self, scene: str | int) -> int:
        """Index of a scene, given by name or by index.

        Raises:
            SceneError: there is no such scene.
        """
        if isinstance(scene, str):
            if scene not in self.names:
                raise SceneError(f"no scene is called {scene!r}; this set has {listing(self.names)}")
            return self.names.index(scene)
        if not 0 <= scene < self.num_scenes:
            raise SceneError(f"there is no scene {scene}; this set has the scenes 0..{self.num_scenes - 1}")
        return int(scene)

    def global_id(self, scene: str | int, local: Any) -> Tensor:
        """Global ids of a scene's local ids, of any shape; the scene is given by name or index.

        Raises:
            SceneError: there is no such scene or state.

        >>> SceneSet.bundled().global_id("bedroom", [0, 3]).tolist()
        [176, 179]
        """
        index = self.scene_index(scene)
        ids = torch.as_tensor(local, dtype=torch.int64, device=self.device)
        name, last = self.names[index], self.scenes[index].num_states - 1
        wrong = ids[(ids < 0) | (ids > last)]
        if wrong.numel():
            raise SceneError(f"scene {name!r} has no state {int(wrong[0])}; its states are 0..{last}")
        return ids + self.offsets[index]

    def local_id(self, ids: Any) -> Tensor:
        """Local ids of global ids of any shape; the inverse of :meth:`global_id`.

        >>> SceneSet.bundled().local_id([0, 176, 179]).tolist()
        [0, 0, 3]
        """
        ids = self.known(ids)
        return ids - self.offsets[self.scene_id[ids]]

    def known(self, ids: Any) -> Tensor:
        """Global ids of any shape as int64 on the set's device; one that is no state is a SceneError."""
        ids = torch.as_tensor(ids, dtype=torch.int64, device=self.device)
        wrong = ids[(ids < 0) | (ids >= self.num_states)]
        if wrong.numel():
            raise SceneError(f"there is no state {int(wrong[0])}; this set has 0..{self.num_states - 1}")
        return ids

    def pictures(self, ids: Any) -> Tensor:
        """Read the pictures of states from the scenes' files.

        Args:
            ids: global ids of any shape.

        Returns:
            (*ids.shape, H, W, 3) uint8 on the CPU.

        Raises:
            SceneError: a state does not exist, a scene has no pictures, or their sizes differ.
        """
        ids = self.known(ids).cpu()
        flat = ids.reshape(-1).numpy()
        offsets = self.offsets.cpu().numpy()
        scene_id = np.searchsorted(offsets, flat, side="right") - 1
        indices = np.unique(scene_id).tolist() or [0]
        first = self.scenes[indices[0]]
        result = np.empty((len(flat), *(first.picture_shape or ())), dtype=np.uint8)
        for index in indices:
            scene, rows = self.scenes[index], scene_id == index
            if scene.picture_shape != first.picture_shape and scene.has_pictures and first.has_pictures:
                raise SceneError(
                    f"scenes {first.name!r} and {scene.name!r} have pictures of different sizes"
                    f" ({first.picture_shape}, {scene.picture_shape}); ask scene by scene"
                )
            result[rows] = scene.pictures(flat[rows] - offsets[index]).numpy()
        return torch.from_numpy(result).reshape(*ids.shape, *result.shape[1:])

    def to(self, device: torch.device | str) -> SceneSet:
        """The same set with its tables on a device; the scenes stay on the CPU."""
        moved = object.__new__(SceneSet)
        for name, value in vars(self).items():
            setattr(moved, name, value.to(device) if isinstance(value, Tensor) else value)
        return moved

    @property
    def fingerprint(self) -> str:
        """16 hexadecimal digits that change with any name, graph or feature; the same on every machine.

        >>> SceneSet.bundled(["bathroom"]).fingerprint == SceneSet.open("bathroom").fingerprint
        True
        """
        known: list[str] = self.__dict__.setdefault("_known", [])  # copies on other devices share it
        if not known:
            known.append(self.features.summary.fingerprint if self.is_lazy else fingerprint(self.scenes))
        return known[0]

    def __getstate__(self) -> dict[str, Any]:
        # the scenes only; the tables are rebuilt from them
        return {"scenes": self.scenes, "device": str(self.device)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.scenes = state["scenes"]
        self._build()
        self.__dict__.update(self.to(state["device"]).__dict__)

    def __repr__(self) -> str:
        return f"SceneSet({listing(f'{scene.name}: {scene.num_states}' for scene in self.scenes)})"


def _joined(arrays: list[np.ndarray]) -> Tensor:
    """Concatenated arrays; a single one is shared, not copied."""
    return torch.from_numpy(np.concatenate(arrays) if len(arrays) > 1 else arrays[0])
