"""Universal successor features: V(s, g) = psi(s, g) . omega(g) (arXiv 1908.06376, section 3).

psi(s, g) is the discounted sum of the embeddings to come, omega(g) what each of their dimensions is worth.
"""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn import functional

from vusfa.modules.linear import SceneHead
from vusfa.modules.precision import full_precision, padded_linear
from vusfa.modules.rows import RowScenes

__all__ = ["RewardHead", "SuccessorHead", "SuccessorValue", "ValueHead"]


class SuccessorHead(SceneHead):
    """psi: one linear layer per scene on the hidden state.

    Args:
        num_scenes: scenes with weights of their own.
        hidden_size: size of the hidden state.
        embedding_size: E, size of psi.
        scale: factor on the layer's output. With 1 / (1 - gamma), the number of embeddings that psi is a sum
            of, the layer's own outputs are of the embeddings' size.

    >>> import torch
    >>> SuccessorHead(2, 32, 16)(torch.randn(5, 32), torch.tensor([0, 1, 1, 0, 1])).shape
    torch.Size([5, 16])
    """

    def __init__(self, num_scenes: int, hidden_size: int, embedding_size: int, scale: float = 1.0) -> None:
        super().__init__(num_scenes, hidden_size, embedding_size)
        self.scale = scale

    def forward(self, hidden: Tensor, scene_id: RowScenes) -> Tensor:
        """(\\*B, hidden_size) with scene indices (\\*B,) to (\\*B, E)."""
        successor = super().forward(hidden, scene_id)
        return successor if self.scale == 1.0 else successor.mul_(self.scale)


class RewardHead(nn.Module):
    """omega: reward weights of a goal; a dense layer with ReLU, then a linear one.

    Args:
        embedding_size: E, size of the goal's embedding and of omega.
        hidden_size: outputs of the first layer.
        scale: factor on the last layer's output. V is a sum of E products, so a step of the optimizer moves
            it E times as far as a weight; a small factor keeps that step small.

    >>> import torch
    >>> RewardHead(16, 32)(torch.randn(5, 16)).shape
    torch.Size([5, 16])
    """

    def __init__(self, embedding_size: int, hidden_size: int, scale: float = 1.0) -> None:
        super().__init__()
        self.scale = scale
        self.first = nn.Linear(embedding_size, hidden_size)
        self.last = nn.Linear(hidden_size, embedding_size)

    def forward(self, goal: Tensor) -> Tensor:
        """Goal embedding, or a sample of it, (\\*B, E) to (\\*B, E)."""
        first = functional.relu(padded_linear(goal, self.first.weight, self.first.bias))
        weights = padded_linear(first, self.last.weight, self.last.bias)
        return self.scale * full_precision(weights, self.last.weight)


class SuccessorValue(nn.Module):
    """V = psi . omega; no parameters.

    >>> import torch
    >>> SuccessorValue()(torch.tensor([[1.0, 2.0]]), torch.tensor([[3.0, -1.0]]))
    tensor([[1.]])
    """

    def forward(self, successor_features: Tensor, reward_weights: Tensor) -> Tensor:
        """(\\*B, E) twice to (\\*B, 1)."""
        return (successor_features * reward_weights).sum(-1, keepdim=True)


class ValueHead(SceneHead):
    """V (\\*B, 1) of the GVF baseline, one linear layer per scene on the hidden state.

    >>> import torch
    >>> ValueHead(2, 32)(torch.randn(5, 32), torch.tensor([0, 1, 1, 0, 1])).shape
    torch.Size([5, 1])
    """

    def __init__(self, num_scenes: int, hidden_size: int) -> None:
        super().__init__(num_scenes, hidden_size, 1)
