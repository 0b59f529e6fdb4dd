"""Shortest paths without a table of all of them."""

from __future__ import annotations

import dataclasses
import pickle
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from vusfa import limits
from vusfa.envs import TargetNavEnv
from vusfa.envs import starts as starts_module
from vusfa.envs.goals import spread_goals
from vusfa.errors import GoalError, SceneError
from vusfa.scenes import Scene, SceneSet, validate
from vusfa.scenes.graph import shortest_path_distances

MANY = 17_000  # more than a table is made of


def corridor(states: int) -> Scene:
    """One way up and one way down; the last state leads nowhere and the first is entered from the second."""
    ids = torch.arange(states)
    graph = torch.stack([torch.where(ids + 1 < states, ids + 1, -1), ids - 1], 1)
    return Scene("corridor", graph, (ids % 7).float().view(-1, 1, 1).expand(-1, 1, 2))


def test_goal_by_goal_is_the_table_transposed() -> None:
    generator = torch.Generator().manual_seed(0)
    graph = torch.randint(-1, 60, (60, 2), generator=generator)
    table = shortest_path_distances(graph)
    for given in (None, table):
        scene = Scene("sixty", graph, torch.rand(60, 1, 2), distance=given)
        goals = torch.tensor([5, 59, 5, 0])
        assert torch.equal(scene.distances_to(goals), table[:, goals].T)
        assert torch.equal(torch.cat(list(scene.all_distances())), table.T)
        state = torch.arange(60)
        assert torch.equal(scene.path_lengths(state, state.flip(0)), table[state, state.flip(0)].long())
        assert scene.longest_path == int(table.max())
        assert torch.equal(pickle.loads(pickle.dumps(scene)).distances_to(3)[0], table[:, 3])
    with pytest.raises(GoalError, match="goal 60 is not a state"):
        scene.distances_to(60)


def test_paths_of_a_large_scene_are_searched_when_wanted(tmp_path: Path) -> None:
    scene = corridor(MANY)
    assert scene.distances_to([MANY - 1])[0, 0] == MANY - 1
    with pytest.raises(SceneError, match=r"of 17000 states is too large .* scene\.distances_to"):
        _ = scene.distance
    scene.save(tmp_path / "corridor.h5")
    with h5py.File(tmp_path / "corridor.h5") as file:
        assert "shortest_path_distance" not in file
    assert validate(tmp_path / "corridor.h5") == []
    small = dataclasses.replace(corridor(50), name="small")
    rooms = SceneSet([Scene.load(tmp_path / "corridor.h5"), small])
    assert rooms.distance([0, MANY, 5], [MANY - 1, 3, MANY]).tolist() == [MANY - 1, -1, -1]
    env = TargetNavEnv(rooms, goals=[9, MANY + 3], batch_size=[4], seed=0, shortest_path=True)
    data = env.reset()
    expected = rooms.distance(data["state_id"][:, -1], data["goal_id"])
    assert torch.equal(data["shortest_path"].squeeze(-1), expected)


def test_a_large_table_in_a_file_is_not_read_but_must_fit(
    make_file: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vusfa.scenes.store.TABLE_STATES", 4)
    monkeypatch.setattr("vusfa.scenes.validation.TABLE_STATES", 4)
    wrong = np.zeros((5, 5), np.int16)  # neither read nor believed
    assert Scene.load(make_file(shortest_path_distance=wrong)).distances_to(2)[0].tolist() == [2, 1, 0, 1, 2]
    assert Scene.load(make_file("b.h5", shortest_path_distance=None)).distances_to(0)[0, 4] == 1
    with pytest.raises(SceneError, match="'shortest_path_distance' has 6 states, but the graph has 5"):
        Scene.load(make_file("c.h5", shortest_path_distance=np.zeros((6, 6), np.int16)))


def test_the_latest_paths_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vusfa.scenes.paths.MAX_PATH_BYTES", 3 * 100 * 2)
    scene = corridor(100)
    searched: list[int] = []
    scene.distances_to(0)
    paths = scene._paths
    assert paths._search is not None
    search = paths._search
    monkeypatch.setattr(paths, "_search", lambda goal: searched.append(goal) or search(goal))
    for goal in (0, 1, 2, 0, 3, 0, 1):
        assert scene.distances_to(goal)[0, 50] == 50 - goal
    assert searched == [1, 2, 3, 1]  # 1 made room for 3, because 0 had been asked for since


def test_more_paths_than_one_table_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    """The environment then asks the scenes; the numbers are the same."""
    rooms = SceneSet.bundled(["bathroom"])
    options = {
        "goals": "all",
        "goal_sampling": "episode",
        "batch_size": [9],
        "seed": 3,
        "shortest_path": True,
    }
    torch.manual_seed(0)
    expected = TargetNavEnv(rooms, **options).rollout(30, break_when_any_done=False)
    monkeypatch.setattr(starts_module, "MAX_PATHS", 10)
    torch.manual_seed(0)
    found = TargetNavEnv(rooms, **options).rollout(30, break_when_any_done=False)
    assert torch.equal(found["shortest_path"], expected["shortest_path"])


def test_goals_are_spread_over_a_large_scene(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vusfa.envs.goals.TABLE_STATES", 50)
    assert spread_goals(corridor(101), 3) == [0, 50, 100]
    assert limits.TABLE_STATES <= limits.MAX_DISTANCE_STATES < limits.MAX_STATES
