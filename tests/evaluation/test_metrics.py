"""The measures against hand-computed numbers and against plain Python."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from vusfa.evaluation.metrics import length_ratio, soft_spl, spl, success_rate, weighted_mean

EPISODE = st.tuples(st.booleans(), st.integers(1, 40), st.integers(1, 40))


def test_hand_computed():
    success = torch.tensor([True, True, True, False])
    length = torch.tensor([5, 10, 100, 100])
    shortest = torch.tensor([5, 5, 20, -1])
    assert success_rate(success, length, 100) == 0.75
    assert success_rate(success, length, 10) == 0.5
    assert success_rate(success, length, 9) == 0.25
    assert spl(success, length, shortest) == pytest.approx((1 + 0.5 + 0.2 + 0) / 4)
    assert length_ratio(success, length, shortest) == pytest.approx(115 / 30)


def test_soft_spl_counts_the_way_that_is_done():
    length = torch.tensor([5, 10, 500, 500, 500, 500])
    shortest = torch.tensor([5, 5, 20, 20, -1, 20])
    remaining = torch.tensor([0, 0, 5, 30, -1, -1])  # there, there, nearer, farther, no path, no path left
    expected = (1 + 0.5 + 0.75 * 20 / 500 + 0 + 0 + 0) / 6
    assert soft_spl(length, shortest, remaining) == pytest.approx(expected)


def test_without_episodes_or_success_there_is_no_number():
    nothing = torch.zeros(0, dtype=torch.int64)
    assert math.isnan(success_rate(nothing > 0, nothing, 5))
    assert math.isnan(spl(nothing > 0, nothing, nothing))
    lost = torch.tensor([False])
    assert math.isnan(length_ratio(lost, torch.tensor([9]), torch.tensor([3])))
    assert spl(lost, torch.tensor([9]), torch.tensor([3])) == 0.0
    assert math.isnan(weighted_mean([math.nan], [3]))


@given(st.lists(EPISODE, min_size=1, max_size=30), st.integers(0, 50))
def test_against_plain_python(episodes: list[tuple[bool, int, int]], within: int):
    success = torch.tensor([s for s, _, _ in episodes])
    shortest = torch.tensor([d for _, d, _ in episodes])
    length = torch.tensor([d + extra for _, d, extra in episodes])
    arrived = [s and d + extra <= within for s, d, extra in episodes]
    assert success_rate(success, length, within) == pytest.approx(sum(arrived) / len(episodes))
    each = [d / max(d + extra, d) if s else 0.0 for s, d, extra in episodes]
    assert spl(success, length, shortest) == pytest.approx(sum(each) / len(episodes))
    assert 0.0 <= spl(success, length, shortest) <= success_rate(success, length, 100)


@given(st.lists(st.tuples(st.floats(-5, 5), st.integers(1, 9)), min_size=1, max_size=9))
def test_weighted_mean_is_the_mean_of_repeats(pairs: list[tuple[float, int]]):
    repeated = [value for value, weight in pairs for _ in range(weight)]
    found = weighted_mean([value for value, _ in pairs], [weight for _, weight in pairs])
    assert found == pytest.approx(sum(repeated) / len(repeated), abs=1e-9)
