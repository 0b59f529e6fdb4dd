"""Bootstrap intervals over seeds and goals, interquartile means, probability of improvement.

A result is a table of numbers per seed and goal, (K, G). Seeds and goals are both samples, so both are
resampled with replacement: the crossed, or pigeonhole, bootstrap (Owen 2007, "The pigeonhole bootstrap",
Annals of Applied Statistics 1(2), sec. 2). Goals are resampled within their scenes, which are fixed.
Intervals are percentiles of the resamples. The same seed and shape give the same draws, so differences are
paired.

The interquartile mean and the probability of improvement follow Agarwal et al. 2021, "Deep Reinforcement
Learning at the Edge of the Statistical Precipice" (arXiv 2108.13264, sec. 4): over seeds and scenes, with
seeds resampled within each scene.

A bootstrap over five seeds gives intervals that are somewhat too narrow. The interval of one seed is over
goals only, and NaN where only seeds are resampled.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from vusfa.errors import ConfigError

__all__ = [
    "Draws",
    "Estimate",
    "Sums",
    "bootstrap_improvement",
    "bootstrap_iqm",
    "bootstrap_mean",
    "crossed_draws",
    "improvement",
    "interquartile_mean",
    "interval",
    "make_draws",
    "paired_difference",
    "resample_counts",
]


class Estimate(NamedTuple):
    """A number with its interval."""

    value: float
    low: float
    high: float


class Draws(NamedTuple):
    """How often each seed and each goal is drawn in each of R resamples: (R, K) and (R, G) float64."""

    seeds: Tensor
    goals: Tensor


class Sums(NamedTuple):
    """Numerator and denominator of a mean or a ratio of means, per seed and goal.

    Attributes:
        numerator: (K, G) float64, sums over the episodes of a seed to a goal: of successes, of lengths, ...
        denominator: (K, G) float64, the number of these episodes, or the sum to compare with.
    """

    numerator: Tensor
    denominator: Tensor


def interval(value: float, draws: Tensor, level: float = 0.95) -> Estimate:
    """A value with the percentile interval of its resamples, NaN left out.

    Args:
        value: of the data as they are.
        draws: (R,) of the resamples.
        level: share of the resamples within the interval.

    >>> interval(2.0, torch.arange(5.0), level=0.5)
    Estimate(value=2.0, low=1.0, high=3.0)
    """
    kept = draws[~draws.isnan()].to(torch.float64)
    if math.isnan(value) or not kept.numel():
        return Estimate(value, math.nan, math.nan)
    ends = torch.tensor([(1 - level) / 2, (1 + level) / 2], dtype=torch.float64)
    low, high = torch.quantile(kept, ends).tolist()
    return Estimate(value, low, high)


def resample_counts(groups: Tensor, resamples: int, generator: torch.Generator) -> Tensor:
    """Counts of each item when every group is resampled with replacement.

    Args:
        groups: (n,) int64, the group of each item.
        resamples: R.
        generator: source of the draws.

    Returns:
        (R, n) float64; the counts of a group sum to its size.

    >>> counts = resample_counts(torch.tensor([0, 0, 1]), 4, torch.Generator().manual_seed(0))
    >>> counts[:, :2].sum(1).tolist(), counts[:, 2].tolist()
    ([2.0, 2.0, 2.0, 2.0], [1.0, 1.0, 1.0, 1.0])
    """
    counts = torch.zeros(resamples, len(groups), dtype=torch.float64)
    for group in groups.unique().tolist():
        members = (groups == group).nonzero().squeeze(1)
        drawn = members[torch.randint(len(members), (resamples, len(members)), generator=generator)]
        counts.scatter_add_(1, drawn, torch.ones_like(drawn, dtype=torch.float64))
    return counts


def make_draws(seeds: int, scene: Tensor, *, resamples: int = 2000, seed: int = 0) -> Draws:
    """Draw seeds, and goals within their scenes, with replacement.

    Args:
        seeds: K.
        scene: (G,) int64, of each goal.
        resamples: R.
        seed: of the draws.

    >>> draws = make_draws(3, torch.tensor([0, 0, 1]), resamples=4)
    >>> draws.seeds.sum(1).tolist(), draws.goals.shape
    ([3.0, 3.0, 3.0, 3.0], torch.Size([4, 3]))
    """
    generator = torch.Generator().manual_seed(seed)
    seed_counts = resample_counts(torch.zeros(seeds, dtype=torch.int64), resamples, generator)
    return Draws(seed_counts, resample_counts(scene, resamples, generator))


def crossed_draws(
    sums: Sums,
    scene: Tensor,
    *,
    by_scene: bool = False,
    resamples: int = 2000,
    seed: int = 0,
    draws: Draws | None = None,
) -> tuple[float, Tensor]:
    """The mean (numerators over denominators) and its resamples over seeds and goals.

    Args:
        sums: (K, G).
        scene: (G,) int64, of each goal.
        by_scene: the mean of the scenes' means, instead of one in which every goal weighs the same.
        resamples, seed: of :func:`make_draws`.
        draws: made already, for several tables of one shape.

    Returns:
        the mean, and (R,) float64.

    >>> one = torch.ones(1, 2, dtype=torch.float64)
    >>> value, draws = crossed_draws(Sums(one * torch.tensor([1.0, 4.0]), one), torch.zeros(2))
    >>> value, sorted(set(draws.tolist()))
    (2.5, [1.0, 2.5, 4.0])
    """
    _check(sums, scene)
    seeds, goals = sums.numerator.shape
    draws = make_draws(seeds, scene, resamples=resamples, seed=seed) if draws is None else draws
    once = Draws(torch.ones(1, seeds, dtype=torch.float64), torch.ones(1, goals, dtype=torch.float64))
    return _weighted(sums, scene, once, by_scene).item(), _weighted(sums, scene, draws, by_scene)


def _weighted(sums: Sums, scene: Tensor, draws: Draws, by_scene: bool) -> Tensor:
    """(R,): sum_k seeds[r, k] sum_g goals[r, g] numerator[k, g] over the like, one ratio for each scene."""
    parts = [scene == index for index in scene.unique()] if by_scene else [slice(None)]
    ratios = []
    for part in parts:
        chosen = draws.goals[:, part]
        over, under = ((chosen @ table[:, part].T.to(torch.float64) * draws.seeds).sum(1) for table in sums)
        ratios.append(torch.where(under > 0, over / under, math.nan))
    return torch.stack(ratios).nanmean(0)


def bootstrap_mean(sums: Sums, scene: Tensor, **options: Any) -> Estimate:
    """A mean over seeds and goals with its interval; see :func:`crossed_draws` for the arguments.

    >>> sums = Sums(torch.tensor([[0.0, 1.0], [0.0, 1.0]]), torch.ones(2, 2))
    >>> bootstrap_mean(sums, torch.tensor([0, 1]))  # a goal in each scene: nothing is left to chance
    Estimate(value=0.5, low=0.5, high=0.5)
    """
    value, drawn = crossed_draws(sums, scene, **options)
    return interval(value, drawn)


def paired_difference(first: Sums, second: Sums, scene: Tensor, **options: Any) -> Estimate:
    """The first mean less the second, with its interval: in every resample both have the same seeds and the
    same goals.

    Args:
        first, second: (K, G), rows of the same seeds and columns of the same goals.
        scene, options: see :func:`crossed_draws`.

    >>> sums = Sums(torch.rand(3, 5), torch.ones(3, 5))
    >>> better = Sums(sums.numerator + 1, sums.denominator)
    >>> [round(number, 6) for number in paired_difference(better, sums, torch.zeros(5))]
    [1.0, 1.0, 1.0]
    """
    if first.numerator.shape != second.numerator.shape:
        raise ConfigError(
            f"a difference of pairs needs the same seeds and goals; these tables (seeds, goals) are"
            f" {tuple(first.numerator.shape)} and {tuple(second.numerator.shape)}"
        )
    (one, ones), (two, twos) = (crossed_draws(sums, scene, **options) for sums in (first, second))
    return interval(one - two, ones - twos)


def interquartile_mean(scores: Tensor) -> Tensor:
    """The mean of the middle half along the last dimension: of n numbers the lowest and the highest
    floor(n / 4) are left out (Agarwal et al. 2021, sec. 4.3; as ``scipy.stats.trim_mean(scores, 0.25)``).

    Args:
        scores: (*B, n).

    >>> interquartile_mean(torch.tensor([0.0, 0.5, 0.75, 9.0])).item()
    0.625
    """
    size = scores.shape[-1]
    cut = size // 4
    return scores.sort(-1).values[..., cut : size - cut].mean(-1)


def bootstrap_iqm(scores: Tensor, *, resamples: int = 2000) -> Estimate:
    """The interquartile mean over seeds and scenes, seeds drawn again within each scene.

    Args:
        scores: (K, T), of K seeds in T scenes.
        resamples: of the interval.

    >>> bootstrap_iqm(torch.tensor([[0.5, 0.25], [0.5, 0.25]])).value
    0.375
    """
    drawn = _redrawn(scores.to(torch.float64), resamples, torch.Generator().manual_seed(0))
    value = interquartile_mean(scores.to(torch.float64).flatten()).item()
    if len(scores) == 1:
        return Estimate(value, math.nan, math.nan)
    return interval(value, interquartile_mean(drawn.flatten(1)))


def improvement(first: Tensor, second: Tensor) -> Tensor:
    """Probability that a run of the first does better than one of the second, a tie being half: the
    Mann-Whitney statistic, averaged over scenes (Agarwal et al. 2021, sec. 4.3).

    Args:
        first: (*B, K, T) scores, of K seeds in T scenes.
        second: (*B, L, T).

    Returns:
        (*B,) float64.

    >>> improvement(torch.tensor([[3.0], [1.0]]), torch.tensor([[2.0], [1.0]])).item()
    0.625
    """
    gap = first.unsqueeze(-2) - second.unsqueeze(-3)
    return ((gap > 0).to(torch.float64) + 0.5 * (gap == 0).to(torch.float64)).mean((-3, -2, -1))


def bootstrap_improvement(first: Tensor, second: Tensor, *, resamples: int = 2000) -> Estimate:
    """:func:`improvement` with its interval; both models' seeds are drawn again, each within its scenes.

    Args:
        first: (K, T).
        second: (L, T), the same scenes.
        resamples: of the interval.

    >>> bootstrap_improvement(torch.tensor([[2.0], [3.0]]), torch.tensor([[0.0], [1.0]]))
    Estimate(value=1.0, low=1.0, high=1.0)
    """
    if first.shape[1:] != second.shape[1:]:
        raise ConfigError(
            f"scores are of {first.shape[1]} and {second.shape[1]} scenes; give both of the same scenes"
        )
    generator = torch.Generator().manual_seed(0)
    one, two = (_redrawn(scores.to(torch.float64), resamples, generator) for scores in (first, second))
    value = improvement(first, second).item()
    if len(first) == 1 or len(second) == 1:
        return Estimate(value, math.nan, math.nan)
    return interval(value, improvement(one, two))


def _redrawn(scores: Tensor, resamples: int, generator: torch.Generator) -> Tensor:
    """(R, K, T): the K seeds of each of T scenes drawn again."""
    seeds, scenes = scores.shape
    chosen = torch.randint(seeds, (resamples, seeds, scenes), generator=generator)
    return scores.expand(resamples, seeds, scenes).gather(1, chosen)


def _check(sums: Sums, scene: Tensor) -> None:
    shape = tuple(sums.numerator.shape)
    if len(shape) != 2 or tuple(sums.denominator.shape) != shape or tuple(scene.shape) != shape[1:]:
        raise ConfigError(
            f"sums must be (seeds, goals) with a scene for each goal; they are {shape} and"
            f" {tuple(sums.denominator.shape)}, with {tuple(scene.shape)} scenes"
        )
    if not all(shape):
        raise ConfigError(f"there are no numbers to draw from: {shape[0]} seeds and {shape[1]} goals")
