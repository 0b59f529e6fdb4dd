from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from tensordict import TensorDict

from vusfa.modules import Agent, make_agent
from vusfa.scenes import Scene, SceneSet

SMALL = {"hidden_size": 16, "embedding_size": 16}


def ring(name: str, num_states: int, seed: int) -> Scene:
    """A ring of states: action 0 onwards, 1 back, 2 and 3 blocked; features of two crops, 12 numbers each."""
    states = torch.arange(num_states)
    blocked = torch.full_like(states, -1)
    graph = torch.stack([(states + 1) % num_states, (states - 1) % num_states, blocked, blocked], -1)
    generator = torch.Generator().manual_seed(seed)
    return Scene(name, graph, torch.randn(num_states, 2, 12, generator=generator).abs())


@pytest.fixture(scope="session")
def scenes() -> SceneSet:
    """Three rooms of 7, 9 and 5 states."""
    return SceneSet([ring("hall", 7, 1), ring("attic", 9, 2), ring("cellar", 5, 3)])


@pytest.fixture(scope="session")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> SceneSet:
    """A room of 6 states with pictures of 50 x 60 pixels."""
    import h5py

    path = tmp_path_factory.mktemp("filmed") / "studio.h5"
    ring("studio", 6, 4).save(path)
    pictures = np.random.default_rng(5).integers(0, 256, (6, 8, 9, 3), dtype=np.uint8)
    large = [np.asarray(Image.fromarray(picture).resize((60, 50))) for picture in pictures]
    with h5py.File(path, "a") as file:
        file["observation"] = np.stack(large)
    return SceneSet([Scene.load(path)])


@pytest.fixture
def small_agent(scenes: SceneSet) -> Callable[..., Agent]:
    """``make_agent`` in these rooms with layers of 16, from a fixed seed."""

    def make(
        model: str = "vusfa", architecture: str = "controlled", seed: int = 0, **overrides: Any
    ) -> Agent:
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            return make_agent(model, architecture, overrides.pop("scenes", scenes), **{**SMALL, **overrides})

    return make


@pytest.fixture
def make_batch(scenes: SceneSet) -> Callable[..., TensorDict]:
    """Random histories and goals, each row within one room."""

    def make(*batch: int, history: int = 4, world: SceneSet | None = None, seed: int = 0) -> TensorDict:
        world = world or scenes
        generator = torch.Generator().manual_seed(seed)
        scene_id = torch.randint(world.num_scenes, batch, generator=generator)
        first, size = world.offsets[scene_id], world.offsets[scene_id + 1] - world.offsets[scene_id]
        draw = torch.rand(*batch, history + 1, generator=generator)
        ids = first.unsqueeze(-1) + (draw * size.unsqueeze(-1)).long()
        return TensorDict({"state_id": ids[..., :-1], "goal_id": ids[..., -1], "scene_id": scene_id}, batch)

    return make
