"""Intervals are those of vusfa.evaluation.statistics, of the right sums."""

from __future__ import annotations

import math

import pandas as pd
import pytest
import torch

from vusfa.evaluation import Episodes, summary
from vusfa.evaluation.long_table import episode_rows, goal_sums
from vusfa.evaluation.statistics import Sums, bootstrap_mean
from vusfa.report.intervals import intervals

NAMES = ("success_9", "success_4", "spl", "length", "length_ratio", "collisions")


def table(seed: int, goals: int = 6, episodes: int = 4) -> Episodes:
    """Random episodes in two scenes of as many goals each."""
    drawn = torch.Generator().manual_seed(seed)
    goal = torch.arange(goals).repeat_interleave(episodes).repeat(2)
    shortest = torch.randint(1, 4, goal.shape, generator=drawn)
    length = shortest + torch.randint(0, 6, goal.shape, generator=drawn)
    success = torch.rand(goal.shape, generator=drawn) < 0.7
    collisions = torch.randint(0, 5, goal.shape, generator=drawn)
    scene = (torch.arange(len(goal)) >= goals * episodes).long()
    length = torch.where(success, length, 9)
    return Episodes(
        scene, goal, goal + 1, success, length, shortest, collisions, goal < 1, ("hall", "attic"), 9
    )


def rows(episodes: Episodes) -> pd.DataFrame:
    return episode_rows(episodes, "x", within=[4])


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("scene", ["hall", "attic", "mean of scenes"])
def test_of_one_seed_they_are_about_the_summary(name: str, scene: str):
    (row,) = (r for r in summary(table(0), "x", [4]) if (r["goals"], r["scene"]) == ("all", scene))
    found = intervals([rows(table(0))], scene, [name])
    assert found[f"{name}_from"] < row[name] < found[f"{name}_to"]


@pytest.mark.parametrize("name", NAMES)
def test_sums_make_the_summary(name: str):
    one = table(0)
    found = goal_sums([rows(one), rows(table(1))], name)
    assert found is not None
    sums, scene = found
    assert sums.numerator.shape == (2, 12)
    assert scene.tolist() == [0] * 6 + [1] * 6
    (row,) = (r for r in summary(one, "x", [4]) if (r["goals"], r["scene"]) == ("all", "hall"))
    hall = Sums(sums.numerator[:1, :6], sums.denominator[:1, :6])
    assert (hall.numerator.sum() / hall.denominator.sum()).item() == pytest.approx(row[name])


def test_they_are_those_of_the_library():
    sums = goal_sums([rows(table(0)), rows(table(1))], "spl")
    assert sums is not None
    _, low, high = bootstrap_mean(*sums, by_scene=True)
    both = [rows(table(0)), rows(table(1))]
    assert intervals(both, "mean of scenes", ["spl"]) == {"spl_from": low, "spl_to": high}
    _, low, high = bootstrap_mean(*sums)
    assert intervals(both, "mean of states", ["spl"]) == {"spl_from": low, "spl_to": high}


def test_none_where_seeds_have_different_goals():
    assert goal_sums([rows(table(0)), rows(table(1, goals=5))], "spl") is None
    assert goal_sums([], "spl") is None
    found = intervals([rows(table(0)), rows(table(1, goals=5))], "hall", ["spl"])
    assert all(math.isnan(value) for value in found.values())
