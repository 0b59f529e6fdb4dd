"""Statistics of a scene: size, path lengths, look-alikes, success of a random walk."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from vusfa.deprecated import moved_names
from vusfa.scenes.markov import random_walk_success
from vusfa.scenes.poses import places
from vusfa.scenes.scene import Scene

__all__ = ["LOOK_ALIKE", "Group", "Summary", "by_name", "look_alike_share", "summarize"]

#: Two states whose features' cosine is at least this look alike.
LOOK_ALIKE = 0.999


@dataclass(frozen=True)
class Summary:
    """Size and difficulty of one scene.

    Attributes:
        name: the scene's.
        states, cells, actions, crops, features: how many poses, distinct places, actions, crops of each
            picture, and numbers per crop.
        islands: how many parts of the graph are cut off from the largest.
        look_alikes: share of states that some other state looks like (:func:`look_alike_share`).
        picture_shape: (H, W, 3), or None.
        walk_steps: actions that the random walk has.
        random_walk: exact success of a random walk, the mean over all goals that can be reached; NaN without
            any.
        mean_path, longest_path: shortest paths over all pairs of different states with one, in actions; NaN
            and 0 without any.
    """

    name: str
    states: int
    cells: int
    actions: int
    crops: int
    features: int
    islands: int
    look_alikes: float
    picture_shape: tuple[int, int, int] | None
    walk_steps: int
    random_walk: float
    mean_path: float
    longest_path: int

    def plain(self) -> dict[str, Any]:
        """For JSON: NaN becomes None."""
        fields = dataclasses.asdict(self)
        return {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in fields.items()}


def summarize(scene: Scene, walk_steps: int = 500) -> Summary:
    """Measure a scene; seconds for some thousand states.

    Args:
        scene: the scene.
        walk_steps: actions that the random walk has.

    >>> room = summarize(Scene.bundled("bathroom"))
    >>> room.states, room.cells, room.islands, room.look_alikes, room.longest_path, round(room.random_walk, 3)
    (176, 44, 0, 0.0, 21, 0.566)
    """
    walk = random_walk_success(scene.graph, torch.arange(scene.num_states), walk_steps)
    total = count = 0
    for part in scene.all_distances():
        total, count = total + int(part[part > 0].sum()), count + int((part > 0).sum())
    return Summary(
        name=scene.name,
        states=scene.num_states,
        cells=len(places(scene.location)),
        actions=scene.num_actions,
        crops=scene.num_crops,
        features=scene.feature_size,
        islands=len(scene.islands),
        look_alikes=look_alike_share(scene.features.numpy()),
        picture_shape=scene.picture_shape,
        walk_steps=walk_steps,
        random_walk=float(walk.nanmean()),
        mean_path=total / count if count else math.nan,
        longest_path=scene.longest_path,
    )


def look_alike_share(features: np.ndarray) -> float:
    """Share of states whose features have a cosine of 0.999 or more with those of another state.

    Args:
        features: (N, F), or (N, C, F) with all crops side by side.

    >>> look_alike_share(np.array([[1.0, 0.0], [2.0, 0.0], [0.0, 1.0], [0.5, 0.5]]))
    0.5
    """
    flat = features.reshape(len(features), -1).astype(np.float64)
    flat = flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
    alike = 0
    for first in range(0, len(flat), 1024):
        cosine = flat[first : first + 1024] @ flat.T
        rows = np.arange(len(cosine))
        cosine[rows, first + rows] = -1.0
        alike += int((cosine.max(axis=1) >= LOOK_ALIKE).sum())
    return alike / len(flat)


@dataclass(frozen=True)
class Group:
    """Look-alikes over all scenes of one name.

    Attributes:
        name: theirs.
        scenes: how many there are.
        states: of all of them.
        look_alikes: share of these states that another of the same scene looks like.
        most: the share in the scene that has most of them.
    """

    name: str
    scenes: int
    states: int
    look_alikes: float
    most: float


def by_name(found: Sequence[Summary]) -> list[Group]:
    """Look-alikes per name of a scene, in the order in which the names appear.

    >>> room = summarize(Scene.bundled("bathroom"))
    >>> by_name([room, dataclasses.replace(room, look_alikes=0.5)])
    [Group(name='bathroom', scenes=2, states=352, look_alikes=0.25, most=0.5)]
    """
    groups = []
    for name in dict.fromkeys(summary.name for summary in found):
        mine = [summary for summary in found if summary.name == name]
        states = sum(summary.states for summary in mine)
        alike = sum(summary.look_alikes * summary.states for summary in mine) / states
        groups.append(Group(name, len(mine), states, alike, max(summary.look_alikes for summary in mine)))
    return groups


__getattr__ = moved_names(__name__, {"summarise": "vusfa.sources.summary.summarize"})
