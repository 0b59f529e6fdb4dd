"""Scenes in numbers: states that look alike. Islands, places and paths are tested with the poses."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from vusfa.scenes import Scene
from vusfa.sources.summary import by_name, look_alike_share, summarize


def test_look_alikes_are_counted_by_the_nearest_other_state() -> None:
    rng = np.random.default_rng(0)
    features = rng.standard_normal((1500, 2, 16))
    assert look_alike_share(features) == 0.0
    features[1400] = 3.0 * features[7]
    features[1401] = features[7] + 1e-4
    features[20] = features[21] * (1 + 1e-6)
    assert look_alike_share(features) == pytest.approx(5 / 1500)


def test_a_cosine_of_0999_is_the_limit() -> None:
    def pair(cosine: float) -> np.ndarray:
        return np.array([[1.0, 0.0], [cosine, np.sqrt(1 - cosine**2)]])

    assert look_alike_share(pair(0.9991)) == 1.0
    assert look_alike_share(pair(0.9989)) == 0.0


def test_scenes_of_a_name_are_counted_together_state_by_state() -> None:
    def line(name: str, states: int, alike: int) -> Scene:
        features = torch.eye(states)
        features[:alike] = features[0].clone()
        graph = torch.stack([torch.arange(1, states + 1) % states, torch.arange(-1, states - 1) % states], 1)
        return Scene(name, graph, features[:, None], actions=("there", "back"))

    scenes = [line("hall", 4, 2), line("attic", 3, 0), line("hall", 12, 0)]
    hall, attic = by_name([summarize(scene) for scene in scenes])
    assert (hall.name, hall.scenes, hall.states, hall.look_alikes, hall.most) == ("hall", 2, 16, 0.125, 0.5)
    assert (attic.name, attic.scenes, attic.states, attic.look_alikes) == ("attic", 1, 3, 0.0)
