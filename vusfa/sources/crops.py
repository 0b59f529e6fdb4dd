"""Preprocessing of pictures for a network: resizing, crops, normalization.

Three ways, ``crops=``:

- ``whole``: the whole picture, resized to the network's square without keeping its aspect ratio. The bundled
  rooms were made this way.
- ``centre``: the shorter side is resized to ``resize``, and the square in the middle is cut out: how
  networks trained on ImageNet are tested.
- ``ten``: of the same resized picture the centre, the top left, top right, bottom left and bottom right
  corner, and then these five mirrored: ten rows of features per state, of which training draws one. The
  THOR v1 dumps have ten crops, too; their order is not known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from vusfa.errors import ConfigError

__all__ = ["CROPS", "Preprocessing", "cut", "prepare"]

#: Ways to cut a picture, and how many crops each gives.
CROPS = {"whole": 1, "centre": 1, "ten": 10}

_FILTERS = {"bicubic": Image.Resampling.BICUBIC, "bilinear": Image.Resampling.BILINEAR}


@dataclass(frozen=True)
class Preprocessing:
    """Preprocessing of pictures for a network.

    Args:
        size: side of the network's square input, pixels.
        crops: one of :data:`CROPS`.
        resize: for ``centre`` and ``ten``, what the shorter side is resized to before cutting, pixels;
            by default ``size * 256 / 224``.
        interpolation: ``bicubic`` or ``bilinear``, both antialiased (Pillow's).
        mean: of red, green and blue in 0..1, subtracted; ImageNet's by default.
        std: that the rest is divided by.

    Raises:
        ConfigError: an invalid value.

    >>> Preprocessing(size=224).resize
    256
    """

    size: int = 224
    crops: str = "whole"
    resize: int = 0
    interpolation: str = "bilinear"
    mean: tuple[float, float, float] = (0.485, 0.456, 0.406)
    std: tuple[float, float, float] = (0.229, 0.224, 0.225)

    def __post_init__(self) -> None:
        if self.crops not in CROPS:
            raise ConfigError(f"crops is {self.crops!r}; choose one of {', '.join(CROPS)}")
        if self.interpolation not in _FILTERS:
            raise ConfigError(f"interpolation is {self.interpolation!r}; choose one of {', '.join(_FILTERS)}")
        if self.size < 1:
            raise ConfigError(f"size is {self.size}; give the side of the network's input in pixels")
        if len(self.mean) != 3 or len(self.std) != 3 or not all(value > 0 for value in self.std):
            raise ConfigError(f"mean is {self.mean} and std {self.std}; give three numbers each, std above 0")
        resize = self.resize or round(self.size * 256 / 224)
        if resize < self.size:
            raise ConfigError(
                f"resize is {resize}, but crops are {self.size} pixels wide; give {self.size} or more"
            )
        object.__setattr__(self, "resize", resize)

    @property
    def num_crops(self) -> int:
        """C, crops per picture."""
        return CROPS[self.crops]

    def describe(self) -> str:
        """Description in one line.

        >>> Preprocessing(crops="ten", mean=(0.5, 0.5, 0.5), std=(0.5, 0.5, 0.5)).describe()
        'shorter side to 256, ten crops of 224x224, bilinear; (x/255 - (0.5, 0.5, 0.5)) / (0.5, 0.5, 0.5)'
        """
        square = f"{self.size}x{self.size}"
        cut = {
            "whole": f"whole picture to {square}",
            "centre": f"shorter side to {self.resize}, centre crop of {square}",
            "ten": f"shorter side to {self.resize}, ten crops of {square}",
        }[self.crops]
        mean, std = (tuple(round(value, 6) for value in values) for values in (self.mean, self.std))
        return f"{cut}, {self.interpolation}; (x/255 - {mean}) / {std}"


def cut(picture: np.ndarray, preprocessing: Preprocessing) -> np.ndarray:
    """The crops of one picture (H, W, 3), (C, size, size, 3) uint8."""
    image, size = Image.fromarray(picture), preprocessing.size
    resample = _FILTERS[preprocessing.interpolation]
    if preprocessing.crops == "whole":
        return np.asarray(image.resize((size, size), resample))[None]
    scale = preprocessing.resize / min(image.size)
    width, height = (max(preprocessing.resize, round(side * scale)) for side in image.size)
    resized = np.asarray(image.resize((width, height), resample))
    right, bottom = width - size, height - size
    corners = [(round(bottom / 2), round(right / 2)), (0, 0), (0, right), (bottom, 0), (bottom, right)]
    if preprocessing.crops == "centre":
        corners = corners[:1]
    crops = np.stack([resized[top : top + size, left : left + size] for top, left in corners])
    return crops if preprocessing.crops == "centre" else np.concatenate([crops, crops[:, :, ::-1]])


def prepare(pictures: np.ndarray, preprocessing: Preprocessing) -> Tensor:
    """The network's input for some pictures.

    Args:
        pictures: (N, H, W, 3) uint8.
        preprocessing: of the network.

    Returns:
        (N * C, 3, size, size) float32, the crops of one picture next to each other.

    >>> prepare(np.zeros((2, 30, 40, 3), np.uint8), Preprocessing(size=8, crops="ten")).shape
    torch.Size([20, 3, 8, 8])
    """
    cuts = np.concatenate([cut(picture, preprocessing) for picture in pictures])
    # A table of the 256 levels, computed in double precision, so that (x - 127) / 128 comes out exactly.
    levels = np.arange(256)[:, None] / 255
    table = ((levels - preprocessing.mean) / preprocessing.std).astype(np.float32)
    normalised = np.stack([table[:, channel][cuts[..., channel]] for channel in range(3)], axis=-1)
    return torch.from_numpy(normalised).permute(0, 3, 1, 2)
