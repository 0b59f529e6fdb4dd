"""Scenes of one's own are trained on: features encoded anew, ten crops a state."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from vusfa.scenes.backbones import Backbone
from vusfa.scenes.crops import Preprocessing
from vusfa.scenes.encode import encode_scene


def test_a_scene_encoded_anew(
    recipe: Callable[[str], Any],
    settings: Callable[..., Any],
    small: list[str],
    scene_file: Path,
    tmp_path: Path,
) -> None:
    network = Backbone(
        "pixels", "all", "", Preprocessing(size=4, crops="ten", resize=6), lambda images: images.flatten(1)
    )
    scene = encode_scene(scene_file, tmp_path / "ten.h5", network)
    assert (scene.num_crops, scene.feature_size) == (10, 48)
    options = [f"scenes=[{tmp_path / 'ten.h5'}]", f"folder={tmp_path / 'run'}"]
    session, _, code = recipe("train").train(settings(*small, *options), options)
    assert (session.updates, code) == (20, 0)
    assert all(bool(parameter.isfinite().all()) for parameter in session.agent.parameters())
    assert torch.equal(session.scenes.features.cpu(), scene.features)
