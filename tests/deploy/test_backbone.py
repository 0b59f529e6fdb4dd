from __future__ import annotations

from typing import Any

import pytest
import torch

from vusfa.deploy.backbone import find_backbone
from vusfa.errors import ConfigError
from vusfa.scenes import Scene, SceneSet


def test_the_backbone_of_a_map_is_found_by_the_attributes() -> None:
    pytest.importorskip("efficientnet_lite_pytorch")
    told: dict[str, Any] = {"feature_backbone": "efficientnet-lite0"}
    told |= {"feature_layer": "_blocks.14", "feature_grid": "3x4"}
    graph, features = torch.tensor([[-1]]), torch.rand(1, 1, 2304)
    room = SceneSet([Scene("hall", graph, features, actions=("stay",), attributes=told)])
    found = find_backbone(room)
    assert (found.layer, found.grid) == ("_blocks.14", (3, 4))
    assert found(torch.zeros(1, 3, 224, 224)).shape == (1, room.feature_size)
    with pytest.raises(ConfigError, match=r"features of layer '_blocks\.14', not 'pooled features'"):
        find_backbone(room, "efficientnet-lite0")
