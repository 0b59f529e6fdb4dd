"""Reference baselines: random walk and shortest path.

In rooms of a few hundred states a random walk reaches many goals within 500 actions. A success rate means
little without that number beside it; it is computed exactly, not sampled.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from vusfa.evaluation.episodes import Episodes
from vusfa.evaluation.starts import Unreachable
from vusfa.scenes import Scene
from vusfa.scenes.markov import random_walk_success

__all__ = ["RANDOM_WALK", "SHORTEST_PATH", "random_walk", "shortest_paths"]

RANDOM_WALK, SHORTEST_PATH = "random walk", "shortest path"


def random_walk(scene: Scene, goals: Tensor, steps: int, unreachable: Unreachable = "skip") -> Tensor:
    """Exact success of the uniformly random policy within ``steps`` actions, per goal.

    Args:
        scene: the room.
        goals: (G,) state ids within the scene.
        steps: limit of actions.
        unreachable: see :func:`~vusfa.evaluation.episode_starts`.

    Returns:
        (G,) float64; NaN for a goal that gets no episode.

    >>> from vusfa.scenes import SceneSet
    >>> bathroom = SceneSet.bundled(["bathroom"]).scenes[0]
    >>> round(random_walk(bathroom, torch.arange(bathroom.num_states), 500).mean().item(), 3)
    0.566
    """
    success = random_walk_success(scene.graph, goals, steps)
    if unreachable == "skip":
        return success
    reaching = (scene.distances_to(goals) > 0).sum(1)
    return torch.nan_to_num(success) * reaching / (scene.num_states - 1)


def shortest_paths(episodes: Episodes) -> Episodes:
    """The same episodes, each along a shortest path: no policy does better.

    >>> one = torch.tensor([1])
    >>> lost = Episodes(one * 0, one, one, one < 0, one * 500, one * 4, one * 9, one > 0, ("hall",), 500)
    >>> best = shortest_paths(lost)
    >>> best.success.tolist(), best.length.tolist(), best.collisions.tolist()
    ([True], [4], [0])
    """
    possible = (episodes.shortest > 0) & (episodes.shortest <= episodes.max_steps)
    return replace(
        episodes,
        success=possible,
        length=torch.where(possible, episodes.shortest, episodes.max_steps),
        collisions=torch.zeros_like(episodes.collisions),
        remaining=torch.where(possible, 0, episodes.shortest),
    )
