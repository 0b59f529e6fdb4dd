"""Scene.from_arrays."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from vusfa.errors import SceneError
from vusfa.scenes import Scene, validate

GRAPH = np.array([[1, -1], [2, 0], [-1, 1]])
PICTURES = np.random.default_rng(0).integers(0, 256, (3, 8, 12, 3), np.uint8)


def test_what_is_written_is_what_was_given(tmp_path: Path) -> None:
    given: dict[str, Any] = {
        "location": torch.tensor([[0.0, 0.0], [0.0, 0.5], [0.0, 1.0]]),
        "rotation": [0.0, 0.0, 90.0],
        "actions": ["ahead", "back"],
        "attributes": {"made_by": "a test"},
    }
    features = np.random.default_rng(1).normal(size=(3, 10, 4)).astype(np.float32)
    scene = Scene.from_arrays(
        tmp_path / "hall.h5", GRAPH, features, pictures=PICTURES, name="hall 7", **given
    )
    assert validate(tmp_path / "hall.h5") == []
    assert (scene.name, scene.actions, scene.path) == ("hall 7", ("ahead", "back"), tmp_path / "hall.h5")
    assert scene.graph.tolist() == GRAPH.tolist()
    np.testing.assert_array_equal(scene.features, features)
    assert torch.equal(scene.location, given["location"])
    assert scene.rotation.tolist() == given["rotation"]
    assert scene.distance.tolist() == [[0, 1, 2], [1, 0, 1], [2, 1, 0]]
    np.testing.assert_array_equal(scene.pictures([2, 0]), PICTURES[[2, 0]])
    assert scene.attributes["made_by"] == "a test"


def test_features_made_of_the_pictures(tmp_path: Path) -> None:
    def mean_color(pictures: np.ndarray) -> np.ndarray:
        return pictures.mean((1, 2))

    scene = Scene.from_arrays(tmp_path / "a.h5", GRAPH, mean_color, pictures=PICTURES, actions=["a", "b"])
    np.testing.assert_allclose(scene.features[:, 0], PICTURES.mean((1, 2)), rtol=1e-6)


@pytest.mark.parametrize(
    ("changed", "fault"),
    [
        ({"features": np.eye(2)}, "resnet_feature"),
        ({"features": np.full((3, 4), np.nan)}, "resnet_feature"),
        ({"features": len}, "features are a function of pictures; give pictures, too"),
        ({"graph": [[1, -1], [5, 0], [0, 0]]}, "action 0 leads to 5"),
        ({"pictures": PICTURES[:2]}, "2 pictures for 3 states"),
        ({"pictures": PICTURES.astype(np.float32)}, "give uint8"),
        ({"location": np.zeros((2, 2))}, "location"),
        ({"actions": ["one"]}, "actions"),
    ],
)
def test_arguments_that_do_not_fit(tmp_path: Path, changed: dict[str, Any], fault: str) -> None:
    given = {"graph": GRAPH, "features": np.eye(3), "actions": ["a", "b"], **changed}
    with pytest.raises(SceneError, match=fault):
        Scene.from_arrays(tmp_path / "a.h5", **given)
    assert list(tmp_path.iterdir()) == []
