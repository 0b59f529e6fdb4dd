"""The task in Gymnasium."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import vusfa.envs
from vusfa.errors import ConfigError
from vusfa.scenes import Scene, SceneSet

ENV_ID = "vusfa/TargetNav-v0"


@pytest.fixture
def scenes(make_scene: Callable[..., Scene]) -> SceneSet:
    return SceneSet([make_scene("hall"), make_scene("attic", 3, 1)])  # 16 and 12 states


@pytest.fixture
def seen(scene_file: Path) -> SceneSet:
    return SceneSet([Scene.load(scene_file)])


@pytest.mark.parametrize("observation", ["index", "features", "pixels"])
@pytest.mark.parametrize("render_mode", [None, "rgb_array"])
def test_gymnasiums_own_check(seen: SceneSet, observation: str, render_mode: str | None) -> None:
    env = gymnasium.make(ENV_ID, scenes=seen, goals="all", observation=observation, render_mode=render_mode)
    check_env(env.unwrapped)


def test_bundled_rooms_by_default() -> None:
    env = gymnasium.make(ENV_ID)
    observation, info = env.reset(seed=0)
    assert observation["state_id"].shape == (4,)
    assert set(info) == {"collided", "shortest_path"}
    assert env.action_space == gymnasium.spaces.Discrete(4)


def test_it_can_be_made_by_naming_the_module() -> None:
    """Where nothing of ours was imported before."""
    code = (
        "import gymnasium as g; print(g.make('vusfa.envs:vusfa/TargetNav-v0', scenes='bathroom').reset()[1])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "shortest_path" in done.stdout


def test_an_episode_by_hand(scenes: SceneSet) -> None:
    env = gymnasium.make(ENV_ID, scenes=scenes, goals=[3], history=2, max_steps=3)
    observation, info = env.reset(seed=0, options={"state": 0, "goal": 2})
    assert {key: value.tolist() for key, value in observation.items()} == {
        "state_id": [0, 0],
        "goal_id": 2,
        "scene_id": 0,
    }
    assert info == {"collided": False, "shortest_path": 2}
    observation, reward, terminated, truncated, info = env.step(3)  # backwards into the wall
    assert observation["state_id"].tolist() == [0, 0]
    assert (reward, terminated, truncated) == (pytest.approx(-0.01), False, False)
    assert info == {"collided": True, "shortest_path": 2}
    env.step(1)
    observation, reward, terminated, truncated, info = env.step(1)
    assert observation["state_id"].tolist() == [1, 2]
    assert (reward, terminated, truncated) == (1.0, True, True)
    assert type(reward) is float
    assert type(terminated) is bool


def test_features_and_pixels_are_those_of_the_ids(seen: SceneSet) -> None:
    def episode(observation: str) -> list[dict[str, Any]]:
        env = gymnasium.make(ENV_ID, scenes=seen, goals="all", observation=observation)
        return [env.reset(seed=5)[0], *(env.step(action)[0] for action in (1, 0, 2))]

    pictures = seen.pictures(np.arange(16)).movedim(-1, -3).numpy()
    for ids, features, pixels in zip(*map(episode, ("index", "features", "pixels")), strict=True):
        assert np.array_equal(features["observation"], seen.features[ids["state_id"], 0].numpy())
        assert np.array_equal(features["goal_observation"], seen.features[ids["goal_id"], 0].numpy())
        assert np.array_equal(pixels["observation"], pictures[ids["state_id"]])
        assert np.array_equal(pixels["goal_observation"], pictures[ids["goal_id"]])
        assert ids["scene_id"] == features["scene_id"] == pixels["scene_id"]


def assert_same(ours: Any, theirs: Any) -> None:
    if isinstance(ours, dict):
        assert set(ours) == set(theirs)
        for key in ours:
            assert_same(ours[key], theirs[key])
    else:
        assert ours.dtype == theirs.dtype
        assert np.array_equal(ours, theirs)


@pytest.mark.parametrize("observation", ["index", "features"])
@pytest.mark.parametrize("goal_sampling", ["episode", "fixed"])
def test_the_vector_version_agrees_with_single_ones_step_by_step(
    scenes: SceneSet, observation: str, goal_sampling: str
) -> None:
    """Against Gymnasium's own row of single ones: observations, rewards, ends, infos, automatic resets."""
    options: dict[str, Any] = {
        "scenes": scenes,
        "goals": "all" if goal_sampling == "episode" else [18],
        "observation": observation,
        "goal_sampling": goal_sampling,
        "max_steps": 6,
        "collision_reward": -0.1,
    }
    ours = gymnasium.make_vec(ENV_ID, num_envs=5, vectorization_mode="vector_entry_point", **options)
    theirs = gymnasium.make_vec(ENV_ID, num_envs=5, vectorization_mode="sync", **options)
    assert ours.metadata["autoreset_mode"] == theirs.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    for space in ("single_observation_space", "observation_space", "single_action_space", "action_space"):
        assert getattr(ours, space) == getattr(theirs, space)
    generator = np.random.default_rng(0)
    ends = 0
    for seed in (11, [3, None, 5, 6, None], None):
        for mine, other in zip(ours.reset(seed=seed), theirs.reset(seed=seed), strict=True):
            assert_same(mine, other)
        for _ in range(25):
            actions = generator.integers(4, size=5)
            mine, other = ours.step(actions), theirs.step(actions)
            for a, b in zip(mine, other, strict=True):
                assert_same(a, b)
            assert mine[0] in ours.observation_space
            ends += int((mine[2] | mine[3]).sum())
    assert ends > 20
    mask = np.array([True, False, True, False, False])
    again = [env.reset(seed=9, options={"reset_mask": mask.copy()}) for env in (ours, theirs)]
    assert_same(again[0][0], again[1][0])
    ours.close()
    theirs.close()


