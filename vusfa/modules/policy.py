"""Policy heads: hidden state to logits."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from vusfa.errors import ConfigError
from vusfa.modules.linear import SceneHead, SceneLinear
from vusfa.modules.precision import full_precision
from vusfa.modules.rows import RowScenes

__all__ = ["PolicyHead", "SuccessorPolicyHead"]


class PolicyHead(SceneHead):
    """Logits (\\*B, A), one linear layer per scene on the hidden state (GVF and USFA).

    >>> PolicyHead(2, 32, 4)(torch.randn(5, 32), torch.tensor([0, 1, 1, 0, 1])).shape
    torch.Size([5, 4])
    """


class SuccessorPolicyHead(nn.Module):
    """Successor feature dependent policy (SFDP): [hidden, psi] through a dense layer, ReLU and a linear one.

    Both layers are a scene's own. psi is read as a constant, detached here and nowhere else: the policy's
    gradient must not bend psi away from what it predicts.

    Args:
        num_scenes: scenes with weights of their own.
        hidden_size: size of the hidden state and of the dense layer.
        embedding_size: E, size of psi.
        num_actions: A.
        successor_norm: ``"layer"`` brings psi, a sum of about 1 / (1 - gamma) embeddings, to mean 0 and
            deviation 1 over its dimensions; ``None`` leaves it.
        rectify_logits: a ReLU on the logits, as in the released VUSFA.

    >>> head = SuccessorPolicyHead(1, 32, 16, 4, successor_norm="layer")
    >>> psi = torch.randn(5, 16, requires_grad=True)
    >>> head(torch.randn(5, 32), psi, torch.zeros(5, dtype=torch.int64)).sum().backward()
    >>> psi.grad is None
    True
    """

    def __init__(
        self,
        num_scenes: int,
        hidden_size: int,
        embedding_size: int,
        num_actions: int,
        *,
        successor_norm: Literal["layer"] | None = None,
        rectify_logits: bool = False,
    ) -> None:
        super().__init__()
        if successor_norm not in (None, "layer"):
            raise ConfigError(f"successor_norm is {successor_norm!r}; it must be None or 'layer'")
        self.first = SceneLinear(num_scenes, hidden_size + embedding_size, hidden_size)
        self.last = SceneLinear(num_scenes, hidden_size, num_actions)
        self.successor_norm = successor_norm
        self.rectify_logits = rectify_logits

    def forward(self, hidden: Tensor, successor: Tensor, scene_id: RowScenes) -> Tensor:
        """(\\*B, hidden_size), psi (\\*B, E) and scene indices (\\*B,) to logits (\\*B, A)."""
        constant = successor.detach()
        if self.successor_norm == "layer":
            constant = functional.layer_norm(constant, constant.shape[-1:], eps=1e-6)
        code = functional.relu(self.first(torch.cat([hidden, constant.to(hidden.dtype)], -1), scene_id))
        logits = full_precision(self.last(code, scene_id), self.last.weight)
        return functional.relu(logits) if self.rectify_logits else logits
