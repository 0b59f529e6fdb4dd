"""vusfa scenes encode."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from vusfa.errors import ConfigError
from vusfa.scenes import Scene
from vusfa.sources import backbones
from vusfa.sources.encode import encode_scene

pytestmark = pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")


@pytest.fixture(autouse=True)
def _progress_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is done within a moment is told, too."""
    monkeypatch.setattr("vusfa.cli.progress._BRIEF", 0.0)


@pytest.fixture
def network(tmp_path: Path) -> Path:
    """A TorchScript file whose features are the mean of red, green and blue."""

    class Mean(torch.nn.Module):
        def forward(self, images: torch.Tensor) -> torch.Tensor:
            return images.mean((2, 3))

    torch.jit.save(torch.jit.script(Mean()), tmp_path / "mean.pt")
    return tmp_path / "mean.pt"


def test_every_option_arrives(run: Callable[..., Any], scene_file: Path, network: Path) -> None:
    target = scene_file.with_name("new.h5")
    options = ["--backbone", network, "--crops", "ten", "--size", 16, "--resize", 20, "--batch", 5]
    result = run("encode", scene_file, target, *options, "--mean", "0,0,0", "--std", "0.5,0.5,0.25")
    assert result.exit_code == 0, result.stderr
    assert result.stdout.startswith(
        f"{target}: 16 states, 10 crops of 3 features; mean.pt output; shorter side"
    )
    assert "16 of 16 pictures" in result.stderr
    same = backbones.load_backbone(
        network, crops="ten", size=16, resize=20, mean=(0.0,) * 3, std=(0.5, 0.5, 0.25)
    )
    expected = encode_scene(scene_file, scene_file.with_name("same.h5"), same, batch=5)
    assert torch.equal(Scene.load(target).features, expected.features)
    assert run("check", target).exit_code == 0


def test_a_run_that_was_stopped_says_what_was_there(
    run: Callable[..., Any], scene_file: Path, network: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = scene_file.with_name("new.h5")
    options = ["--backbone", network, "--batch", 5]
    calls = []
    real = backbones.Backbone.__call__

    def stopping(self: Any, images: torch.Tensor, bfloat16: bool = False) -> torch.Tensor:
        calls.append(len(images))
        if len(calls) == 4:
            raise KeyboardInterrupt
        return real(self, images, bfloat16)

    monkeypatch.setattr(backbones.Backbone, "__call__", stopping)
    result = run("encode", scene_file, target, *options)
    assert result.exit_code == 130
    assert not target.exists()
    result = run("encode", scene_file, target, *options)
    assert result.exit_code == 0
    assert "encoding (some was there already): 6 of 6 pictures" in result.stderr
    assert calls == [1, 5, 5, 5, 1, 5, 1]


def test_bfloat16_that_is_not_as_good_is_said(
    run: Callable[..., Any], scene_file: Path, network: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vusfa.sources.encode.bfloat16_is_as_good", lambda pictures, backbone: False)
    target = scene_file.with_name("new.h5")
    result = run("encode", scene_file, target, "--backbone", network, "--bfloat16")
    assert result.exit_code == 0
    assert "bfloat16 lost accuracy" in result.stderr
    assert Scene.load(target).attributes["feature_precision"] == "float32"


@pytest.mark.parametrize(
    ("options", "fault"),
    [
        (["--mean", "0.5"], "error: --mean is '0.5'; give three numbers"),
        (["--std", "1,1,x"], "error: --std is '1,1,x'"),
        (["--crops", "nine"], "error: crops is 'nine'"),
        (["--backbone", "none.onnx"], "error: none.onnx: there is no such file"),
        (["--backbone", "torchvision:resnet50"], "needs a file of weights"),
    ],
)
def test_what_is_wrong_is_one_line(
    run: Callable[..., Any], scene_file: Path, network: Path, options: list[str], fault: str
) -> None:
    result = run("encode", scene_file, scene_file.with_name("new.h5"), "--backbone", network, *options)
    assert result.exit_code == 1
    assert fault in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
    assert not scene_file.with_name("new.h5").exists()


def test_three_numbers() -> None:
    from vusfa.cli.encode import network_options

    assert network_options(mean=None, std="1, 2,3") == {"mean": None, "std": (1.0, 2.0, 3.0)}
    with pytest.raises(ConfigError):
        network_options(std="1,2,3,4")


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
@pytest.mark.parametrize("device", ["cuda", "cuda:7", "gpu"])
def test_a_device_that_is_not_there(run, tmp_path: Path, device: str) -> None:
    done = run("encode", tmp_path / "a.h5", tmp_path / "b.h5", "--device", device)
    assert (done.exit_code, done.stderr.count("\n")) == (1, 1)
    assert done.stderr.startswith(f"error: device is {device!r}, which cannot be used here")
