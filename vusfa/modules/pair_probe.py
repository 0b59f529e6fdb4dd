"""Probes of what two pictures tell about the way from one to the other, from their features."""

from __future__ import annotations

import torch
from torch import Tensor, nn

__all__ = ["PROBES", "PairProbe"]

#: What a probe reads: features averaged over the picture, or the map of them.
PROBES = ("pooled", "spatial")


class PairProbe(nn.Module):
    """A network from the features of two pictures to several answers about the pair.

    ``pooled``: two layers on both means over the map. ``spatial``: the parts of the first picture attend to
    each other and to those of the second (two layers of ``torch.nn.TransformerDecoder``, with learned
    positions), and two layers read all parts of both.

    Args:
        kind: of :data:`PROBES`.
        parts: T of the map.
        channels: C of the map.
        answers: numbers per answer, by name.
        hidden_size: width of the layers.

    Attributes:
        mean, std: (T, C), or (1, C) of the means over the map, by which features are normalized; set by
            :meth:`normalize_by`.

    >>> probe = PairProbe("spatial", 12, 8, {"turn": 4}, hidden_size=16)
    >>> probe(torch.rand(5, 12, 8), torch.rand(5, 12, 8))["turn"].shape
    torch.Size([5, 4])
    """

    def __init__(
        self, kind: str, parts: int, channels: int, answers: dict[str, int], hidden_size: int = 128
    ) -> None:
        super().__init__()
        if kind not in PROBES:
            raise ValueError(f"kind is {kind!r}; give one of {', '.join(PROBES)}")
        self.kind, self.answers = kind, answers
        read = parts if kind == "spatial" else 1
        self.register_buffer("mean", torch.zeros(read, channels))
        self.register_buffer("std", torch.ones(read, channels))
        if kind == "spatial":
            self.embed = nn.Linear(channels, hidden_size)
            self.position = nn.Parameter(0.02 * torch.randn(parts, hidden_size))
            layer = nn.TransformerDecoderLayer(
                hidden_size, 4, 2 * hidden_size, dropout=0.0, batch_first=True, norm_first=True
            )
            self.attend = nn.TransformerDecoder(layer, 2)
            first = nn.Linear(2 * parts * hidden_size, hidden_size)
        else:
            first = nn.Linear(2 * channels, hidden_size)
        self.read = nn.Sequential(
            first, nn.ReLU(), nn.Linear(hidden_size, hidden_size), nn.ReLU(),
            nn.Linear(hidden_size, sum(answers.values())),
        )  # fmt: skip

    def _seen(self, maps: Tensor) -> Tensor:
        return maps if self.kind == "spatial" else maps.mean(1, keepdim=True)

    def normalize_by(self, maps: Tensor) -> None:
        """Normalize features by the mean and deviation over maps (S, T, C)."""
        seen = self._seen(maps)
        self.mean, self.std = seen.mean(0), seen.std(0).clamp(min=1e-6)

    def forward(self, first: Tensor, second: Tensor) -> dict[str, Tensor]:
        """Answers (n, size) by name, of pairs of maps (n, T, C)."""
        one, other = ((self._seen(maps) - self.mean) / self.std for maps in (first, second))
        if self.kind == "spatial":
            one, other = (self.embed(maps) + self.position for maps in (one, other))
            one = self.attend(one, other)
        found = self.read(torch.cat([one, other], -1).flatten(1))
        return dict(zip(self.answers, found.split(list(self.answers.values()), 1), strict=True))
