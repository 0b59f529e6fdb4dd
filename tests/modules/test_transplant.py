from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from vusfa.errors import ConfigError
from vusfa.modules import MODELS, InferencePolicy, make_agent, transplant
from vusfa.scenes import Scene, SceneSet

SMALL = {"history": 1, "hidden_size": 8, "embedding_size": 8}


@pytest.fixture
def rooms(make_scene: Callable[..., Scene]) -> SceneSet:
    return SceneSet([make_scene("hall"), make_scene("attic", 3, 1)])


@pytest.mark.parametrize("model", MODELS)
def test_equal_pictures_give_equal_numbers_in_whichever_scene(model: str, rooms: SceneSet) -> None:
    """The attic alone, then as the second of two scenes: the agent does not read where it is."""
    agent = make_agent(model, scenes=rooms, shared_heads=True, **SMALL)
    alone = transplant(agent, SceneSet([rooms.scenes[1]]))
    state, goal = torch.arange(12).unsqueeze(-1), torch.arange(12).flip(0)
    there = InferencePolicy(agent).logits(state + 16, goal + 16, torch.ones(12).long())
    torch.testing.assert_close(InferencePolicy(alone).logits(state, goal, torch.zeros(12).long()), there)
    with torch.no_grad():
        next(alone.parameters()).add_(1.0)
    torch.testing.assert_close(
        InferencePolicy(agent).logits(state + 16, goal + 16, torch.ones(12).long()), there
    )  # a copy


def test_heads_are_one_for_all(rooms: SceneSet) -> None:
    one, each = (make_agent("vusfa", scenes=rooms, shared_heads=flag, **SMALL) for flag in (True, False))
    assert one.scene_layer.linear.weight.shape == (1, 8, 8)
    assert each.scene_layer.linear.weight.shape == (2, 8, 8)
    assert one.num_scenes == 1


def test_what_does_not_fit(rooms: SceneSet, make_scene: Callable[..., Scene]) -> None:
    with pytest.raises(ConfigError, match="shared_heads=true"):
        transplant(make_agent("gvf", scenes=rooms, **SMALL), rooms)
    other = Scene("other", torch.tensor([[1, -1], [0, -1]]), torch.rand(2, 1, 8))
    with pytest.raises(ConfigError, match="4 actions, the scenes have 2"):
        transplant(make_agent("gvf", scenes=rooms, shared_heads=True, **SMALL), SceneSet([other]))
    wider = Scene("wider", make_scene("hall").graph, torch.rand(16, 1, 3))
    with pytest.raises(ConfigError, match="does not fit the scenes' features"):
        transplant(make_agent("gvf", scenes=rooms, shared_heads=True, **SMALL), SceneSet([wider]))
