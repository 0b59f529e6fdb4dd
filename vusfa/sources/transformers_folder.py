"""Networks of the transformers library, from a folder that ``save_pretrained`` wrote.

DINOv2, CLIP, SigLIP, ViT, ConvNeXt, ResNet and others: the folder holds ``config.json``, the weights as
safetensors and, where it was published with one, ``preprocessor_config.json``. Nothing is downloaded, and no
code of the folder is run.
"""

from __future__ import annotations

import hashlib
import math
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from vusfa.errors import ConfigError
from vusfa.files import file_sha256
from vusfa.limits import MAX_PICTURE_SIDE
from vusfa.reading import read_json
from vusfa.sources.crops import Preprocessing

__all__ = ["PATCHES", "POOLED", "Tower", "is_transformers_folder", "open_folder"]

#: Layers of a transformer that can be taken: the pooled output, or the mean over the patch tokens.
POOLED, PATCHES = "pooled", "patches"

_FILTERS = {2: "bilinear", 3: "bicubic"}  # Pillow's numbers


def is_transformers_folder(path: Path) -> bool:
    """Whether a path is a folder with a ``config.json``."""
    return (path / "config.json").is_file()


class Tower(nn.Module):
    """The vision part of a model; answers with vectors (n, F), or with a map (n, F, h, w)."""

    def __init__(self, model: nn.Module, layer: str, name: str) -> None:
        super().__init__()
        self.model = model
        self.layer = layer
        self.name = name

    def forward(self, images: Tensor) -> Tensor:
        """Features of prepared images (n, 3, size, size).

        Raises:
            ConfigError: the model has no pooled output, or takes no pictures.
        """
        try:
            found = self.model(pixel_values=images)
        except TypeError as error:
            raise ConfigError(f"{self.name}: takes no pictures ({error}); give a vision model") from error
        if self.layer == PATCHES:
            return patch_tokens(found.last_hidden_state, self.model.config, images.shape[-1])
        pooled = getattr(found, "pooler_output", None)
        if pooled is None:
            raise ConfigError(f"{self.name}: has no pooled output; choose the layer {PATCHES!r}")
        return pooled


def patch_tokens(tokens: Tensor, config: Any, size: int) -> Tensor:
    """Patch tokens as a map (n, F, h, w); the class and register tokens before them are left out.

    Args:
        tokens: (n, T, F), or a map already.
        config: of the model; ``patch_size`` in pixels.
        size: side of the input in pixels.

    >>> import torch
    >>> from types import SimpleNamespace
    >>> patch_tokens(torch.rand(2, 1 + 16, 8), SimpleNamespace(patch_size=14), 56).shape
    torch.Size([2, 8, 4, 4])
    """
    if tokens.ndim != 3:
        return tokens
    patch = getattr(config, "patch_size", None)
    side = math.isqrt(tokens.shape[1])  # where the model does not say how large a patch is
    if isinstance(patch, int) and 0 < (size // patch) ** 2 <= tokens.shape[1]:
        side = size // patch
    patches = tokens[:, tokens.shape[1] - side * side :]
    return patches.transpose(1, 2).unflatten(2, (side, side))


def open_folder(folder: Path, layer: str | None, library: Any) -> tuple[nn.Module, str, str, Preprocessing]:
    """Read a model from its folder.

    Args:
        folder: that ``save_pretrained`` wrote.
        layer: :data:`POOLED`, the default, or :data:`PATCHES`.
        library: the module ``transformers``.

    Returns:
        the network, its layer, the SHA-256 of its weights, and its own preprocessing.

    Raises:
        ConfigError: an unknown layer, or the folder does not hold a vision model with its weights.
    """
    layer = layer or POOLED
    if layer not in (POOLED, PATCHES):
        raise ConfigError(
            f"{folder}: layer is {layer!r}; transformers models have {POOLED!r} and {PATCHES!r}"
        )
    weights = sorted(folder.glob("*.safetensors"))
    if not weights:
        raise ConfigError(f"{folder}: has no weights in it; save_pretrained writes model.safetensors")
    try:
        model = library.AutoModel.from_pretrained(
            str(folder), local_files_only=True, trust_remote_code=False, use_safetensors=True
        )
    except Exception as error:  # the library raises anything
        line = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise ConfigError(f"{folder}: holds no model that transformers can read ({line[:200]})") from error
    model = getattr(model, "vision_model", model)
    digests = [file_sha256(path) for path in weights]
    joined = digests[0] if len(digests) == 1 else hashlib.sha256("".join(digests).encode()).hexdigest()
    return Tower(model, layer, folder.name), layer, joined, _preprocessing(folder, model.config)


def _preprocessing(folder: Path, config: Any) -> Preprocessing:
    """The preprocessing that the folder describes; ImageNet's at the model's size where it describes none."""
    path = folder / "preprocessor_config.json"
    mend = "take the file of the published model, or leave it out"
    given = read_json(path, ConfigError, mend) if path.is_file() else {}
    try:
        own = config.image_size if isinstance(getattr(config, "image_size", None), int) else 224
        resized = _side(given.get("size"), own)
        cut = given.get("do_center_crop", False)
        size = _side(given.get("crop_size"), resized) if cut else resized
        if not all(0 < side <= MAX_PICTURE_SIDE for side in (size, resized)):
            raise ValueError(f"pictures of {size} and {resized} pixels; at most {MAX_PICTURE_SIDE} are made")
        return Preprocessing(
            size=size,
            crops="centre",
            resize=max(size, resized),
            interpolation=_FILTERS.get(given.get("resample", 2), "bilinear"),
            mean=tuple(float(value) for value in given.get("image_mean", (0.485, 0.456, 0.406))),  # type: ignore[arg-type]
            std=tuple(float(value) for value in given.get("image_std", (0.229, 0.224, 0.225))),  # type: ignore[arg-type]
        )
    except (TypeError, ValueError, KeyError) as error:
        raise ConfigError(f"{path}: describes no preprocessing ({error}); {mend}") from error


def _side(size: Any, default: int) -> int:
    """Pixels of a size as the library writes it: a number, or one under any of three names."""
    if size is None:
        return default
    if isinstance(size, dict):
        size = next(size[key] for key in ("shortest_edge", "height", "width") if key in size)
    return int(size)
