"""A navigator as ONNX: the same numbers over a walk, at any batch size, by torch's file and without torch."""

from __future__ import annotations

import ast
import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from vusfa.deploy import Navigator
from vusfa.deploy.export import export_onnx, largest_difference
from vusfa.deploy.graph import _windows
from vusfa.errors import ConfigError
from vusfa.modules.frames import shrink_pictures
from vusfa.sources.backbones import load_backbone

EXAMPLE = Path(__file__).parents[2] / "examples" / "deploy" / "run_onnx.py"


@pytest.fixture(scope="module")
def exported(_rooms: Any, tmp_path_factory: pytest.TempPathFactory) -> Any:
    from tests.deploy.conftest import World, patches

    world = World(tmp_path_factory.mktemp("onnx"), *_rooms, patches())
    path = world.checkpoint("vusfa", history=3)
    navigator = Navigator.load(path, scenes=world.scenes, backbone=world.backbone, sample=False)
    return navigator, export_onnx(navigator, world.folder / "agent.onnx")


def test_onnx_runtime_gives_pytorchs_numbers_over_a_walk(exported: Any) -> None:
    navigator, path = exported
    pictures = [navigator.scenes.pictures(state) for state in (3, 7, 11, 10, 9)]
    assert largest_difference(navigator, path, navigator.scenes.pictures(12), pictures) < 1e-5


def test_rows_of_a_batch_do_not_see_each_other(exported: Any) -> None:
    runtime = pytest.importorskip("onnxruntime")
    path = exported[1]
    session, draw = runtime.InferenceSession(path), np.random.default_rng(0)
    shapes = {
        one.name: [5 if side == "batch" else side for side in one.shape] for one in session.get_inputs()
    }
    rows = {name: draw.standard_normal(shape).astype(np.float32) for name, shape in shapes.items()}
    rows["picture"] = draw.integers(256, size=shapes["picture"], dtype=np.uint8)
    rows["room"] = np.array([0, 1, 1, 0, 1])
    rows["started"] = np.array([True, True, False, False, True])
    together = session.run(None, rows)
    for row in range(5):
        alone = session.run(None, {name: value[row : row + 1] for name, value in rows.items()})
        for one, many in zip(alone, together, strict=True):
            np.testing.assert_allclose(one[0], many[row], atol=1e-5)


def test_an_agent_that_remembers_and_learns_from_pictures_runs_without_torch(
    world: Any, tmp_path: Path
) -> None:
    path = world.checkpoint("usfa", memory="lstm", encoder="conv", picture_size=[36, 40], history=2)
    navigator = Navigator.load(path, scenes=world.scenes, sample=False)
    path = export_onnx(navigator, tmp_path / "agent.onnx")
    pictures = [world.scenes.pictures(state) for state in (3, 7, 11, 10, 9)]
    assert largest_difference(navigator, path, world.scenes.pictures(12), pictures) < 1e-5
    kept = {"started", "history", "recurrent_state_h", "recurrent_state_c"}
    assert check_example(navigator, path, tmp_path) == kept


@pytest.mark.parametrize(("size", "number"), [(48, 36), (64, 40), (150, 60), (40, 40), (36, 50)])
def test_pictures_are_averaged_to_the_last_bit_as_the_agent_averages_them(size: int, number: int) -> None:
    pixels = torch.randint(256, (1, 3, size, size), generator=torch.Generator().manual_seed(0)).to(
        torch.uint8
    )
    windows = _windows(size, number)
    sums = windows @ pixels.float() @ windows.T
    found = (sums / windows.sum(1)[:, None] / windows.sum(1)).round().to(torch.uint8)
    assert torch.equal(found, shrink_pictures(pixels, (number, number)))


def test_the_metadata_say_what_a_program_needs(exported: Any) -> None:
    runtime = pytest.importorskip("onnxruntime")
    navigator, path = exported
    meta = runtime.InferenceSession(path).get_modelmeta().custom_metadata_map
    assert json.loads(meta["actions"]) == list(navigator.actions)
    assert (json.loads(meta["scenes"]), json.loads(meta["aspect"])) == (["hall", "attic"], [64, 48])
    assert float(meta["arrived"]) == navigator.threshold
    assert (meta["size"], meta["backbone"]) == ("[8, 8]", "patches")
    assert int(meta["history"]) == navigator.agent.config["history"]


def test_the_example_imports_no_torch() -> None:
    source = EXAMPLE.read_text(encoding="utf-8")
    assert len(source.splitlines()) <= 40
    imported = {
        name.name
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Import)
        for name in node.names
    }
    assert not {"torch", "vusfa"} & imported


def check_example(navigator: Navigator, path: Path, folder: Path) -> set[str]:
    """Compare the example's lines with the navigator's actions; return what the file keeps."""
    (folder / "seen").mkdir(parents=True)
    expected = []
    Image.fromarray(navigator.scenes.pictures(12).numpy()).save(folder / "goal.png")
    navigator.goal(folder / "goal.png")
    for number, state in enumerate((3, 8, 12)):
        picture = folder / "seen" / f"{number}.png"
        Image.fromarray(navigator.scenes.pictures(state).numpy()).save(picture)
        found = navigator.act(picture)
        expected.append(f"{picture.name}  {found.name}  {found.confidence:.3f}" + "  arrived" * found.arrived)
    arguments = [sys.executable, EXAMPLE, path, folder / "goal.png", folder / "seen"]
    run = subprocess.run(arguments, capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr) == (0, "")
    assert run.stdout.splitlines() == expected
    assert [line.endswith("arrived") for line in expected] == [False, False, True]
    inputs = pytest.importorskip("onnxruntime").InferenceSession(path).get_inputs()
    return {one.name for one in inputs} - {"picture", "goal", "room"}


def test_the_example_without_torch_prints_the_navigators_actions(exported: Any, tmp_path: Path) -> None:
    assert check_example(*exported, tmp_path) == {"started", "history"}


def test_onnx_runtime_is_told_to_report_nothing(exported: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    navigator, path = exported
    monkeypatch.delenv("ORT_DISABLE_TELEMETRY", raising=False)
    largest_difference(navigator, path, navigator.scenes.pictures(12), [])
    assert os.environ.pop("ORT_DISABLE_TELEMETRY") == "1"
    load_backbone(path)
    assert os.environ["ORT_DISABLE_TELEMETRY"] == "1"


def test_what_cannot_be_exported_is_said_before_any_work(world: Any, tmp_path: Path) -> None:
    out = tmp_path / "agent.onnx"
    options: dict[str, Any] = {"scenes": world.scenes, "backbone": world.backbone}
    navigator = Navigator.load(world.checkpoint(), **options)
    with pytest.raises(ConfigError, match=re.escape(f"{tmp_path}: is a folder")):
        export_onnx(navigator, tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="is not a folder; give another"):
        export_onnx(navigator, tmp_path / "file" / "agent.onnx")
    navigator.backbone = replace(world.backbone, network=lambda images: images)
    with pytest.raises(ConfigError, match="backbone patches is a file of a finished network"):
        export_onnx(navigator, out)
    remembering = Navigator.load(world.checkpoint(memory="lstm", previous_action=True), **options)
    with pytest.raises(ConfigError, match="an ONNX file is not told the action before"):
        export_onnx(remembering, out)
    assert not out.exists()
