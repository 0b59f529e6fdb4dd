"""Tables of hand-made cells, whose numbers can be told beforehand."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch

from vusfa.evaluation import Episodes
from vusfa.evaluation.exact import ExactGoals
from vusfa.evaluation.statistics import Estimate
from vusfa.experiments.runs import Run, write_run
from vusfa.report.experiment import Experiment, read_experiment
from vusfa.report.markdown import flat_rows, markdown
from vusfa.report.result_tables import (
    comparison_rows,
    distance_rows,
    middle_rows,
    model_rows,
    run_rows,
)
from vusfa.scenes import SceneSet


def episodes(rooms: SceneSet, reached: dict[tuple[int, int], int]) -> Episodes:
    """Four episodes to each goal, of which so many succeed, as short as can be; goal 3 of the hall is
    trained."""
    places = [place for place in reached for _ in range(4)]
    scene, goal = (torch.tensor(column) for column in zip(*places, strict=True))
    start = torch.zeros_like(goal)
    success = torch.tensor([i < count for count in reached.values() for i in range(4)])
    shortest = rooms.distance(start + rooms.offsets[scene], goal + rooms.offsets[scene])
    length = torch.where(success, shortest, 500)
    trained = (scene == 0) & (goal == 3)
    remaining = torch.where(success, 0, shortest)
    return Episodes(
        scene, goal, start, success, length, shortest, length % 3, trained, ("hall", "attic"), 500, remaining
    )


@pytest.fixture
def experiment(tmp_path: Path, rooms: SceneSet) -> Experiment:
    """gvf reaches the trained goal always, the others never; usfa of seed 0 one half of all others, that of
    seed 1 all of them in the hall."""
    for model, seed, counts in (
        ("gvf", 0, (4, 0, 0, 0)),
        ("gvf", 1, (4, 0, 0, 0)),
        ("usfa", 0, (2, 2, 2, 2)),
        ("usfa", 1, (4, 4, 2, 2)),
    ):
        places = ((0, 3), (0, 9), (1, 4), (1, 14))
        table = episodes(rooms, dict(zip(places, counts, strict=True)))
        chance = torch.full((4,), 0.5, dtype=torch.float64)
        scene, goal = (torch.tensor(column) for column in zip(*places, strict=True))
        exact = (
            ExactGoals(scene, goal, dict.fromkeys(("success_500", "success_100", "spl"), chance))
            if model == "usfa"
            else None
        )
        info = {"model": model, "seed": seed, "agent_preset": "controlled", "frames": 1000, "training_s": 2.5}
        write_run(tmp_path, Run("a", f"{model}-{seed}", info, {"sampled": table}, exact))
    return read_experiment(tmp_path, ["a"], rooms)


def find(rows: list[dict[str, Any]], **wanted: Any) -> dict[str, Any]:
    (row,) = [row for row in rows if all(row[key] == value for key, value in wanted.items())]
    return row


def test_cells_say_what_is_solved_and_how_far_from_exact(experiment: Experiment) -> None:
    rows = run_rows(experiment)
    assert [(row["model"], row["seed"], row["trained"], row["solved"]) for row in rows] == [
        ("gvf", 0, 1.0, True), ("gvf", 1, 1.0, True), ("usfa", 0, 0.5, False), ("usfa", 1, 1.0, True),
    ]  # fmt: skip
    assert math.isnan(rows[0]["exact_z"])
    assert rows[2]["exact_z"] == 0.0
    # 12 of 16 succeed; of a fair coin 8 would, with the deviation 2
    assert rows[3]["exact_z"] == pytest.approx(2.0)


def test_models_subsets_scenes_and_averages(experiment: Experiment, rooms: SceneSet) -> None:
    rows = model_rows(experiment, "sampled", resamples=200)
    assert find(rows, model="gvf", goals="trained", scene="hall")["success_500"] == Estimate(1.0, 1.0, 1.0)
    row = find(rows, model="usfa", goals="unseen", scene="hall")
    assert row["success_500"] == Estimate(0.75, 0.5, 1.0)  # one goal, two seeds
    assert (row["seeds"], row["num_goals"]) == (2, 1)
    assert find(rows, model="usfa", goals="unseen", scene="attic")["spl"] == Estimate(0.5, 0.5, 0.5)
    assert find(rows, model="usfa", goals="unseen", scene="mean of scenes")["success_500"].value == 0.625
    assert find(rows, model="usfa", goals="unseen", scene="mean of states")["success_500"].value == (
        pytest.approx((0.75 + 0.5 + 0.5) / 3)
    )
    assert find(rows, model="gvf", goals="all", scene="mean of states")["soft_spl"].value == 0.25
    assert find(rows, model="shortest path", goals="all", scene="hall")["spl"].value == 1.0
    walk = find(rows, model="random walk", goals="unseen", scene="hall")
    assert walk["seeds"] == "–"
    assert 0 < walk["success_100"].value <= walk["success_500"].value
    assert not [row for row in rows if (row["goals"], row["scene"]) == ("trained", "attic")]


def test_exact_numbers_where_cells_have_them(experiment: Experiment) -> None:
    rows = model_rows(experiment, "exact", resamples=50)
    assert {row["model"] for row in rows} == {"usfa", "random walk", "shortest path"}
    assert find(rows, model="usfa", goals="all", scene="mean of states")["spl"] == Estimate(0.5, 0.5, 0.5)


def test_by_distance(experiment: Experiment, rooms: SceneSet) -> None:
    """The attic has no trained goal: only the hall's two goals are at a distance."""
    rows = distance_rows(experiment, "sampled", resamples=50)
    away = int(rooms.scenes[0].distance[3, 9])
    assert away >= 1
    assert {row["distance"] for row in rows} == {"0", "1–2" if away < 3 else "3–4" if away < 5 else "5–7"}
    assert find(rows, distance="0", model="usfa")["success_500"].value == 0.75
    assert sum(row["num_goals"] for row in rows if row["model"] == "gvf") == 2