def test_rows_of_the_vector_version_begin_where_one_wants(scenes: SceneSet) -> None:
    envs = gymnasium.make_vec(
        ENV_ID, num_envs=3, vectorization_mode="vector_entry_point", scenes=scenes, goals="all"
    )
    observation, info = envs.reset(options={"state": np.array([0, 1, 16]), "goal": np.array([2, 2, 17])})
    assert observation["state_id"][:, -1].tolist() == [0, 1, 16]
    assert info["shortest_path"].tolist() == [2, 1, 1]
    assert envs.reset(options={"state": 0, "goal": 1})[0]["goal_id"].tolist() == [1, 1, 1]


def test_fixed_goals_of_the_vector_version(scenes: SceneSet) -> None:
    envs = gymnasium.make_vec(
        ENV_ID,
        num_envs=3,
        vectorization_mode="vector_entry_point",
        scenes=scenes,
        goals=[3, 20],
        goal_sampling="fixed",
    )
    assert envs.reset(seed=0)[0]["goal_id"].tolist() == [3, 20, 3]


def test_rendering(seen: SceneSet) -> None:
    env = gymnasium.make(ENV_ID, scenes=seen, goals="all", render_mode="rgb_array", panels=["view", "map"])
    env.reset(seed=0)
    assert env.render().shape == (40, 48 + 8 + 40, 3)
    envs = gymnasium.make_vec(
        ENV_ID, 2, "vector_entry_point", scenes=seen, goals="all", render_mode="rgb_array"
    )
    observation, _ = envs.reset(seed=0)
    frames = envs.render()
    assert len(frames) == 2
    assert np.array_equal(frames[1], seen.pictures(observation["state_id"][1, -1]).numpy())


def test_bad_arguments_name_themselves(scenes: SceneSet) -> None:
    with pytest.raises(ConfigError, match="observation is 'sound'"):
        gymnasium.make(ENV_ID, scenes=scenes, goals="all", observation="sound")
    with pytest.raises(ConfigError, match="render_mode is 'human'"):
        vusfa.envs.gym.TargetNavGym(scenes, "all", render_mode="human")
    env = gymnasium.make(ENV_ID, scenes=scenes, goals="all")
    with pytest.raises(ConfigError, match=r"are \['state'\]; give 'state' and 'goal'"):
        env.reset(options={"state": 3})
    envs = gymnasium.make_vec(ENV_ID, 2, "vector_entry_point", scenes=scenes, goals="all")
    with pytest.raises(ConfigError, match="3 seeds for 2 environments"):
        envs.reset(seed=[1, 2, 3])
    with pytest.raises(ConfigError, match="reset_mask is"):
        envs.reset(options={"reset_mask": np.array([False, False])})
