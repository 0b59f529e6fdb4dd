"""The measures against hand-computed numbers and against plain Python."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from vusfa.errors import ConfigError
from vusfa.evaluation import METRICS, Episodes, get_metric, register_metric


def value(name: str, success: torch.Tensor, length: torch.Tensor, shortest: torch.Tensor) -> float:
    none = torch.zeros_like(length)
    table = Episodes(none, none, none, success, length, shortest, none, none > 0, ("hall",), 500)
    return get_metric(name).value(table)


EPISODE = st.tuples(st.booleans(), st.integers(1, 40), st.integers(1, 40))


def test_hand_computed():
    success = torch.tensor([True, True, True, False])
    length = torch.tensor([5, 10, 100, 100])
    shortest = torch.tensor([5, 5, 20, -1])
    assert value("success_100", success, length, length) == 0.75
    assert value("success_10", success, length, length) == 0.5
    assert value("success_9", success, length, length) == 0.25
    assert value("spl", success, length, shortest) == pytest.approx((1 + 0.5 + 0.2 + 0) / 4)
    assert value("length_ratio", success, length, shortest) == pytest.approx(115 / 30)


def test_soft_spl_counts_the_way_that_is_done():
    length = torch.tensor([5, 10, 500, 500, 500, 500])
    shortest = torch.tensor([5, 5, 20, 20, -1, 20])
    remaining = torch.tensor([0, 0, 5, 30, -1, -1])  # there, there, nearer, farther, no path, no path left
    expected = (1 + 0.5 + 0.75 * 20 / 500 + 0 + 0 + 0) / 6
    none = torch.zeros_like(length)
    table = Episodes(
        none, none, none, remaining == 0, length, shortest, none, none > 0, ("hall",), 500, remaining
    )
    assert get_metric("soft_spl").value(table) == pytest.approx(expected)
    assert math.isnan(get_metric("soft_spl").value(replace(table, remaining=None)))


def test_without_episodes_or_success_there_is_no_number():
    nothing = torch.zeros(0, dtype=torch.int64)
    assert math.isnan(value("success_5", nothing > 0, nothing, nothing))
    assert math.isnan(value("spl", nothing > 0, nothing, nothing))
    lost = torch.tensor([False])
    assert math.isnan(value("length_ratio", lost, torch.tensor([9]), torch.tensor([3])))
    assert value("spl", lost, torch.tensor([9]), torch.tensor([3])) == 0.0


@given(st.lists(EPISODE, min_size=1, max_size=30), st.integers(0, 50))
def test_against_plain_python(episodes: list[tuple[bool, int, int]], within: int):
    success = torch.tensor([s for s, _, _ in episodes])
    shortest = torch.tensor([d for _, d, _ in episodes])
    length = torch.tensor([d + extra for _, d, extra in episodes])
    arrived = [s and d + extra <= within for s, d, extra in episodes]
    assert value(f"success_{within}", success, length, shortest) == pytest.approx(
        sum(arrived) / len(episodes)
    )
    each = [d / max(d + extra, d) if s else 0.0 for s, d, extra in episodes]
    assert value("spl", success, length, shortest) == pytest.approx(sum(each) / len(episodes))
    assert 0.0 <= value("spl", success, length, shortest) <= value("success_100", success, length, length)


def test_names() -> None:
    assert get_metric("success_30").heading == "success in 30, %"
    with pytest.raises(ConfigError, match="metric 'sql': unknown; give success_N or one of spl"):
        get_metric("sql")
    for name in ("spl", "success_9"):
        with pytest.raises(ConfigError, match="registered already"):
            register_metric(name, label="")
    assert list(METRICS) == ["spl", "soft_spl", "length", "length_ratio", "collisions"]
