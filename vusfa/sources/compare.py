"""Whether two scenes are the same room, and how far their pictures and features are apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from vusfa.errors import SceneError
from vusfa.scenes.scene import Scene

__all__ = ["Comparison", "compare"]

_BLOCK = 64  # pictures read at a time


@dataclass(frozen=True)
class Comparison:
    """Differences of two scenes with equal numbers of states.

    Attributes:
        graph: whether every action leads to the same state.
        poses: whether all locations and rotations are equal.
        features: whether all are equal.
        cosine, least_cosine: of a state's features in both, mean and least over the states; None where the
            numbers of crops or features differ.
        pixels, most_pixels: mean absolute difference of the pictures' values 0..255, over all states and in
            the state where it is largest; None where one has no pictures or their sizes differ.
    """

    graph: bool
    poses: bool
    features: bool
    cosine: float | None
    least_cosine: float | None
    pixels: float | None
    most_pixels: float | None

    @property
    def same_room(self) -> bool:
        """Whether graph and poses are equal."""
        return self.graph and self.poses


def compare(one: Scene, other: Scene) -> Comparison:
    """Compare two scenes, state by state.

    Args:
        one: a scene.
        other: another with the same number of states.

    Raises:
        SceneError: the numbers of states differ, or pictures cannot be read.

    >>> room = Scene.bundled("bathroom")
    >>> found = compare(room, room)
    >>> found.same_room, found.features, found.pixels
    (True, True, 0.0)
    """
    if one.num_states != other.num_states:
        raise SceneError(
            f"scenes {one.name!r} and {other.name!r} have {one.num_states} and {other.num_states} states and"
            f" cannot be compared; take two of the same room"
        )
    cosine = _cosines(one.features, other.features)
    pixels = _differences(one, other)
    return Comparison(
        graph=torch.equal(one.graph, other.graph),
        poses=torch.equal(one.location, other.location) and torch.equal(one.rotation, other.rotation),
        features=torch.equal(one.features, other.features),
        cosine=None if cosine is None else float(cosine.mean()),
        least_cosine=None if cosine is None else float(cosine.min()),
        pixels=None if pixels is None else float(pixels.mean()),
        most_pixels=None if pixels is None else float(pixels.max()),
    )


def _cosines(one: Tensor, other: Tensor) -> Tensor | None:
    """Cosines (N,) of features (N, C, F), all crops of a state concatenated."""
    if one.shape != other.shape:
        return None
    return torch.cosine_similarity(one.flatten(1).double(), other.flatten(1).double(), dim=1)


def _differences(one: Scene, other: Scene) -> np.ndarray | None:
    """Mean absolute difference of each state's two pictures, (N,)."""
    if one.picture_shape is None or one.picture_shape != other.picture_shape:
        return None
    found = []
    for states in torch.arange(one.num_states).split(_BLOCK):
        apart = one.pictures(states).short() - other.pictures(states).short()
        found.append(apart.abs().double().mean(dim=(1, 2, 3)).numpy())
    return np.concatenate(found)
