"""The bare loop walks in the same world: same states, rewards and ends, same starts."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from benchmarks.peers.bare_env import BareEnv, random_frames
from vusfa.envs import TargetNavEnv, resolve_goals
from vusfa.scenes import SceneSet


@pytest.mark.parametrize("history", [1, 4])
def test_steps_are_those_of_our_environment(history: int):
    scenes = SceneSet.bundled(["bathroom", "bedroom"])
    goals = resolve_goals(scenes, "paper")
    torch.manual_seed(0)
    bare = BareEnv(scenes, goals, 64, history=history, max_steps=40)
    ours = TargetNavEnv(scenes, goals, [64], history=history, max_steps=40, seed=0)
    seen = torch.zeros(2, dtype=torch.int64)
    for _ in range(100):
        action = torch.randint(4, (64,))
        data = TensorDict(
            {
                "state_id": bare.state,
                "goal_id": bare.goal,
                "scene_id": bare.scene,
                "elapsed_steps": bare.clock.unsqueeze(-1),
                "shortest_path": torch.ones(64, 1, dtype=torch.int64),
                "action": action,
            },
            [64],
        )
        expected = ours.step(data)["next"]
        state, scene = bare.state[:, -1], bare.scene
        assert torch.equal(scenes.scene_id[state], scene)
        after = bare.step(action)
        assert torch.equal(after.state, expected["state_id"])
        assert torch.equal(after.reward, expected["reward"].squeeze(-1))
        assert torch.equal(after.terminated, expected["terminated"].squeeze(-1))
        assert torch.equal(after.done, expected["done"].squeeze(-1))
        walking = ~after.done
        assert torch.equal(bare.state[walking], after.state[walking])
        assert not bare.clock[after.done].any()
        assert (scenes.distance(bare.state[after.done, -1], bare.goal[after.done]) > 0).all()
        seen += torch.stack([after.terminated.sum(), (after.done & ~after.terminated).sum()])
    assert (seen > 0).all()  # both kinds of ends occurred


def test_fixed_goals_stay_and_starts_spread():
    scenes = SceneSet.bundled(["bathroom"])
    env = BareEnv(scenes, torch.tensor([3, 40]), 4000, sampling="fixed", max_steps=1)
    env.step(torch.zeros(4000, dtype=torch.int64))
    assert env.goal.tolist() == [3, 40] * 2000
    assert len(env.state[env.goal == 3, -1].unique()) == (scenes.distance(torch.arange(176), 3) > 0).sum()


def test_a_walk_counts_its_frames():
    assert random_frames(BareEnv(SceneSet.bundled(["bathroom"]), torch.tensor([3]), 5), 7)() == 35
