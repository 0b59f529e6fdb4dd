"""Folders of transformers: with a stand-in of the library, and with the library where it is installed."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from vusfa.errors import ConfigError
from vusfa.files import file_sha256
from vusfa.sources.backbones import load_backbone
from vusfa.sources.crops import Preprocessing, prepare
from vusfa.sources.encode import encode_pictures
from vusfa.sources.transformers_folder import patch_tokens

PICTURES = np.random.default_rng(0).integers(0, 256, (2, 30, 40, 3), np.uint8)


class StandIn(nn.Module):
    """Answers as a vision transformer of the library does: patches of 14 pixels after one class token."""

    def __init__(self, pooled: bool = True) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.patches = nn.Conv2d(3, 4, 14, 14)
        self.config = SimpleNamespace(patch_size=14, image_size=28)
        self.pooled = pooled

    def forward(self, pixel_values: torch.Tensor) -> SimpleNamespace:
        tokens = self.patches(pixel_values).flatten(2).transpose(1, 2)
        first = torch.full_like(tokens[:, :1], 7.0)
        found = SimpleNamespace(last_hidden_state=torch.cat([first, tokens], 1))
        if self.pooled:
            found.pooler_output = first[:, 0]
        return found


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    def from_pretrained(path: str, **options: Any) -> nn.Module:
        assert options == {"local_files_only": True, "trust_remote_code": False, "use_safetensors": True}
        kind = json.loads(Path(path, "config.json").read_text())["model_type"]
        if kind == "unknown":
            raise ValueError("Unrecognized model\nand a long story")
        model = StandIn(pooled=kind != "poolless")
        return SimpleNamespace(vision_model=model) if kind == "both" else model

    module = ModuleType("transformers")
    module.AutoModel = SimpleNamespace(from_pretrained=from_pretrained)  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "transformers", module)
    path = tmp_path / "tiny"
    path.mkdir()
    (path / "config.json").write_text('{"model_type": "dinov2"}')
    (path / "model.safetensors").write_bytes(b"weights")
    return path


def test_pooled_and_patches(folder: Path) -> None:
    pooled = load_backbone(folder)
    assert (pooled.name, pooled.layer, pooled.weights_from) == ("transformers:tiny", "pooled", str(folder))
    assert pooled.weights_sha256 == file_sha256(folder / "model.safetensors")
    assert pooled.preprocessing == Preprocessing(28, "centre", 28)
    np.testing.assert_array_equal(encode_pictures(PICTURES, pooled), np.full((2, 1, 4), 7.0))
    patches = load_backbone(folder, layer="patches")
    with torch.no_grad():
        expected = StandIn().patches(prepare(PICTURES, patches.preprocessing)).mean((2, 3))
    np.testing.assert_allclose(encode_pictures(PICTURES, patches)[:, 0], expected, atol=1e-6)


def test_the_vision_part_of_a_model_of_two(folder: Path) -> None:
    (folder / "config.json").write_text('{"model_type": "both"}')
    assert encode_pictures(PICTURES, load_backbone(folder)).shape == (2, 1, 4)


@pytest.mark.parametrize(
    ("described", "expected"),
    [
        ({"size": 42}, Preprocessing(42, "centre", 42)),
        (
            {"size": {"shortest_edge": 32}, "do_center_crop": True, "crop_size": {"height": 28, "width": 28}},
            Preprocessing(28, "centre", 32),
        ),
        (
            {
                "size": {"height": 56, "width": 56},
                "resample": 3,
                "image_mean": [0.5] * 3,
                "image_std": [0.5] * 3,
            },
            Preprocessing(56, "centre", 56, "bicubic", (0.5,) * 3, (0.5,) * 3),
        ),
    ],
)
def test_its_preprocessing(folder: Path, described: dict[str, Any], expected: Preprocessing) -> None:
    (folder / "preprocessor_config.json").write_text(json.dumps(described))
    assert load_backbone(folder).preprocessing == expected
    assert load_backbone(folder, size=14).preprocessing.size == 14  # what is given wins


def test_weights_in_several_files_have_one_hash(folder: Path) -> None:
    one = load_backbone(folder).weights_sha256
    (folder / "more.safetensors").write_bytes(b"others")
    assert load_backbone(folder).weights_sha256 not in (one, file_sha256(folder / "more.safetensors"))


@pytest.mark.parametrize(
    ("name", "content", "options", "fault"),
    [
        ("config.json", '{"model_type": "unknown"}', {}, r"can read \(Unrecognized model\)$"),
        ("config.json", '{"model_type": "poolless"}', {}, "has no pooled output; choose the layer 'patches'"),
        ("model.safetensors", None, {}, "has no weights in it"),
        ("preprocessor_config.json", "{", {}, "cannot be read as JSON"),
        ("preprocessor_config.json", '{"size": "big"}', {}, "describes no preprocessing"),
        ("preprocessor_config.json", '{"image_mean": 3}', {}, "describes no preprocessing"),
        ("preprocessor_config.json", '{"size": 1000000000}', {}, "at most 4096 are made"),
        ("preprocessor_config.json", '{"size": {"height": -5}}', {}, "-5 pixels; at most 4096"),
        ("preprocessor_config.json", '{"do_center_crop": true, "crop_size": 5000}', {}, "5000 and 28 pixels"),
        ("note.txt", "", {"layer": "attention"}, "layer is 'attention'; transformers models have 'pooled'"),
        ("note.txt", "", {"weights": "x.pth"}, "weights is x.pth, but this network has its own"),
    ],
)
def test_what_is_wrong_is_one_line(
    folder: Path, name: str, content: str | None, options: dict[str, Any], fault: str
) -> None:
    if content is None:
        (folder / name).unlink()
    else:
        (folder / name).write_text(content)
    with pytest.raises(ConfigError, match=fault):
        encode_pictures(PICTURES, load_backbone(folder, **options))


def test_without_the_library(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(ConfigError, match=r"pip install 'vusfa\[transformers\]'"):
        load_backbone(folder)


def test_tokens_without_a_known_patch_size_and_maps() -> None:
    tokens = torch.arange(10.0)[None, :, None].expand(2, 10, 3)
    assert patch_tokens(tokens, SimpleNamespace(), 28)[0, 0].flatten().tolist() == list(range(1, 10))
    image = torch.rand(2, 3, 4, 4)
    assert patch_tokens(image, SimpleNamespace(), 28) is image


@pytest.mark.filterwarnings("ignore")
def test_the_library_itself(tmp_path: Path) -> None:
    library = pytest.importorskip("transformers")
    sizes = {"hidden_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2, "intermediate_size": 16}
    tower = {**sizes, "image_size": 28, "patch_size": 14}
    config = library.CLIPConfig(
        vision_config=tower, text_config={**sizes, "vocab_size": 50}, projection_dim=8
    )
    models = {
        "dinov2": library.Dinov2Model(library.Dinov2Config(**tower)),
        "registers": library.Dinov2WithRegistersModel(library.Dinov2WithRegistersConfig(**tower)),
        "clip": library.CLIPModel(config),
        "vit": library.ViTModel(library.ViTConfig(**tower)),
    }
    for name, model in models.items():
        model.eval().save_pretrained(tmp_path / name)
        vision = getattr(model, "vision_model", model)
        for layer in ("pooled", "patches"):
            backbone = load_backbone(tmp_path / name, layer=layer)
            with torch.no_grad():
                found = vision(pixel_values=prepare(PICTURES, backbone.preprocessing))
            expected = found.pooler_output if layer == "pooled" else found.last_hidden_state[:, -4:].mean(1)
            np.testing.assert_allclose(encode_pictures(PICTURES, backbone)[:, 0], expected, atol=1e-5)
