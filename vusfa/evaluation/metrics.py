"""What a set of episodes amounts to: success, SPL, detour, collisions. Pure functions of tensors, one row an
episode.

The measures and their sources:

- success within k steps: the agent stood on the goal after at most k actions.
- SPL, success weighted by path length (Anderson et al. 2018, arXiv 1807.06757, eq. 1), counted in actions
  instead of metres: the mean over episodes of ``success * shortest / max(length, shortest)``.
- soft-SPL (Datta et al. 2020, arXiv 2009.03231, sec. 4): success is replaced by the share of the way to the
  goal that is behind the agent when the episode ends, ``max(0, 1 - remaining / shortest)``.
- length over shortest path: mean length of the successful episodes over the mean of their shortest paths. A
  ratio of means, not a mean of ratios: in the latter an episode that starts beside its goal weighs as much as
  a long one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

__all__ = [
    "length_ratio",
    "soft_spl",
    "soft_spl_scores",
    "spl",
    "spl_scores",
    "success_rate",
    "weighted_mean",
]


def success_rate(success: Tensor, length: Tensor, within: int) -> float:
    """Share of the episodes that met their goal after at most ``within`` actions, NaN without episodes.

    Args:
        success: (n,) bool, the goal was met.
        length: (n,) actions taken.
        within: actions allowed.

    >>> success_rate(torch.tensor([True, True, False]), torch.tensor([3, 80, 100]), within=50)
    0.3333333333333333
    """
    return (success & (length <= within)).to(torch.float64).mean().item()


def spl(success: Tensor, length: Tensor, shortest: Tensor) -> float:
    """Success weighted by path length, in actions (Anderson et al. 2018, eq. 1), NaN without episodes.

    Args:
        success: (n,) bool, the goal was met.
        length: (n,) actions taken.
        shortest: (n,) fewest actions possible, -1 where there is no path (such an episode has failed).

    >>> spl(torch.tensor([True, True, False]), torch.tensor([4, 8, 99]), torch.tensor([4, 4, 4]))
    0.5
    """
    return spl_scores(success, length, shortest).mean().item()


def spl_scores(success: Tensor, length: Tensor, shortest: Tensor) -> Tensor:
    """:func:`spl` of each episode, (n,) float64.

    >>> spl_scores(torch.tensor([True, True, False]), torch.tensor([4, 8, 99]), torch.tensor([4, 4, 4]))
    tensor([1.0000, 0.5000, 0.0000], dtype=torch.float64)
    """
    best = shortest.to(torch.float64)
    return torch.where(success, best / torch.maximum(length.to(torch.float64), best), 0.0)


def soft_spl(length: Tensor, shortest: Tensor, remaining: Tensor) -> float:
    """SPL with progress instead of success (Datta et al. 2020), in actions, NaN without episodes.

    Args:
        length: (n,) actions taken.
        shortest: (n,) fewest actions possible, -1 where there is no path (such an episode counts 0).
        remaining: (n,) fewest actions from where it ended to the goal, -1 where no path is left.

    >>> soft_spl(torch.tensor([8, 8, 8]), torch.tensor([4, 4, 4]), torch.tensor([0, 1, 7]))
    0.2916666666666667
    """
    return soft_spl_scores(length, shortest, remaining).mean().item()


def soft_spl_scores(length: Tensor, shortest: Tensor, remaining: Tensor) -> Tensor:
    """:func:`soft_spl` of each episode, (n,) float64.

    >>> soft_spl_scores(torch.tensor([8, 8]), torch.tensor([4, 4]), torch.tensor([0, 1]))
    tensor([0.5000, 0.3750], dtype=torch.float64)
    """
    best = shortest.to(torch.float64)
    progress = (1 - remaining / best.clamp(min=1)).clamp(min=0)
    scores = progress * best / torch.maximum(length.to(torch.float64), best)
    return torch.where((best > 0) & (remaining >= 0), scores, 0.0)


def length_ratio(success: Tensor, length: Tensor, shortest: Tensor) -> float:
    """Mean length of the successful episodes over the mean of their shortest paths, NaN when none succeeded.

    >>> length_ratio(torch.tensor([True, True, False]), torch.tensor([4, 8, 99]), torch.tensor([4, 4, 4]))
    1.5
    """
    taken = length[success].sum().item()
    best = shortest[success].sum().item()
    return taken / best if best else math.nan


def weighted_mean(values: Sequence[float], weights: Sequence[float]) -> float:
    """Mean of ``values`` weighted by ``weights``; a NaN value drops out with its weight, NaN when nothing is
    left.

    >>> weighted_mean([1.0, 0.5, math.nan], [1, 3, 9])
    0.625
    """
    kept = [(v, w) for v, w in zip(values, weights, strict=True) if not math.isnan(v)]
    total = sum(w for _, w in kept)
    return sum(v * w for v, w in kept) / total if total else math.nan
