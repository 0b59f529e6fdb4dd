"""Checks of pictures from users, and cropping to the aspect ratio of the rooms' pictures."""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from PIL import Image, ImageOps
from torch import Tensor

from vusfa import limits
from vusfa.errors import SceneError
from vusfa.reading import open_regular
from vusfa.scenes.pictures import check_scans, open_image

__all__ = ["MIN_PICTURE_SIDE", "as_picture", "decode_upright", "in_shape"]

#: Smallest side of a picture in pixels.
MIN_PICTURE_SIDE = 16
#: Relative tolerance of width over height: rounding, and sensors of 4.03 to 3.
_SAME_ASPECT = 0.03


def decode_upright(encoded: bytes, name: str) -> np.ndarray:
    """A JPEG or PNG file as (H, W, 3) uint8, rotated by the orientation that its camera recorded.

    Args:
        encoded: the file's content.
        name: name in messages.

    Raises:
        SceneError: the file is no such picture, damaged, or larger than allowed.

    >>> decode_upright(b"GIF89a", "goal.gif")
    Traceback (most recent call last):
    ...
    vusfa.errors.SceneError: goal.gif: is no picture that can be read (unknown format); give a JPEG or PNG
        file
    """
    try:
        check_scans(encoded)
        with open_image(io.BytesIO(encoded)) as image:
            if max(image.size) > limits.MAX_PICTURE_SIDE:  # JPEG: decoded at half the size, or a quarter
                image.draft("RGB", (limits.MAX_PICTURE_SIDE // 2,) * 2)
            if max(image.size) > limits.MAX_PICTURE_SIDE:
                size = f"{image.width} x {image.height}"
                raise OSError(f"{size} pixels; at most {limits.MAX_PICTURE_SIDE} per side")
            return np.asarray(ImageOps.exif_transpose(image).convert("RGB"))
    except OSError as error:
        raise SceneError(
            f"{name}: is no picture that can be read ({error}); give a JPEG or PNG file"
        ) from error


def read_upright(path: str | os.PathLike[str]) -> np.ndarray:
    """:func:`decode_upright` of a regular file, which a pipe or a device is not."""
    try:
        with open_regular(path) as file:
            encoded = file.read()
    except OSError as error:
        raise SceneError(f"{path}: cannot be read ({error.strerror or error}); check the path") from error
    return decode_upright(encoded, os.fspath(path))


def as_picture(picture: Any) -> tuple[np.ndarray, str]:
    """Any picture as (H, W, 3) uint8, and its name in messages.

    Args:
        picture: path of a JPEG or PNG file, PIL image, or uint8 (H, W, 3) as array or tensor.

    Raises:
        SceneError: it is none of these, damaged, or of another type or shape.

    >>> as_picture(np.zeros((40, 50, 3)))
    Traceback (most recent call last):
    ...
    vusfa.errors.SceneError: the picture is float64 of shape (40, 50, 3); give uint8 (H, W, 3), at least 16
        pixels per side
    """
    name = "the picture"
    if isinstance(picture, str | os.PathLike):
        name = os.fspath(picture)
        array = read_upright(picture)
    elif isinstance(picture, Image.Image):
        array = np.asarray(picture.convert("RGB"))
    else:
        array = picture.cpu().numpy() if isinstance(picture, Tensor) else np.asarray(picture)
    if (
        array.dtype != np.uint8
        or array.ndim != 3
        or array.shape[2] != 3
        or min(array.shape[:2]) < MIN_PICTURE_SIDE
    ):
        raise SceneError(
            f"{name} is {array.dtype} of shape {array.shape}; give uint8 (H, W, 3), at least"
            f" {MIN_PICTURE_SIDE} pixels per side"
        )
    return array, name


def in_shape(
    picture: np.ndarray, name: str, shapes: Sequence[tuple[int, int]], crop: bool = False
) -> np.ndarray:
    """Check or crop a picture to the aspect ratio of the rooms' pictures.

    Args:
        picture: (H, W, 3) uint8.
        name: name in messages.
        shapes: height and width of the rooms' pictures, pixels; one of them is enough.
        crop: cut the middle out of a picture of another aspect ratio, instead of an error.

    Raises:
        SceneError: another aspect ratio.

    >>> in_shape(np.zeros((1080, 1920, 3), np.uint8), "goal.jpg", [(150, 200)], crop=True).shape
    (1080, 1440, 3)
    """
    rows, columns = picture.shape[:2]
    if any(abs(columns * high / (rows * wide) - 1) <= _SAME_ASPECT for high, wide in shapes):
        return picture
    height, width = shapes[0]
    if not crop:
        raise SceneError(
            f"{name} is {columns} x {rows} pixels, the rooms' pictures are {width} x {height}; set the camera"
            " to that aspect ratio, or pass crop (--crop) to cut out the middle"
        )
    new_rows = min(rows, round(columns * height / width))
    new_columns = min(columns, round(rows * width / height))
    top, left = (rows - new_rows) // 2, (columns - new_columns) // 2
    return picture[top : top + new_rows, left : left + new_columns]
