"""Patterns of walls, floors and ceilings, drawn with NumPy.

All are float arrays (height, width, 3) of sRGB values in 0..1, the top row first; all randomness is that of
the ``RandomState`` argument. Blotches on walls and floors make all places of a wall look different.
"""

from __future__ import annotations

import colorsys
from collections.abc import Callable

import numpy as np
from PIL import Image

__all__ = ["FLOORS", "WALLS", "blotches", "ceiling", "floor", "from_hsv", "random_stream", "wall"]

#: Patterns of floors.
FLOORS = ("wood", "tile", "check")
#: Patterns of walls.
WALLS = ("stripe", "wainscot", "brick", "plain", "dots", "tile", "chevron", "plank", "diamond")

_WALL_PIXELS, _FLOOR_PIXELS, _CEILING_PIXELS = 130, 100, 30  # per metre
_WAINSCOT = 1.05
_SKIRTING = 0.1
_BRICK = (0.22, 0.075)
_PLANK = 0.14


def random_stream(seed: int) -> np.random.RandomState:
    """Random number generator with the same numbers in every version of NumPy; seeds of any size.

    >>> int(random_stream(1).randint(100))
    37
    """
    return np.random.RandomState(seed % 2**32)


def from_hsv(hue: float, saturation: float, value: float) -> np.ndarray:
    """A color (3,) from hue (any number, taken modulo 1), saturation and value.

    >>> from_hsv(1.0, 1.0, 0.5).tolist()
    [0.5, 0.0, 0.0]
    """
    return np.array(colorsys.hsv_to_rgb(hue % 1, saturation, value))


