"""A room of photographs is trained on."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from typer.testing import CliRunner

from vusfa.cli.app import app
from vusfa.scenes import Scene


def test_from_photographs_to_a_training(
    recipe: Callable[[str], Any],
    settings: Callable[..., Any],
    small: list[str],
    make_scene: Callable[..., Scene],
    tmp_path: Path,
) -> None:
    room, lines = make_scene("hall"), ["file,x,z,heading"]
    for state in range(room.num_states):
        Image.new("RGB", (32, 24), (10 * state, 0, 99)).save(tmp_path / f"{state}.png")
        x, z = room.location[state].tolist()
        lines.append(f"{state}.png,{x},{z},{room.rotation[state]:.0f}")
    (tmp_path / "poses.csv").write_text("\n".join(lines))
    np.save(tmp_path / "features.npy", room.features[:, 0].numpy())
    target = tmp_path / "photos.h5"
    words = ["scenes", "from-photos", tmp_path, "-o", target, "--features", tmp_path / "features.npy"]
    assert CliRunner().invoke(app, [str(word) for word in words]).exit_code == 0
    options = [f"scenes=[{target}]", f"folder={tmp_path / 'run'}"]
    trainer, _, code = recipe("train").train(settings(*small, *options), options)
    assert (trainer.updates, code) == (20, 0)
    assert trainer.scenes.names == ("photos",)
