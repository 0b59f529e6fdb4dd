"""From the two embeddings to the hidden state that every head reads."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from vusfa.modules.linear import SceneLinear

__all__ = ["Fusion", "SceneLayer"]


class Fusion(nn.Module):
    """Lays the embeddings of state and goal end to end; a dense layer with ReLU, shared by all scenes.

    Args:
        embedding_size: E.
        hidden_size: outputs.

    >>> Fusion(16, 32)(torch.randn(5, 16), torch.randn(5, 16)).shape
    torch.Size([5, 32])
    """

    def __init__(self, embedding_size: int, hidden_size: int) -> None:
        super().__init__()
        self.linear = nn.Linear(2 * embedding_size, hidden_size)

    def forward(self, state_embedding: Tensor, goal_embedding: Tensor) -> Tensor:
        """(\\*B, E) twice to (\\*B, hidden_size)."""
        return functional.relu(self.linear(torch.cat([state_embedding, goal_embedding], -1)))


class SceneLayer(nn.Module):
    """A dense layer with ReLU, one a scene.

    Args:
        num_scenes: scenes with weights of their own.
        in_features: size of a row.
        hidden_size: outputs.

    >>> SceneLayer(2, 32, 32)(torch.randn(5, 32), torch.tensor([0, 1, 1, 0, 1])).shape
    torch.Size([5, 32])
    """

    def __init__(self, num_scenes: int, in_features: int, hidden_size: int) -> None:
        super().__init__()
        self.linear = SceneLinear(num_scenes, in_features, hidden_size)

    def forward(self, fused: Tensor, scene_id: Tensor) -> Tensor:
        """(\\*B, in) with scene indices (\\*B,) to (\\*B, hidden_size)."""
        return functional.relu(self.linear(fused, scene_id))
