"""Two small rooms with pictures and features by a small network, and agents of these rooms as checkpoints."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from vusfa.modules import make_agent
from vusfa.scenes import Scene, SceneSet
from vusfa.sources.backbones import Backbone
from vusfa.sources.crops import Preprocessing
from vusfa.sources.encode import encode_pictures
from vusfa.training.checkpoint import save_checkpoint


class Patches(nn.Module):
    """A small network: the mean color of 4 x 4 patches, (n, 48)."""

    def forward(self, images: Tensor) -> Tensor:
        return nn.functional.adaptive_avg_pool2d(images, 4).flatten(1)


def patches() -> Backbone:
    half = (0.5,) * 3
    return Backbone("patches", "colors", "0" * 64, Preprocessing(size=8, mean=half, std=half), Patches())


def draw_pictures(number: int, seed: int) -> Tensor:
    """Pictures of one room, (number, 48, 64, 3) uint8: sixteen fields, most of each color the room's."""
    generator = torch.Generator().manual_seed(seed)
    room, own = (torch.rand(n, 4, 4, 3, generator=generator) for n in (1, number))
    fields = (178 * room + 77 * own).to(torch.uint8)
    return fields.repeat_interleave(12, 1).repeat_interleave(16, 2)


@dataclass
class World:
    """Two rooms on disk, the network of their features, and what makes checkpoints of agents."""

    folder: Path
    files: list[Path]
    scenes: SceneSet
    backbone: Backbone

    def checkpoint(self, model: str = "vusfa", scenes: SceneSet | None = None, **options: Any) -> Path:
        scenes = scenes or self.scenes
        torch.manual_seed(0)
        agent = make_agent(model, scenes=scenes, hidden_size=16, embedding_size=16, **options)
        sources = [str(path) for path in self.files]
        state = {
            "agent_config": agent.config,
            "agent": agent.state_dict(),
            "scenes": {"sources": sources, "names": list(scenes.names), "fingerprint": scenes.fingerprint},
            "goals": torch.tensor([3, 20]),
            "config": {
                "agent": {"model": model, "architecture": "controlled"},
                "algorithm": {"name": "usf"},
                "env": {},
                "seed": 0,
                "threads": 1,
                "autocast": False,
                "total_frames": 0,
            },
            **{"frames": 0, "updates": 0, "seconds": 0.0, "run_id": "", "overrides": []},
            **{"optimizer": {"state": {}, "param_groups": []}, "algorithm": {}, "collector": {}, "rng": {}},
            "meter": {"episodes": {}, "terms": {}},
        }
        return save_checkpoint(self.folder / f"{model}-{len(list(self.folder.glob('*.pt')))}.pt", state)


@pytest.fixture(scope="session")
def _rooms(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Path], SceneSet]:
    from tests.conftest import grid_scene

    folder, backbone, files = tmp_path_factory.mktemp("rooms"), patches(), []
    for seed, (name, width) in enumerate([("hall", 2), ("attic", 3)]):
        plain = grid_scene(name, width=width)
        pictures = draw_pictures(plain.num_states, seed)
        features = torch.from_numpy(encode_pictures(pictures, backbone))
        scene = Scene(
            name, plain.graph, features, plain.location, plain.rotation, attributes=backbone.attributes()
        )
        scene.save(folder / f"{name}.h5", pictures)
        files.append(folder / f"{name}.h5")
    return files, SceneSet.open(files)


@pytest.fixture
def world(_rooms: tuple[list[Path], SceneSet], tmp_path: Path) -> World:
    return World(tmp_path, *_rooms, patches())


@pytest.fixture
def stranger() -> Callable[[], Tensor]:
    """A picture of another room."""
    return lambda: draw_pictures(1, 77)[0]
