"""Motion blur."""

from __future__ import annotations

import numpy as np
import pytest

from vusfa.sources.blur import motion_blur


def test_blur_is_a_mean_of_neighbours() -> None:
    row = np.zeros((1, 9, 3), np.float32)
    row[0, 4] = 6
    assert motion_blur(row, 3, 1)[0, :, 0].tolist() == pytest.approx([0, 0, 0, 2, 2, 2, 0, 0, 0])
    assert motion_blur(row, 1, 0) is row


def test_blur_of_an_even_length_begins_where_it_is_told() -> None:
    row = np.zeros((1, 5, 3), np.uint8)
    row[0, 2] = 6
    assert motion_blur(row, 2, 1)[0, :, 0].tolist() == [0, 0, 3, 3, 0]
    assert motion_blur(row, 2, 0)[0, :, 0].tolist() == [0, 3, 3, 0, 0]
