"""Tables against numbers worked out by hand."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import pytest
import torch

from vusfa.evaluation.exact import ExactGoals
from vusfa.report.by_goal import distance_rows, goal_rows
from vusfa.report.runs import LoggedRun
from vusfa.report.tables import baseline_rows, over_seeds, reference_rows, run_rows, seed_rows, summary_rows
from vusfa.scenes import Scene, SceneSet

# goal, start, success, length, shortest, collisions, trained
FIRST = [(0, 3, 1, 6, 3, 2, 1), (0, 2, 0, 100, 2, 4, 1), (4, 0, 1, 4, 4, 0, 0), (4, 2, 1, 60, 2, 0, 0)]
SECOND = [(0, 3, 1, 3, 3, 0, 1), (0, 2, 1, 4, 2, 0, 1), (4, 0, 0, 100, 4, 0, 0), (4, 2, 0, 100, 2, 0, 0)]


@pytest.fixture
def two_seeds(corridor_run) -> list[LoggedRun]:
    return [corridor_run("a", 0, FIRST), corridor_run("a", 1, SECOND), corridor_run("b", 0, SECOND)]


@pytest.fixture
def corridor() -> SceneSet:
    """Six places in a row; action 0 right, 1 left."""
    graph = torch.tensor([[1, -1], [2, 0], [3, 1], [4, 2], [5, 3], [-1, 4]])
    return SceneSet([Scene("hall", graph, torch.rand(6, 1, 2))])


def test_the_summary_is_over_seeds(two_seeds: list[LoggedRun]):
    rows = {(row["model"], row["goals"]): row for row in summary_rows(two_seeds, within=[50])}
    assert list(rows) == [(m, g) for m in "ab" for g in ("trained", "unseen", "all")]
    trained = rows["a", "trained"]
    assert (trained["seeds"], trained["num_goals"], trained["num_episodes"]) == (2, 1, 2)
    assert (trained["success_100"], trained["success_100_low"], trained["success_100_high"]) == (
        0.75,
        0.5,
        1.0,
    )
    # SPL: (3/6 + 0) / 2 and (3/3 + 2/4) / 2
    assert (trained["spl_low"], trained["spl_high"], trained["spl"]) == (0.25, 0.75, 0.5)
    assert (trained["collisions"], trained["length"]) == (1.5, pytest.approx((6 + 3.5) / 2))
    unseen = rows["a", "unseen"]
    assert (unseen["success_50"], unseen["success_100"]) == (0.25, 0.5)
    assert unseen["length_ratio"] == pytest.approx(64 / 6)  # of the seed that arrived
    assert rows["b", "unseen"]["seeds"] == 1
    assert math.isnan(rows["b", "unseen"]["length"])


def test_seeds_stand_alone_in_their_own_table(two_seeds: list[LoggedRun]):
    rows = [row for row in seed_rows(two_seeds) if row["goals"] == "trained"]
    assert [(row["model"], row["seed"], row["success_100"]) for row in rows] == [
        ("a", 0, 0.5),
        ("a", 1, 1),
        ("b", 0, 1),
    ]


def test_what_runs_stand_beside(two_seeds: list[LoggedRun], corridor: SceneSet):
    found = {(row["policy"], row["goals"]): row for row in reference_rows(two_seeds[0], corridor, [3])}
    assert found["shortest path", "all"]["success_100"] == 1
    # from 3 to 0 in three fair steps: 1/8, from 2 in three: 1/4, from 1: 1/2 + 1/8, from 4 and 5: 0
    # (at 0 the walk has arrived, at 5 it may press against the wall)
    assert found["random walk", "trained"]["success_3"] == pytest.approx((1 / 8 + 1 / 4 + 5 / 8) / 5)
    kept = {
        row["model"]: row
        for row in summary_rows(two_seeds, beside=list(found.values()))
        if row["kind"] == "reference"
    }
    assert kept.keys() == {"random walk", "shortest path"}
    assert math.isnan(kept["random walk"]["seeds"])


def test_a_row_a_goal(two_seeds: list[LoggedRun]):
    rows = {(row["model"], row["goal"]): row for row in goal_rows(two_seeds, within=[50])}
    assert rows.keys() == {("a", 0), ("a", 4), ("b", 0), ("b", 4)}
    goal = rows["a", 4]
    assert (goal["scene"], goal["trained"], goal["seeds"], goal["num_episodes"]) == ("hall", False, 2, 4)
    assert (goal["success_50"], goal["success_100"]) == (0.25, 0.5)
    assert goal["spl"] == pytest.approx((4 / 4 + 2 / 60) / 4)
    assert rows["b", 0]["trained"]
    assert "exact_100" not in goal


def test_exact_chances_where_all_seeds_have_them(two_seeds: list[LoggedRun]):
    def exact(value: float) -> ExactGoals:
        zero = torch.zeros(2)
        metrics = {"success_100": zero + value, "success_500": zero + 2 * value, "spl": zero}
        return ExactGoals(zero.long(), torch.tensor([0, 4]), metrics)

    first, second, third = two_seeds
    given = [
        dataclasses.replace(first, exact=exact(0.1)),
        dataclasses.replace(second, exact=exact(0.3)),
        third,
    ]
    rows = {(row["model"], row["goal"]): row for row in goal_rows(given)}
    assert rows["a", 4]["exact_100"] == pytest.approx(0.2)
    assert rows["a", 4]["exact_500"] == pytest.approx(0.4)
    assert "exact_100" not in rows["b", 4]
    rows = {(row["model"], row["goal"]): row for row in goal_rows([given[0], second])}
    assert "exact_100" not in rows["a", 4]


def test_distance_from_the_nearest_trained_goal(two_seeds: list[LoggedRun], corridor: SceneSet):
    rows = {(row["model"], row["distance"]): row for row in distance_rows(two_seeds, corridor, [50])}
    assert list(rows) == [("a", "0"), ("a", "3–4"), ("b", "0"), ("b", "3–4")]
    far = rows["a", "3–4"]
    assert (far["from"], far["to"], far["seeds"], far["num_goals"]) == (3, 4, 2, 1)
    assert (far["success_50"], far["success_50_low"], far["success_50_high"]) == (0.25, 0.0, 0.5)


def test_missing_numbers_drop_out():
    rows = over_seeds([{"a": math.nan}, {"a": 4.0}, {}], ["a", "b"])
    assert (rows["a"], rows["a_low"], rows["a_high"]) == (4.0, 4.0, 4.0)
    assert math.isnan(rows["b"])


def test_the_runs_themselves(two_seeds: list[LoggedRun]):
    bare = LoggedRun("c", 9, Path("runs/x"), {"scenes": "hall"})
    row, *_, last = run_rows([*two_seeds, bare])
    assert (row["trained_success"], row["unseen_success"], row["evaluated"]) == (0.5, 1.0, "sampled")
    assert (last["folder"], last["evaluated"], last["scenes"]) == ("x", "no", "hall")
    assert math.isnan(last["frames"])


def test_baselines_are_computed_once_per_set_of_goals(
    two_seeds: list[LoggedRun], corridor: SceneSet, monkeypatch: pytest.MonkeyPatch
):
    """The tables show the first row of each name, goals and scene: more runs add none."""
    asked: list[LoggedRun] = []
    computed = reference_rows

    def counted(run: LoggedRun, *rest: object) -> list[dict[str, object]]:
        asked.append(run)
        return computed(run, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr("vusfa.report.tables.reference_rows", counted)
    rows = baseline_rows(two_seeds, corridor, [50])
    assert asked == two_seeds[:1]
    every = [row for run in two_seeds for row in computed(run, corridor, [50])]
    assert str(summary_rows(two_seeds, [50], rows)) == str(summary_rows(two_seeds, [50], every))
    # goals that the first run has not are added
    assert two_seeds[0].episodes is not None
    part = two_seeds[0].episodes.select(two_seeds[0].episodes.trained)
    asked.clear()
    baseline_rows([dataclasses.replace(two_seeds[0], episodes=part), *two_seeds], corridor, [50])
    assert len(asked) == 2
