"""A scene in numbers: how large it is, how far its ways are, how well a random walk does."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import torch

from vusfa.scenes.graph import random_walk_success
from vusfa.scenes.poses import places
from vusfa.scenes.scene import Scene

__all__ = ["Summary", "summarise"]


@dataclass(frozen=True)
class Summary:
    """Size and difficulty of one scene.

    Attributes:
        name: the scene's.
        states, cells, actions, crops, features: how many poses, distinct places, actions, crops of each
            picture, and numbers a crop.
        islands: how many parts of the graph are cut off from the largest.
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
    picture_shape: tuple[int, int, int] | None
    walk_steps: int
    random_walk: float
    mean_path: float
    longest_path: int

    def plain(self) -> dict[str, Any]:
        """For JSON: NaN becomes None."""
        fields = dataclasses.asdict(self)
        return {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in fields.items()}


def summarise(scene: Scene, walk_steps: int = 500) -> Summary:
    """Measure a scene; seconds for some thousand states.

    Args:
        scene: the scene.
        walk_steps: actions that the random walk has.

    >>> room = summarise(Scene.bundled("bathroom"))
    >>> room.states, room.cells, room.islands, room.longest_path, round(room.random_walk, 3)
    (176, 44, 0, 21, 0.566)
    """
    walk = random_walk_success(scene.graph, torch.arange(scene.num_states), walk_steps)
    paths = scene.distance[scene.distance > 0].double()
    return Summary(
        name=scene.name,
        states=scene.num_states,
        cells=len(places(scene.location)),
        actions=scene.num_actions,
        crops=scene.num_crops,
        features=scene.feature_size,
        islands=len(scene.islands),
        picture_shape=scene.picture_shape,
        walk_steps=walk_steps,
        random_walk=float(walk.nanmean()),
        mean_path=float(paths.mean()),
        longest_path=int(paths.max()) if len(paths) else 0,
    )
