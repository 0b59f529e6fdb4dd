"""From the two embeddings to the hidden state that every head reads."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from vusfa.modules.freezing import Freezable, for_autocast
from vusfa.modules.linear import SceneLinear
from vusfa.modules.rows import RowScenes

__all__ = ["Fusion", "SceneLayer", "SiameseTrunk"]


class Fusion(Freezable):
    """Lays the embeddings of state and goal end to end; a dense layer with ReLU, shared by all scenes.

    Args:
        embedding_size: E.
        hidden_size: outputs.

    >>> import torch
    >>> Fusion(16, 32)(torch.randn(5, 16), torch.randn(5, 16)).shape
    torch.Size([5, 32])
    """

    def __init__(self, embedding_size: int, hidden_size: int) -> None:
        super().__init__()
        self.linear = nn.Linear(2 * embedding_size, hidden_size)
        self._frozen: Tensor | None = None

    def forward(self, state_embedding: Tensor, goal_embedding: Tensor) -> Tensor:
        """(\\*B, E) twice to (\\*B, hidden_size)."""
        return functional.relu(self.state_part(state_embedding) + self.goal_part(goal_embedding))

    def state_part(self, embedding: Tensor) -> Tensor:
        """What the state's embedding (\\*B, E) adds to the layer's sums, (\\*B, hidden_size); without the
        bias."""
        if self._frozen is not None and not torch.is_grad_enabled():
            return functional.linear(embedding, self._frozen)
        return functional.linear(embedding, self.linear.weight[:, : embedding.shape[-1]])

    def goal_part(self, embedding: Tensor) -> Tensor:
        """What the goal's embedding (\\*B, E) adds to them, and the bias, (\\*B, hidden_size)."""
        weight = self.linear.weight[:, -embedding.shape[-1] :]
        return functional.linear(embedding, weight, self.linear.bias)

    def freeze(self, grad: bool = False, goals: Tensor | None = None) -> None:
        """Converts the state's part of the weights for autocast now, for calls without gradients; autocast
        would convert a part of a weight at every call."""
        part = self.linear.weight.detach()[:, : self.linear.in_features // 2]
        self._frozen = for_autocast(part).contiguous()

    def thaw(self) -> None:
        """Uses the weights as they are again."""
        self._frozen = None


class SiameseTrunk(nn.Module):
    """The encoder and the fusion of what it gives, as one module.

    The fusing layer's sum has one part of the state alone and one of the goal alone. So these are computed
    where the encoder has distinct states and goals at hand, and only their sum row by row.

    Args:
        encoder: siamese encoder, or one around it, with ``both``.
        fusion: reads both embeddings.

    >>> import torch
    >>> from vusfa.modules.frames import FeatureFrames
    >>> from vusfa.modules.siamese import SiameseEncoder
    >>> trunk = SiameseTrunk(SiameseEncoder(FeatureFrames(torch.rand(12, 1, 8)), 4, 16, 6), Fusion(6, 32))
    >>> state, goal, fused = trunk(torch.zeros(3, 4, dtype=torch.int64), torch.arange(3))
    >>> torch.allclose(fused, trunk.fusion(state, goal), atol=1e-6)
    True
    """

    def __init__(self, encoder: Any, fusion: Fusion) -> None:
        super().__init__()
        self.encoder = encoder
        self.fusion = fusion

    def forward(self, state: Tensor, goal: Tensor) -> tuple[Tensor, ...]:
        """Embeddings of state and goal, what else the encoder returns, and last the fused (\\*B, hidden)."""
        of_state, of_goal = self.encoder.both(state, goal, self._heads())
        (state_embedding, state_part, *rest), (goal_embedding, goal_part, *goal_rest) = of_state, of_goal
        fused = functional.relu(state_part + goal_part)
        return state_embedding, goal_embedding, *rest, *goal_rest, fused

    def fused(self, state: Tensor, goal: Tensor) -> Tensor:
        """The fused (\\*B, hidden) alone; nothing else is looked up."""
        state_part, goal_part = self.encoder.both(state, goal, self._heads(), 1)
        return functional.relu(state_part + goal_part)

    def _heads(self) -> tuple[_Fused, _Fused]:
        return _Fused(self.fusion, "state_part"), _Fused(self.fusion, "goal_part")


class _Fused(NamedTuple):
    """Embeddings to themselves and their part of the fusion; equal to another one that does the same."""

    fusion: Fusion
    part: str

    def __call__(self, embedding: Tensor) -> tuple[Tensor, Tensor]:
        return embedding, getattr(self.fusion, self.part)(embedding)

    @property
    def parts(self) -> int:
        return 2


class SceneLayer(nn.Module):
    """A dense layer with ReLU, one a scene.

    Args:
        num_scenes: scenes with weights of their own.
        in_features: size of a row.
        hidden_size: outputs.

    >>> import torch
    >>> SceneLayer(2, 32, 32)(torch.randn(5, 32), torch.tensor([0, 1, 1, 0, 1])).shape
    torch.Size([5, 32])
    """

    def __init__(self, num_scenes: int, in_features: int, hidden_size: int) -> None:
        super().__init__()
        self.linear = SceneLinear(num_scenes, in_features, hidden_size)

    def forward(self, fused: Tensor, scene_id: RowScenes) -> Tensor:
        """(\\*B, in) with scene indices (\\*B,) to (\\*B, hidden_size)."""
        return functional.relu(self.linear(fused, scene_id))
