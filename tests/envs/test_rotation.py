"""The schedule of active scenes, and episodes that begin in them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import pytest
import torch

from vusfa.envs import SceneRotation, TargetNavEnv
from vusfa.envs.rotation import Rotation
from vusfa.errors import ConfigError
from vusfa.scenes import Scene, SceneSet


@pytest.fixture
def six(make_scene: Callable[..., Scene]) -> SceneSet:
    """Six rooms of 16 states; the goals of room i are its states 0 to i."""
    return SceneSet(make_scene(f"room {index}") for index in range(6))


GOALS = torch.tensor([16 * scene + goal for scene in range(6) for goal in range(scene + 1)])


def test_every_scene_has_its_turn_and_stays_as_long(six: SceneSet) -> None:
    rotation = Rotation(SceneRotation(active=2, stay=1000, seed=3), six, GOALS)
    seen = [rotation.scenes_at(rotation.turn(frames)) for frames in range(0, 30_000, 100)]
    for slot in range(2):  # in a slot a scene stays for 1000 frames, the slots in turn
        changes = [i for i in range(1, len(seen)) if seen[i][slot] != seen[i - 1][slot]]
        assert all(i % 10 == (5 if slot == 0 else 0) for i in changes)
    entered = [rotation.scenes_at(0)[0], *(rotation.scenes_at(turn)[(turn + 1) % 2] for turn in range(59))]
    stays = Counter(entered)
    assert set(stays.values()) == {10}
    assert seen == [rotation.scenes_at(rotation.turn(frames)) for frames in range(0, 30_000, 100)]
    other = Rotation(SceneRotation(active=2, stay=1000, seed=4), six, GOALS)
    assert [other.scenes_at(turn) for turn in range(6)] != [rotation.scenes_at(turn) for turn in range(6)]


def test_weights_are_numbers_of_stays(six: SceneSet) -> None:
    weights = {"room 0": 0, "room 1": 2, "room 2": 0.5}
    rotation = Rotation(SceneRotation(1, stay=10, weights=weights), six, GOALS)
    stays = Counter(rotation.scenes_at(turn)[0] for turn in range(550))
    assert sorted(stays) == [1, 2, 3, 4, 5]
    assert [round(stays[scene] / 100, 1) for scene in (1, 2, 3, 4, 5)] == [2.0, 0.5, 1.0, 1.0, 1.0]


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"active": 0}, "env.active_scenes is 0"),
        ({"active": 7}, "env.active_scenes is 7 of 6 scenes; give fewer, or null for all of them"),
        ({"active": 3, "stay": 2}, "at least as many frames as scenes"),
        ({"active": 1, "weights": {"attic": 1.0}}, "there is no scene 'attic'"),
        ({"active": 1, "weights": {"room 1": -1.0}}, "'room 1' has -1.0"),
        ({"active": 1, "weights": {f"room {i}": 0.0 for i in range(6)}}, "leaves no scene"),
        ({"active": 1, "weights": {"room 1": float("nan")}}, "'room 1' has nan"),
    ],
)
def test_what_makes_no_schedule_is_refused(six: SceneSet, given: dict, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        Rotation(SceneRotation(**given), six, GOALS)


@pytest.mark.parametrize("sampling", ["fixed", "episode"])
def test_episodes_begin_in_active_scenes_and_end_where_they_began(six: SceneSet, sampling: str) -> None:
    settings = SceneRotation(active=2, stay=400, seed=1)
    env = TargetNavEnv(
        six, GOALS, [12], seed=0, goal_sampling=sampling, max_steps=9, shortest_path=True, rotation=settings
    )
    torch.manual_seed(0)
    data = env.rollout(300, break_when_any_done=False)
    rotation = Rotation(settings, six, GOALS)
    assert torch.equal(six.scene_id[data["state_id"][..., -1]], data["scene_id"])
    assert torch.equal(six.scene_id[data["goal_id"]], data["scene_id"])
    begins = (data["elapsed_steps"] == 0).squeeze(-1)
    for row, step in begins.nonzero().tolist():
        turn = rotation.turn(12 * step)
        assert int(data["scene_id"][row, step]) in rotation.scenes_at(turn)
        assert int(data["goal_id"][row, step]) in rotation.goals_at(turn)[0].tolist()
        if sampling == "fixed":  # slot by slot, and a slot's goals in turn
            assert int(data["scene_id"][row, step]) == rotation.scenes_at(turn)[row % 2]
    paths = six.distance(data["state_id"][..., -1], data["goal_id"])[begins]
    assert torch.equal(data["shortest_path"].squeeze(-1)[begins], paths)
    assert len(data["scene_id"].unique()) == 6
    assert torch.isin(data["goal_id"].unique(), GOALS).all()


def test_fixed_goals_all_have_a_row(six: SceneSet) -> None:
    rotation = Rotation(SceneRotation(active=2, stay=100), six, GOALS)
    assert rotation.rows_needed == 12
    for turn in range(12):
        goals, counts = rotation.goals_at(turn)
        assert rotation.rows_at(turn, torch.arange(rotation.rows_needed)).unique().numel() == len(goals)
        assert counts.sum() == len(goals)


def test_where_all_are_active_nothing_changes(six: SceneSet) -> None:
    plain, rotated = (
        TargetNavEnv(six, GOALS, [12], seed=0, goal_sampling="episode", rotation=rotation)
        for rotation in (None, SceneRotation(active=6, stay=100))
    )
    assert torch.equal(plain.reset()["state_id"], rotated.reset()["state_id"])
    assert rotated.coming_goals(1000) is rotated.goals


def test_workers_and_resumed_runs_know_the_frame(six: SceneSet) -> None:
    settings = SceneRotation(active=1, stay=100, seed=2)
    rotation = Rotation(settings, six, GOALS)
    env = TargetNavEnv(six, GOALS, [6], seed=0, rotation=settings, first_frame=250, frames_per_step=24)
    assert env.reset()["scene_id"].unique().tolist() == rotation.scenes_at(2)
    data = env.rollout(5, break_when_any_done=False)
    assert len(data["scene_id"].unique()) >= 1
    assert env.reset()["scene_id"].unique().tolist() == rotation.scenes_at(rotation.turn(250 + 5 * 24))
