"""Actions from logits: the draws of ``torch.distributions.Categorical``, without its checks."""

from __future__ import annotations

import torch
from tensordict.nn.probabilistic import InteractionType
from torch import Tensor

__all__ = ["action_probs", "draw", "draw_actions"]


def draw_actions(logits: Tensor, interaction: InteractionType | None = None) -> Tensor:
    """Actions (R,) int64 of logits (R, A).

    Args:
        logits: of the actions.
        interaction: MODE or DETERMINISTIC for the likeliest; RANDOM or None for a draw from the softmax.

    Raises:
        NotImplementedError: for a mean or a median, which actions do not have.

    >>> draw_actions(torch.tensor([[0.0, 9.0], [3.0, 1.0]]), InteractionType.DETERMINISTIC)
    tensor([1, 0])
    """
    if interaction in (InteractionType.MODE, InteractionType.DETERMINISTIC):
        return logits.argmax(-1)
    if interaction in (None, InteractionType.RANDOM):
        return draw(action_probs(logits))
    raise NotImplementedError(f"interaction type {interaction}: actions have none; take RANDOM or MODE")


def action_probs(logits: Tensor) -> Tensor:
    """Probabilities (\\*B, A) of logits (\\*B, A), rounded as ``torch.distributions.Categorical`` does.

    >>> action_probs(torch.tensor([0.0, 0.0]))
    tensor([0.5000, 0.5000])
    """
    return (logits - logits.logsumexp(-1, keepdim=True)).softmax(-1)


def draw(probs: Tensor) -> Tensor:
    """Actions (\\*B,) int64 drawn from probabilities (\\*B, A), number for number as ``torch.multinomial``.

    The same race: exponential clocks, of which the first to ring wins.

    >>> draw(torch.tensor([[0.0, 1.0], [1.0, 0.0]]))
    tensor([1, 0])
    """
    clocks = torch.empty_like(probs, memory_format=torch.contiguous_format).exponential_()
    return (probs / clocks).argmax(-1)
