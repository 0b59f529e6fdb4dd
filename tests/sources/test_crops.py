"""Crops: where they are cut, in which order, and the numbers that networks get."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image

from vusfa.errors import ConfigError
from vusfa.sources.crops import CROPS, Preprocessing, prepare

AS_IT_IS = {"mean": (0.0, 0.0, 0.0), "std": (1 / 255, 1 / 255, 1 / 255)}


def coordinates(height: int, width: int) -> np.ndarray:
    """A picture that says where each of its pixels is: red is the row, green the column."""
    rows, columns = np.mgrid[:height, :width]
    return np.stack([rows, columns, 0 * rows], axis=-1).astype(np.uint8)[None]


def test_ten_crops_are_centre_and_corners_and_then_their_mirror_images() -> None:
    found = prepare(coordinates(40, 60), Preprocessing(size=20, crops="ten", resize=40, **AS_IT_IS))
    assert found.shape == (10, 3, 20, 20)
    top_left = [tuple(crop[:2, 0, 0].int().tolist()) for crop in found[:5]]
    assert top_left == [(10, 20), (0, 0), (0, 40), (20, 0), (20, 40)]
    assert torch.equal(found[5:], found[:5].flip(-1))
    assert torch.equal(found[0, 0, :, 0], torch.arange(10.0, 30.0))
    assert torch.equal(found[0, 1, 0], torch.arange(20.0, 40.0))


@pytest.mark.parametrize(("height", "width"), [(40, 60), (60, 40), (40, 40)])
def test_the_shorter_side_is_resized(height: int, width: int) -> None:
    picture = coordinates(height, width)
    found = prepare(picture, Preprocessing(size=16, crops="centre", resize=20, **AS_IT_IS))
    resized = Image.fromarray(picture[0]).resize((width // 2, height // 2), Image.Resampling.BILINEAR)
    top, left = (height // 2 - 16) // 2, (width // 2 - 16) // 2
    assert np.array_equal(found[0].permute(1, 2, 0), np.asarray(resized)[top : top + 16, left : left + 16])


@pytest.mark.parametrize("interpolation", ["bilinear", "bicubic"])
def test_whole_is_the_whole_picture_squashed(interpolation: str) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (1, 30, 50, 3), np.uint8)
    found = prepare(picture, Preprocessing(size=20, interpolation=interpolation, **AS_IT_IS))
    filter_ = {"bilinear": Image.Resampling.BILINEAR, "bicubic": Image.Resampling.BICUBIC}[interpolation]
    assert np.array_equal(
        found[0].permute(1, 2, 0), np.asarray(Image.fromarray(picture[0]).resize((20, 20), filter_))
    )


def test_normalisation_by_hand() -> None:
    grey = np.full((1, 8, 8, 3), 51, np.uint8)  # 51 / 255 is 0.2
    found = prepare(grey, Preprocessing(size=8, mean=(0.1, 0.2, 0.4), std=(0.5, 0.25, 0.1)))
    assert found[0, :, 0, 0].tolist() == pytest.approx([0.2, 0.0, -2.0], abs=1e-6)
    exact = Preprocessing(size=8, mean=(127 / 255,) * 3, std=(128 / 255,) * 3)
    assert prepare(grey, exact)[0, 0, 0, 0] == (51 - 127) / 128


def test_crops_of_one_picture_lie_together() -> None:
    pictures = np.concatenate([np.full((1, 8, 8, 3), 10 * k, np.uint8) for k in range(3)])
    found = prepare(pictures, Preprocessing(size=4, crops="ten", **AS_IT_IS))
    assert found[:, 0, 0, 0].tolist() == pytest.approx([0.0] * 10 + [10.0] * 10 + [20.0] * 10)


@pytest.mark.parametrize(("size", "resize"), [(224, 256), (299, 342), (112, 128)])
def test_the_usual_resize(size: int, resize: int) -> None:
    assert Preprocessing(size=size).resize == resize


@pytest.mark.parametrize("crops", CROPS)
def test_the_description_says_how(crops: str) -> None:
    said = Preprocessing(crops=crops).describe()
    assert {"whole": "whole picture", "centre": "centre crop", "ten": "ten crops"}[crops] in said
    assert ("256" in said) == (crops != "whole")


@pytest.mark.parametrize(
    ("wrong", "fault"),
    [
        ({"crops": "nine"}, "crops is 'nine'; choose one of whole, centre, ten"),
        ({"interpolation": "nearest"}, "interpolation is 'nearest'"),
        ({"size": 0}, "size is 0"),
        ({"resize": 100}, "resize is 100, but crops are 224"),
        ({"std": (1.0, 0.0, 1.0)}, "std above 0"),
        ({"mean": (1.0, 0.0)}, "three numbers"),
    ],
)
def test_what_means_nothing(wrong: dict, fault: str) -> None:
    with pytest.raises(ConfigError, match=fault):
        Preprocessing(**wrong)