def blotches(rng: np.random.RandomState, height: int, width: int, step: int, channels: int = 1) -> np.ndarray:
    """Smooth noise (height, width, channels) of about -1..1, with features of about ``step`` pixels."""
    size = (max(2, height // step + 2), max(2, width // step + 2), channels)
    coarse = rng.uniform(-1, 1, size).astype(np.float32)
    layers = [
        Image.fromarray(coarse[..., k]).resize((width, height), Image.Resampling.BICUBIC)
        for k in range(channels)
    ]
    return np.stack([np.asarray(layer) for layer in layers], axis=-1)


def _brick_shift(y: np.ndarray) -> np.ndarray:
    return 0.5 * (np.floor(y / _BRICK[1]) % 2)


# Masks of a wall's second color: x from the left, y from the top, period p, the wall's height h.
_MASKS: dict[str, Callable[[np.ndarray, np.ndarray, float, float], np.ndarray]] = {
    "stripe": lambda x, y, p, h: (x / p) % 1 < 0.45,
    "dots": lambda x, y, p, h: (
        ((x / p + 0.5 * (np.floor(y / p) % 2)) % 1 - 0.5) ** 2 + ((y / p) % 1 - 0.5) ** 2 < 0.07
    ),
    "diamond": lambda x, y, p, h: np.abs((x / p) % 1 - 0.5) + np.abs((y / p / 1.4) % 1 - 0.5) < 0.4,
    "wainscot": lambda x, y, p, h: (y > h - _WAINSCOT) ^ (np.abs(y - h + _WAINSCOT) < 0.04),
    "chevron": lambda x, y, p, h: (y / p + np.abs((x / p / 2) % 1 - 0.5) * 2) % 1 < 0.45,
    "tile": lambda x, y, p, h: ((x / p) % 1 < 0.05) | ((y / p) % 1 < 0.05),
    "brick": lambda x, y, p, h: ((x / _BRICK[0] + _brick_shift(y)) % 1 < 0.06) | ((y / _BRICK[1]) % 1 < 0.15),
    "plank": lambda x, y, p, h: (x / _PLANK) % 1 < 0.06,
    "plain": lambda x, y, p, h: np.zeros_like(x, bool),
}


def _tone_of_pieces(
    pattern: str, x: np.ndarray, y: np.ndarray, period: float, rng: np.random.RandomState
) -> np.ndarray:
    """Make each tile, brick or plank a little lighter or darker than the others."""
    wide, high = {"tile": (period, period), "brick": _BRICK, "plank": (_PLANK, 9.0)}[pattern]
    shift = _brick_shift(y) if pattern == "brick" else 0
    column, row = np.floor(x / wide + shift).astype(int), np.floor(y / high).astype(int)
    shape = (row.max() + 1, column.max() + 1)
    tone = rng.uniform(0.8, 1.15, (*shape, 1)) * (1 + 0.04 * rng.standard_normal((*shape, 3)))
    return tone[row, column]


def wall(pattern: str, hue: float, length: float, height: float, rng: np.random.RandomState) -> np.ndarray:
    """A piece of wall with its skirting board.

    Args:
        pattern: one of :data:`WALLS`.
        hue: hue of its first color.
        length: metres.
        height: metres.
        rng: source of the shades, the second color, the pattern's period and the blotches.

    Returns:
        (130 * height, 130 * length, 3) float32.

    >>> wall("brick", 0.0, 1.0, 2.6, random_stream(0)).shape
    (338, 130, 3)
    """
    rows, columns = int(height * _WALL_PIXELS), max(16, int(length * _WALL_PIXELS))
    y, x = np.mgrid[0:rows, 0:columns] / _WALL_PIXELS
    first = from_hsv(hue, rng.uniform(0.1, 0.34), rng.uniform(0.7, 0.92))
    second = from_hsv(hue + rng.uniform(-0.08, 0.08), rng.uniform(0.2, 0.5), rng.uniform(0.4, 0.75))
    period = rng.uniform(0.16, 0.34)
    if pattern == "brick":
        first, second = from_hsv(rng.uniform(0.01, 0.07), 0.5, 0.62), np.array([0.78, 0.75, 0.7])
    mask = _MASKS[pattern](x, y, period, height)[..., None]
    image = np.where(mask, second, first).astype(np.float32)
    if pattern in ("tile", "brick", "plank"):
        image *= np.where(mask, 1, _tone_of_pieces(pattern, x, y, period, rng)).astype(np.float32)
    coarse = 0.13 * blotches(rng, rows, columns, int(0.8 * _WALL_PIXELS), 3)
    fine = 0.05 * blotches(rng, rows, columns, int(0.12 * _WALL_PIXELS))
    image *= 1 + coarse + fine + 0.015 * rng.standard_normal((rows, columns, 1)).astype(np.float32)
    skirting = from_hsv(hue + 0.5, 0.08, 0.85 if rng.random_sample() < 0.6 else 0.35)
    image[int((height - _SKIRTING) * _WALL_PIXELS) :] = skirting
    return np.clip(image, 0.02, 0.97)


def _boards(x: np.ndarray, y: np.ndarray, rng: np.random.RandomState) -> np.ndarray:
    color = from_hsv(rng.uniform(0.06, 0.1), rng.uniform(0.4, 0.6), rng.uniform(0.5, 0.72))
    board = np.floor(x / 0.13).astype(int)
    piece = np.floor(y / 1.1 + (board * 0.37) % 1).astype(int)
    tone = rng.uniform(0.72, 1.12, (piece.max() + 1, board.max() + 1))[piece, board]
    grain = 0.06 * np.sin(x * 190 + 3 * blotches(rng, x.shape[0], x.shape[1], 60)[..., 0] * 3)
    joint = np.where((x / 0.13) % 1 < 0.05, 0.6, 1)
    return color * (tone + grain)[..., None] * joint[..., None]


def _slabs(pattern: str, x: np.ndarray, y: np.ndarray, rng: np.random.RandomState) -> np.ndarray:
    side = 0.4 if pattern == "check" else 0.3
    column, row = np.floor(x / side).astype(int), np.floor(y / side).astype(int)
    hue = rng.random_sample()
    light = from_hsv(hue, 0.15, 0.85)
    dark = from_hsv(hue + rng.uniform(-0.1, 0.1), 0.35, 0.45 if pattern == "check" else 0.7)
    tone = rng.uniform(0.85, 1.1, (row.max() + 1, column.max() + 1))[row, column][..., None]
    image = np.where(((column + row) % 2 == 0)[..., None], light, dark) * tone
    return np.where((((x / side) % 1 < 0.02) | ((y / side) % 1 < 0.02))[..., None], 0.5, image)


def floor(pattern: str, width: float, depth: float, rng: np.random.RandomState) -> np.ndarray:
    """A floor of a pattern.

    Args:
        pattern: one of :data:`FLOORS`.
        width: metres, along the array's second axis.
        depth: metres.
        rng: source of the colors, the boards or slabs, and the blotches.

    Returns:
        (100 * depth, 100 * width, 3) float32.

    >>> floor("wood", 2.0, 1.0, random_stream(0)).shape
    (100, 200, 3)
    """
    rows, columns = int(depth * _FLOOR_PIXELS), int(width * _FLOOR_PIXELS)
    y, x = np.mgrid[0:rows, 0:columns] / _FLOOR_PIXELS
    image = _boards(x, y, rng) if pattern == "wood" else _slabs(pattern, x, y, rng)
    image = image * (1 + 0.07 * blotches(rng, rows, columns, 90, 3) + 0.03 * blotches(rng, rows, columns, 12))
    return np.clip(image, 0.02, 0.95).astype(np.float32)


def ceiling(width: float, depth: float, rng: np.random.RandomState) -> np.ndarray:
    """A nearly white ceiling, (30 * depth, 30 * width, 3)."""
    noise = blotches(rng, int(depth * _CEILING_PIXELS), int(width * _CEILING_PIXELS), _CEILING_PIXELS, 3)
    return np.clip(0.84 + 0.05 * noise, 0, 0.92)