def test_the_middle_half_over_seeds_and_scenes(experiment: Experiment) -> None:
    row = find(middle_rows(experiment, "sampled", resamples=50), model="usfa", goals="all")
    # hall 0.5 and 1.0, attic 0.5 and 0.5: without the lowest and the highest
    assert row["success_500"].value == 0.5
    assert row["seeds"] == 2


def test_comparisons(experiment: Experiment) -> None:
    rows = comparison_rows(experiment, "sampled", resamples=200)
    row = find(rows, goals="unseen", metric="success_500", model="usfa", against="gvf")
    assert row["difference"].value == pytest.approx((0.75 + 0.5 + 0.5) / 3)
    assert row["improvement"] == Estimate(1.0, 1.0, 1.0)
    row = find(rows, goals="trained", metric="success_500", model="usfa", against="gvf")
    assert row["difference"] == Estimate(-0.25, -0.5, 0.0)
    assert row["improvement"].value == 0.25  # one of two seeds ties
    row = find(rows, goals="trained", metric="spl", model="gvf", against="random walk")
    assert row["difference"].value > 0
    assert "improvement" not in row


def test_rows_as_text() -> None:
    rows = [
        {"model": "a", "seed": 1, "solved": True, "spl": Estimate(0.1234, 0.1, 0.2), "frames": 1000},
        {"model": "b", "seed": 2, "solved": False, "length_ratio": Estimate(math.nan, math.nan, math.nan)},
        {"model": "c", "solved": True, "length_ratio": Estimate(1.5, math.nan, math.nan)},
    ]
    assert markdown(rows, ["model", "solved", "spl", "length_ratio", "frames", "none"]).splitlines() == [
        "| model | solved | SPL, % | length / shortest | frames |",
        "|---|---|---|---|---|",
        "| a | yes | 12.3 [10.0, 20.0] | – | 1,000 |",
        "| b | no | – | – | – |",
        "| c | yes | – | 1.50 | – |",
    ]
    flat = flat_rows(rows)
    assert flat[0]["spl_high"] == 0.2
    assert flat[0].keys() == flat[1].keys()
    assert flat[1]["spl"] == ""
