"""Embeddings of one size, whatever the weights do."""

from __future__ import annotations

from typing import Any, NamedTuple

from torch import Tensor, nn
from torch.nn import functional

from vusfa.modules.siamese import Head, Heads, as_it_is, interleaved, num_parts

__all__ = ["NormalisedEncoder"]


class NormalisedEncoder(nn.Module):
    """An encoder whose two embeddings are brought to mean 0 and deviation 1 over their E dimensions.

    phi is then of one size whatever the weights do. Without it, phi, psi and V = psi . omega can drive each
    other up without bound; with a bottleneck, pi and psi go on reading full-sized means while the KL term
    presses the means that omega's sample is made of towards 0. What else the encoder returns (the Gaussians'
    means and scales) passes as it is.

    Args:
        encoder: returns the two embeddings first, (\\*B, E) each.

    >>> import torch
    >>> from vusfa.modules.frames import FeatureFrames
    >>> from vusfa.modules.siamese import SiameseEncoder
    >>> encoder = SiameseEncoder(FeatureFrames(torch.rand(12, 1, 8)), 1, hidden_size=16, out_features=6)
    >>> state, goal = NormalisedEncoder(encoder)(torch.tensor([[3], [5]]), torch.tensor([7, 7]))
    >>> bool((state.mean(-1).abs() < 1e-6).all()), bool((goal.std(-1, correction=0) - 1 < 1e-4).all())
    (True, True)
    """

    def __init__(self, encoder: Any) -> None:
        super().__init__()
        self.encoder = encoder

    def forward(self, state: Tensor, goal: Tensor) -> tuple[Tensor, ...]:
        """Both embeddings, and what else the encoder returns."""
        return interleaved(*self.both(state, goal, (as_it_is, as_it_is)))

    def both(self, state: Tensor, goal: Tensor, heads: Heads, part: int | None = None) -> tuple[Any, Any]:
        """What the heads make of the normalised embeddings, and what else it returns; or one part."""
        return self.encoder.both(state, goal, (_Normalised(heads[0]), _Normalised(heads[1])), part)


class _Normalised(NamedTuple):
    head: Head

    def __call__(self, embedding: Tensor) -> Any:
        return self.head(functional.layer_norm(embedding, embedding.shape[-1:]))

    @property
    def parts(self) -> int:
        return num_parts(self.head)
