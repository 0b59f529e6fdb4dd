r"""Similarity of pictures, and two thresholds calibrated on the states of the rooms.

The similarity of two pictures is the cosine of their features, each feature first standardized to mean 0 and
deviation 1 over the states of the rooms (plain features are nearly parallel: the cosine of two different
places is 0.6). The thresholds depend on how similar two *different* places of a room are, as the dump tells:
for every state take the similarity m(s) with the most similar other state of its room.

- **arrived**: the 95th percentile of m. A picture that is more similar to the goal's than nearly every state
  is to the state most like it was taken where the goal's was.
- **known**: the 5th percentile of m. A picture whose most similar state is less similar than that was not
  taken in the room.

States that look alike (similarity 0.999 or more) count as one place. In the bundled rooms arrived is 0.81 and
known 0.46; pictures of the same state, one with and one without JPEG's losses, reach 0.94 on average and 0.82
at least.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

__all__ = ["Places"]

_LOOK_ALIKE = 0.999
_ARRIVED, _KNOWN = 0.95, 0.05
_AT_ONCE = 1024


class Places(nn.Module):
    """States of rooms by their features, and the calibrated thresholds.

    Args:
        features: (S, F) float32, room by room.
        sizes: number of states per room, with sum S.

    Attributes:
        arrived: similarity from which on a picture counts as the goal's.
        known: lowest similarity of a picture of the rooms with its most similar state.

    >>> corners = torch.eye(6)
    >>> places = Places(corners, [4, 2])
    >>> places.by_room(corners[[1, 5]]).argmax(1).tolist()
    [0, 1]
    >>> places.arrived < places.similarity(corners[3], corners[3]).item()
    True
    """

    mean: Tensor
    deviation: Tensor
    table: Tensor

    def __init__(self, features: Tensor, sizes: Sequence[int]) -> None:
        super().__init__()
        self.sizes = list(sizes)
        deviation = features.std(0, correction=0)
        # A feature that hardly varies would be pure noise.
        smallest = max(1e-3 * float(deviation.mean()), 1e-12)
        self.register_buffer("mean", features.mean(0))
        self.register_buffer("deviation", deviation.clamp(min=smallest))
        self.register_buffer("table", self._directions(features))
        self.arrived, self.known = self._calibrated()

    def _directions(self, features: Tensor) -> Tensor:
        return normalize((features - self.mean) / self.deviation, dim=-1)

    def similarity(self, first: Tensor, second: Tensor) -> Tensor:
        """Similarity (\\*B,) of features (\\*B, F), -1 to 1."""
        return (self._directions(first) * self._directions(second)).sum(-1)

    def by_room(self, features: Tensor) -> Tensor:
        """Similarity (B, n) of features (B, F) with the most similar state of each room."""
        every = self._directions(features) @ self.table.T
        return torch.stack([part.amax(-1) for part in every.split(self.sizes, -1)], -1)

    def _calibrated(self) -> tuple[float, float]:
        most: list[Tensor] = []
        for table in self.table.split(self.sizes):
            for rows in table.split(_AT_ONCE):
                like = rows @ table.T
                most.append(like.masked_fill(like >= _LOOK_ALIKE, -2).amax(1))
        found = torch.cat(most)
        found = found[found > -2]
        if not len(found):  # every state looks like every other: only the same picture is the same place
            return _LOOK_ALIKE, -1.0
        return torch.quantile(found, _ARRIVED).item(), torch.quantile(found, _KNOWN).item()
