"""Scenes of one's own are trained on: encoded anew, exported, rendered."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from vusfa.scenes import Scene
from vusfa.sources import thor
from vusfa.sources.backbones import Backbone
from vusfa.sources.crops import Preprocessing
from vusfa.sources.encode import encode_scene
from vusfa.sources.render import flat, render_room

THUMBNAIL = Backbone(
    "thumbnail", "pixels", "", Preprocessing(size=4), lambda images: images.flatten(1).clone()
)


class Simulator:
    """Answers as AI2-THOR's controller does, of a scene's places and graph; pictures are of one colour."""

    def __init__(self, room: Scene) -> None:
        self.room, self.state = room, 0

    def step(self, *, action: str, **arguments: Any) -> SimpleNamespace:
        success, found = True, None
        if action == "GetReachablePositions":
            found = [{"x": x, "y": 0.9, "z": z} for x, z in {tuple(at) for at in self.room.location.tolist()}]
        elif action == "Teleport":
            at = torch.tensor([arguments["position"]["x"], arguments["position"]["z"]])
            gap = (self.room.location - at).abs().sum(1)
            self.state = int((gap + (self.room.rotation - arguments["rotation"]["y"]).abs()).argmin())
        else:
            target = int(self.room.graph[self.state, list(thor.ACTIONS.values()).index(action)])
            success = target >= 0
            self.state = target if success else self.state
        x, z = self.room.location[self.state].tolist()
        agent = {"position": {"x": x, "z": z}, "rotation": {"y": float(self.room.rotation[self.state])}}
        metadata = {"lastActionSuccess": success, "actionReturn": found, "agent": agent}
        frame = np.full((12, 16, 3), 15 * self.state, np.uint8)
        return SimpleNamespace(metadata=metadata, frame=frame)


@pytest.fixture
def trains(
    recipe: Callable[[str], Any], settings: Callable[..., Any], small: list[str], tmp_path: Path
) -> Callable[[Path], Any]:
    """Trains on a scene file for 20 updates; the trainer."""

    def train(path: Path) -> Any:
        options = [f"scenes=[{path}]", f"folder={tmp_path / 'run'}"]
        trainer, _, code = recipe("train").train(settings(*small, *options), options)
        assert (trainer.updates, code) == (20, 0)
        assert all(bool(parameter.isfinite().all()) for parameter in trainer.agent.parameters())
        return trainer

    return train


def test_a_scene_encoded_anew(trains: Callable[[Path], Any], scene_file: Path, tmp_path: Path) -> None:
    network = Backbone(
        "pixels", "all", "", Preprocessing(size=4, crops="ten", resize=6), lambda images: images.flatten(1)
    )
    scene = encode_scene(scene_file, tmp_path / "ten.h5", network)
    assert (scene.num_crops, scene.feature_size) == (10, 48)
    assert torch.equal(trains(tmp_path / "ten.h5").scenes.features.cpu(), scene.features)


def test_a_scene_of_a_simulator(
    trains: Callable[[Path], Any], make_scene: Callable[..., Scene], tmp_path: Path
) -> None:
    controller = Simulator(make_scene())
    thor.export(controller, tmp_path / "thor.h5", name="FloorPlan1", backbone=THUMBNAIL)
    assert trains(tmp_path / "thor.h5").scenes.features.shape == (16, 1, 48)


@pytest.mark.render
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # what imports do in compiled modules of others
def test_a_rendered_flat(trains: Callable[[Path], Any], tmp_path: Path) -> None:
    drawn = flat(["hall", "bathroom"], 1, 24)
    plan = replace(drawn, camera=replace(drawn.camera, resolution=(32, 24), samples=1))
    made = render_room(plan, tmp_path / "flat.h5", backbone=THUMBNAIL)
    assert trains(tmp_path / "flat.h5").scenes.features.shape == (made.states, 1, 48)
