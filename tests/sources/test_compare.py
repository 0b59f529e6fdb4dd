"""Two scenes side by side."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from vusfa.errors import SceneError
from vusfa.scenes import Scene
from vusfa.sources.compare import compare

MakeScene = Callable[..., Scene]


def altered(scene: Scene, **changes: torch.Tensor) -> Scene:
    parts = {name: getattr(scene, name).clone() for name in ("graph", "features", "location", "rotation")}
    return Scene(scene.name, **{**parts, **changes})


def test_graph_and_poses_are_told_apart(make_scene: MakeScene) -> None:
    scene = make_scene()
    assert compare(scene, altered(scene)).same_room
    graph = scene.graph.clone()
    graph[0, 1] = 0
    found = compare(scene, altered(scene, graph=graph))
    assert (found.graph, found.poses, found.same_room) == (False, True, False)
    for name in ("location", "rotation"):
        found = compare(scene, altered(scene, **{name: getattr(scene, name) + 0.001}))
        assert (found.graph, found.poses, found.same_room) == (True, False, False)


def test_features_are_compared_state_by_state(make_scene: MakeScene) -> None:
    scene = make_scene()
    features = 2 * scene.features
    features[3] = torch.tensor([1.0, -1.0]).repeat(4)
    features[3] -= (
        (features[3] * scene.features[3]).sum() / scene.features[3].square().sum() * scene.features[3]
    )
    found = compare(scene, altered(scene, features=features))
    assert not found.features
    assert found.least_cosine == pytest.approx(0.0, abs=1e-6)
    assert found.cosine == pytest.approx(15 / 16)
    assert found.pixels is None
    found = compare(scene, altered(scene, features=features[:, :, 1:]))
    assert (found.cosine, found.least_cosine, found.features) == (None, None, False)


def test_pictures_are_compared_state_by_state(make_scene: MakeScene, tmp_path: Path) -> None:
    scene = make_scene(width=5, height=5)  # more states than are read at a time
    pictures = np.random.default_rng(0).integers(100, 200, (100, 6, 8, 3), dtype=np.uint8)
    other = pictures.copy()
    other[70] += 10
    other[99, 0] -= 3
    loaded = []
    for name, of in (("one", pictures), ("other", other), ("small", pictures[:, 1:])):
        scene.save(tmp_path / f"{name}.h5", of)
        loaded.append(Scene.load(tmp_path / f"{name}.h5"))
    found = compare(*loaded[:2])
    assert found.pixels == pytest.approx((10 + 3 / 6) / 100)
    assert found.most_pixels == pytest.approx(10)
    assert compare(loaded[0], loaded[2]).pixels is None


def test_rooms_of_other_sizes_are_not_compared(make_scene: MakeScene) -> None:
    with pytest.raises(SceneError, match="have 16 and 24 states and cannot be compared"):
        compare(make_scene(), make_scene(height=3))
