"""Intervals against hand-computed cases, all resamples counted out, and scipy's bootstrap."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor

from vusfa.errors import ConfigError
from vusfa.evaluation.statistics import (
    Estimate,
    Sums,
    bootstrap_improvement,
    bootstrap_iqm,
    bootstrap_mean,
    crossed_draws,
    improvement,
    interquartile_mean,
    interval,
    paired_difference,
    resample_counts,
)

MANY = 20_000


def drawn(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def means(table: Tensor) -> Sums:
    """Of tables whose every cell is one episode."""
    return Sums(table, torch.ones_like(table))


def scipys(data: tuple[Any, ...], statistic: Callable[..., Any], paired: bool = False) -> tuple[float, float]:
    found = stats.bootstrap(
        data,
        statistic,
        n_resamples=MANY,
        vectorized=False,
        paired=paired,
        method="percentile",
        rng=np.random.default_rng(1),
    ).confidence_interval
    return found.low, found.high


def test_percentiles_by_hand():
    draws = torch.tensor([4.0, math.nan, 0.0, 3.0, 1.0, 2.0])
    assert interval(2.0, draws, 0.5) == Estimate(2.0, 1.0, 3.0)
    assert interval(2.0, draws, 1.0) == Estimate(2.0, 0.0, 4.0)
    assert math.isnan(interval(math.nan, draws).low)


def test_draws_stay_within_their_group_and_are_uniform():
    groups = torch.tensor([5, 2, 5, 2, 2])
    counts = resample_counts(groups, MANY, torch.Generator().manual_seed(0))
    assert (counts[:, groups == 5].sum(1) == 2).all()
    assert (counts[:, groups == 2].sum(1) == 3).all()
    # a binomial count of 3 draws of chance 1/3 has the variance 2/3
    torch.testing.assert_close(counts.mean(0), torch.ones(5, dtype=torch.float64), atol=0.03, rtol=0)
    assert counts[:, 1].var().item() == pytest.approx(2 / 3, abs=0.03)


def test_all_resamples_of_two_seeds_and_two_goals():
    """Each of the 4 x 4 ways to draw two seeds and two goals is one sixteenth of the resamples."""
    table = torch.tensor([[0.0, 1.0], [10.0, 100.0]])
    ways = [
        table[list(seeds)][:, list(goals)].mean().item()
        for seeds in itertools.product(range(2), repeat=2)
        for goals in itertools.product(range(2), repeat=2)
    ]
    value, draws = crossed_draws(means(table), torch.zeros(2), resamples=MANY)
    assert value == 27.75
    for way in set(ways):
        assert (draws == way).double().mean().item() == pytest.approx(ways.count(way) / 16, abs=0.01)
    assert (torch.isin(draws, torch.tensor(ways, dtype=torch.float64))).all()


def test_goals_are_drawn_within_their_scene():
    """One goal a scene: only the seeds are left to chance."""
    table = torch.tensor([[0.0, 8.0], [2.0, 10.0]])
    _, draws = crossed_draws(means(table), torch.tensor([0, 1]), resamples=500)
    assert set(draws.tolist()) == {4.0, 5.0, 6.0}


def test_both_averages():
    """Three goals in one scene and one in another."""
    sums, scene = means(torch.tensor([[1.0, 1.0, 1.0, 0.0]])), torch.tensor([0, 0, 0, 1])
    assert bootstrap_mean(sums, scene).value == 0.75
    assert bootstrap_mean(sums, scene, by_scene=True).value == 0.5


def test_a_ratio_of_means_is_one_of_sums():
    sums = Sums(torch.tensor([[6.0, 0.0], [30.0, 8.0]]), torch.tensor([[3.0, 0.0], [10.0, 8.0]]))
    assert bootstrap_mean(sums, torch.zeros(2)).value == pytest.approx(44 / 21)
    lost = Sums(torch.zeros(2, 2), torch.zeros(2, 2))
    assert all(math.isnan(number) for number in bootstrap_mean(lost, torch.zeros(2)))


def test_same_seed_same_interval():
    sums, scene = means(drawn(3, 9)), torch.zeros(9)
    assert bootstrap_mean(sums, scene, seed=4) == bootstrap_mean(sums, scene, seed=4)
    assert bootstrap_mean(sums, scene, seed=4) != bootstrap_mean(sums, scene, seed=5)


def test_one_level_is_scipys_bootstrap():
    goals = drawn(1, 40) ** 3
    for table in (goals, goals.T):  # over goals of one seed, over seeds with one goal
        found = bootstrap_mean(means(table), torch.zeros(table.shape[1]), resamples=MANY)
        low, high = scipys((goals.flatten().numpy(),), np.mean)
        assert (found.low, found.high) == pytest.approx((low, high), abs=0.004)


def test_a_paired_difference_is_scipys():
    first, second = drawn(1, 30), drawn(1, 30) + 0.2 * drawn(1, 30, seed=1)
    found = paired_difference(means(first), means(second), torch.zeros(30), resamples=MANY)
    low, high = scipys(
        (first.flatten().numpy(), second.flatten().numpy()), lambda a, b: np.mean(a - b), paired=True
    )
    assert found.value == pytest.approx((first - second).mean().item())
    assert (found.low, found.high) == pytest.approx((low, high), abs=0.003)
    assert found.high - found.low < 0.06  # both vary by much more than their difference


def test_a_ratio_is_scipys():
    lengths, shortest = 1 + drawn(1, 25), drawn(1, 25, seed=2)
    found = bootstrap_mean(Sums(lengths, shortest), torch.zeros(25), resamples=MANY)
    low, high = scipys(
        (lengths.flatten().numpy(), shortest.flatten().numpy()), lambda a, b: a.sum() / b.sum(), paired=True
    )
    assert (found.low, found.high) == pytest.approx((low, high), rel=0.02)


def test_the_middle_half():
    assert interquartile_mean(torch.tensor([8.0, 1.0, 2.0, 4.0, 100.0])).item() == pytest.approx(14 / 3)
    scores = drawn(7, 22)
    expected = [stats.trim_mean(row.numpy(), 0.25) for row in scores]
    np.testing.assert_allclose(interquartile_mean(scores).numpy(), expected)


def test_the_middle_half_of_one_scene_is_scipys():
    scores = drawn(12, 1) ** 2
    found = bootstrap_iqm(scores, resamples=MANY)
    low, high = scipys((scores.flatten().numpy(),), lambda sample: stats.trim_mean(sample, 0.25))
    assert (found.low, found.high) == pytest.approx((low, high), abs=0.01)


def test_the_middle_half_draws_seeds_within_scenes():
    """Where all seeds of a scene agree nothing varies, however far the scenes are apart."""
    found = bootstrap_iqm(torch.tensor([0.0, 1.0, 2.0, 9.0]).expand(5, 4))
    assert found == Estimate(1.5, 1.5, 1.5)


def test_improvement_by_hand():
    first, second = torch.tensor([[1.0, 5.0], [3.0, 5.0]]), torch.tensor([[2.0, 5.0], [0.0, 4.0], [3.0, 6.0]])
    # scene 0: 1 beats one of three, 3 beats two and ties one; scene 1: each beats one and ties one
    expected = ((1 + 2.5) / 6 + (1.5 + 1.5) / 6) / 2
    assert improvement(first, second).item() == pytest.approx(expected)
    assert improvement(second, first).item() == pytest.approx(1 - expected)


def test_improvement_of_one_scene_is_scipys():
    first, second = drawn(9, 1), drawn(7, 1, seed=3)
    statistic = stats.mannwhitneyu(first.flatten().numpy(), second.flatten().numpy()).statistic
    found = bootstrap_improvement(first, second, resamples=MANY)
    assert found.value == pytest.approx(statistic / 63)
    low, high = scipys(
        (first.flatten().numpy(), second.flatten().numpy()),
        lambda a, b: (np.sign(a[:, None] - b[None]) / 2 + 0.5).mean(),
    )
    assert (found.low, found.high) == pytest.approx((low, high), abs=0.02)


def test_one_seed_cannot_be_drawn_again():
    one, three = drawn(1, 4), drawn(3, 4)
    for found in (bootstrap_iqm(one), bootstrap_improvement(one, three), bootstrap_improvement(three, one)):
        assert not math.isnan(found.value)
        assert math.isnan(found.low)
        assert math.isnan(found.high)


def test_tables_that_do_not_fit():
    sums = means(torch.ones(2, 3))
    with pytest.raises(ConfigError, match="scene for each goal"):
        bootstrap_mean(sums, torch.zeros(2))
    with pytest.raises(ConfigError, match="same seeds and goals"):
        paired_difference(sums, means(torch.ones(1, 3)), torch.zeros(3))
    with pytest.raises(ConfigError, match="same scenes"):
        bootstrap_improvement(torch.ones(2, 3), torch.ones(2, 4))
    with pytest.raises(ConfigError, match="0 goals"):
        bootstrap_mean(means(torch.ones(2, 0)), torch.zeros(0))
