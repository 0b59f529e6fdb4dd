"""Motion blur of pictures, for augmentation and for changed renderings."""

from __future__ import annotations

import numpy as np

__all__ = ["motion_blur"]


def motion_blur(picture: np.ndarray, length: int, before: int) -> np.ndarray:
    """Means over ``length`` pixels of each row of a picture (H, W, C), which begin ``before`` pixels to the
    left; the pixels of the edges go on beyond them. Below a length of 2 the picture itself.

    >>> motion_blur(np.array([[[0], [6], [0]]]), length=2, before=1)[0, :, 0]
    array([0., 3., 3.])
    """
    if length < 2:
        return picture
    wide = np.pad(picture, ((0, 0), (before, length - 1 - before), (0, 0)), "edge")
    sums = np.cumsum(np.pad(wide, ((0, 0), (1, 0), (0, 0))), axis=1, dtype=np.float64)
    return (sums[:, length:] - sums[:, :-length]) / length
