"""Cells side by side, against numbers from plain Python."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from vusfa.errors import ResultError
from vusfa.evaluation import Episodes, episode_starts, evaluate, random_walk
from vusfa.evaluation.exact import exact_goals, uniform_probabilities
from vusfa.evaluation.long_table import distance_to_trained, episode_rows
from vusfa.experiments.runs import Run, read_run, write_run
from vusfa.report.experiment import Experiment, read_experiment
from vusfa.scenes import Scene, SceneSet

Policies = dict[str, Callable[..., Any]]


@pytest.fixture
def walked(rooms: SceneSet, policies: Policies) -> Callable[..., Episodes]:
    goals = torch.tensor([3, 9, 20, 30])
    episodes = episode_starts(rooms, goals, 6, generator=torch.Generator().manual_seed(0))

    def made(policy: str = "dice", seed: int = 0, *given: Any) -> Episodes:
        return evaluate(policies[policy](*given), rooms, episodes=episodes, trained=goals[:1], seed=seed)

    return made


@pytest.fixture
def results(tmp_path: Path, rooms: SceneSet, walked: Callable[..., Episodes]) -> Path:
    chances = exact_goals(uniform_probabilities(4), rooms)
    for seed in (1, 0):
        info = {"model": "vusfa", "row": "vusfa", "seed": seed, "architecture": "controlled"}
        write_run(tmp_path, Run("a", f"vusfa-{seed}", info, {"sampled": walked("dice", seed)}, chances))
    info = {"model": "gvf", "seed": 0, "architecture": "paper"}
    write_run(tmp_path, Run("a", "gvf-0", info, {"sampled": walked("guide", 0, rooms)}))
    return tmp_path


@pytest.fixture
def experiment(results: Path, rooms: SceneSet) -> Experiment:
    return read_experiment(results, ["a"], rooms)


def test_cells_are_grouped_and_in_order(experiment: Experiment) -> None:
    assert list(experiment.runs) == ["vusfa", "gvf (paper)"]
    assert experiment.seeds("vusfa") == [0, 1]
    assert experiment.goal.tolist() == [3, 9, 4, 14]
    assert experiment.scene.tolist() == [0, 0, 1, 1]
    assert experiment.trained.tolist() == [True, False, False, False]


def test_sums_are_those_of_the_episodes(experiment: Experiment) -> None:
    sums = experiment.sums("vusfa", "sampled")
    for row, cell in enumerate(experiment.runs["vusfa"]):
        rows = list(cell.episodes["sampled"].rows())
        for column, goal in enumerate([("hall", 3), ("hall", 9), ("attic", 4), ("attic", 14)]):
            mine = [walk for walk in rows if (walk["scene"], walk["goal"]) == goal]
            expected = {
                "success_500": (sum(walk["success"] for walk in mine), 6),
                "success_100": (sum(walk["success"] and walk["length"] <= 100 for walk in mine), 6),
                "spl": (
                    sum(walk["success"] * walk["shortest"] / max(walk["length"], 1) for walk in mine),
                    6,
                ),
                "length_ratio": (
                    sum(walk["success"] * walk["length"] for walk in mine),
                    sum(walk["success"] * walk["shortest"] for walk in mine),
                ),
                "collisions": (sum(walk["collisions"] for walk in mine), 6),
            }
            for name, (over, under) in expected.items():
                found = sums[name]
                assert found.numerator[row, column].item() == pytest.approx(over)
                assert found.denominator[row, column].item() == under
    assert torch.equal(experiment.sums("vusfa", "sampled", [1])["spl"].numerator, sums["spl"].numerator[1:])


def test_what_is_not_there_is_left_out(experiment: Experiment) -> None:
    assert experiment.sums("vusfa", "greedy") == {}
    assert experiment.sums("gvf (paper)", "exact") == {}
    table = replace(experiment.runs["vusfa"][0].episodes["sampled"], remaining=None)
    assert "soft_spl" not in set(episode_rows(table, "vusfa").metric)


def test_floor_and_ceiling(experiment: Experiment, rooms: SceneSet) -> None:
    floor = experiment.sums("random walk", "greedy", [4, 7])
    exact = random_walk(rooms.scenes[1], torch.tensor([4, 14]), 100)
    torch.testing.assert_close(floor["success_100"].numerator[:, 2:], exact.expand(2, 2))
    torch.testing.assert_close(
        experiment.sums("vusfa", "exact")["spl"].numerator[:1], floor["spl"].numerator[:1]
    )
    ceiling, guide = experiment.sums("shortest path", "sampled"), experiment.sums("gvf (paper)", "sampled")
    for name in ("success_500", "spl", "soft_spl"):
        assert torch.equal(ceiling[name].numerator, guide[name].numerator)
        assert (ceiling[name].numerator == 6).all()


def test_other_episodes_are_refused(results: Path, rooms: SceneSet, walked: Callable[..., Episodes]) -> None:
    table = walked()
    odd = replace(table, start=table.start.flip(0))
    write_run(results, Run("a", "odd", {"model": "usfa", "seed": 0}, {"sampled": odd}))
    with pytest.raises(ResultError, match=r"a/odd: the episodes of sampled are not those of gvf-0"):
        read_experiment(results, ["a"], rooms)
    with pytest.raises(ResultError, match="no results of b or c"):
        read_experiment(results, ["b", "c"], rooms)


def test_other_scenes_are_refused(results: Path, rooms: SceneSet) -> None:
    cell = read_run(results, "a", "gvf-0")
    told = {**cell.info, "scenes_fingerprint": "abc", "scenes": ["bathroom"]}
    write_run(results, replace(cell, info=told))
    for scenes in (rooms, None):
        with pytest.raises(ResultError, match=r"a/gvf-0: of other scenes \(fingerprint abc"):
            read_experiment(results, ["a"], scenes)


def test_distance_from_the_nearest_trained_goal(make_scene: Callable[..., Scene]) -> None:
    rooms = SceneSet([make_scene("hall"), make_scene("attic")])
    scene, goal = torch.arange(2).repeat_interleave(16), torch.arange(16).repeat(2)
    trained = (scene == 0) & ((goal == 2) | (goal == 13))
    away = distance_to_trained(rooms, scene, goal, trained)
    distance = rooms.scenes[0].distance
    expected = [min(int(distance[2, state]), int(distance[13, state])) for state in range(16)]
    assert away.tolist() == expected + [-1] * 16


def test_an_island_is_far_from_everything(island: SceneSet) -> None:
    goal = torch.arange(5)
    away = distance_to_trained(island, goal * 0, goal, goal == 3)
    assert away.tolist() == [-1, -1, -1, 0, -1]  # the trap is never left
