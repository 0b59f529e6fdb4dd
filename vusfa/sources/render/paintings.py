"""Pictures for walls and views for windows: landscapes, blocks, discs, cells, clouds of color, rays."""

from __future__ import annotations

import math

import numpy as np

from vusfa.sources.render.textures import blotches, from_hsv, random_stream

__all__ = ["painting", "view"]

_PIXELS = 260  # pixels per metre
_FRAME = 0.03


def _landscape(
    u: np.ndarray, v: np.ndarray, ratio: float, hue: float, rng: np.random.RandomState
) -> np.ndarray:
    image = (1 - v[..., None]) * from_hsv(hue, 0.45, 0.9) + v[..., None] * from_hsv(hue + 0.1, 0.15, 1)
    sun = (u - rng.random_sample()) ** 2 + ((v - 0.25) * ratio) ** 2 < 0.006
    image = np.where(sun[..., None], from_hsv(0.13, 0.5, 1), image)
    for k in range(4):
        waves = (
            rng.uniform(0.02, 0.07) * np.sin(u * rng.uniform(3, 16) + rng.uniform(0, 7)) for _ in range(3)
        )
        ridge = 0.4 + 0.14 * k + sum(waves)
        hill = from_hsv(hue + 0.25 + 0.06 * k, 0.5, 0.75 - 0.14 * k)
        image = np.where((v > ridge)[..., None], hill, image)
    return image


def _blocks(u: np.ndarray, v: np.ndarray, ratio: float, hue: float, rng: np.random.RandomState) -> np.ndarray:
    image = np.ones((*u.shape, 3)) * 0.93
    columns, rows = (sorted(rng.uniform(0.1, 0.9, 3)) for _ in range(2))
    for x0, x1 in zip([0, *columns], [*columns, 1], strict=True):
        for y0, y1 in zip([0, *rows], [*rows, 1], strict=True):
            if rng.random_sample() < 0.6:
                color = from_hsv(rng.random_sample(), rng.uniform(0.4, 0.9), rng.uniform(0.5, 0.95))
                image[(u >= x0) & (u < x1) & (v >= y0) & (v < y1)] = color
    for edge in columns:
        image[np.abs(u - edge) < 0.015] = 0.06
    for edge in rows:
        image[np.abs(v - edge) < 0.015] = 0.06
    return image


def _discs(u: np.ndarray, v: np.ndarray, ratio: float, hue: float, rng: np.random.RandomState) -> np.ndarray:
    image = np.ones((*u.shape, 3)) * from_hsv(hue, 0.25, 0.9)
    for _ in range(rng.randint(4, 12)):
        color = from_hsv(rng.random_sample(), 0.7, rng.uniform(0.3, 0.95))
        x, y = rng.random_sample(), rng.random_sample()
        image[(u - x) ** 2 / ratio + (v - y) ** 2 * ratio < rng.uniform(0.002, 0.04)] = color
    return image


def _cells(u: np.ndarray, v: np.ndarray, ratio: float, hue: float, rng: np.random.RandomState) -> np.ndarray:
    centers = rng.random_sample((18, 2))
    colors = np.stack(
        [
            from_hsv(hue + rng.uniform(-0.2, 0.2), rng.uniform(0.2, 0.9), rng.uniform(0.3, 1))
            for _ in range(18)
        ]
    )
    return colors[np.argmin([(u - x) ** 2 + (v - y) ** 2 for x, y in centers], axis=0)]


def _clouds(u: np.ndarray, v: np.ndarray, ratio: float, hue: float, rng: np.random.RandomState) -> np.ndarray:
    noise = blotches(rng, u.shape[0], u.shape[1], max(8, u.shape[0] // 4), 3)
    return from_hsv(hue, 0.4, 0.65) + 0.25 * noise[..., :1] + 0.12 * noise


def _rays(u: np.ndarray, v: np.ndarray, ratio: float, hue: float, rng: np.random.RandomState) -> np.ndarray:
    angle = np.arctan2(v - rng.uniform(0.2, 0.8), u - rng.uniform(0.2, 0.8))
    count = rng.randint(5, 13)
    even = np.floor(angle / math.pi * count) % 2 == 0
    return np.where(even[..., None], from_hsv(hue, 0.7, 0.85), from_hsv(hue + 0.45, 0.4, 0.5))


_STYLES = (_landscape, _blocks, _discs, _cells, _clouds, _rays)


def _canvas(width: float, height: float) -> tuple[np.ndarray, np.ndarray]:
    rows, columns = max(16, int(height * _PIXELS)), max(16, int(width * _PIXELS))
    y, x = np.mgrid[0:rows, 0:columns]
    return x / columns, y / rows


def painting(seed: int, width: float, height: float) -> np.ndarray:
    """A framed picture; the seed draws its style, its colors and its frame.

    Args:
        seed: any whole number.
        width: metres.
        height: metres.

    Returns:
        (260 * height, 260 * width, 3) float32, sRGB in 0..1, the top row first.

    >>> painting(7, 0.5, 0.4).shape
    (104, 130, 3)
    """
    rng = random_stream(seed)
    u, v = _canvas(width, height)
    style = _STYLES[rng.randint(len(_STYLES))]
    image = np.clip(style(u, v, height / width, rng.random_sample(), rng), 0.03, 0.97)
    edge = max(3, int(_FRAME * _PIXELS))
    if rng.random_sample() < 0.7:
        color = from_hsv(rng.uniform(0.05, 0.12), 0.6, rng.uniform(0.15, 0.7))
    else:
        color = np.ones(3) * rng.choice([0.05, 0.9])
    image[:edge] = image[-edge:] = color
    image[:, :edge] = image[:, -edge:] = color
    return image.astype(np.float32)


def view(seed: int, width: float, height: float) -> np.ndarray:
    """What is seen through a window: a landscape without a frame, as :func:`painting`."""
    rng = random_stream(seed)
    u, v = _canvas(width, height)
    image = _landscape(u, v, height / width, rng.random_sample(), rng)
    return np.clip(image, 0.03, 0.97).astype(np.float32)
