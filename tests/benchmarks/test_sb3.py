"""The wrapper for Stable-Baselines3 shows the episodes of the environment, and says how they end."""

from __future__ import annotations

import numpy as np
import torch

from benchmarks.peers.sb3 import SceneVecEnv, make_sb3, sb3_actions
from vusfa.envs import TargetNavEnv
from vusfa.scenes import SceneSet


def test_episodes_are_the_environments_own():
    scenes = SceneSet.bundled(["bathroom"])
    env = SceneVecEnv(scenes, 8, seed=3, goals=[3, 40], max_steps=12)
    first = env.reset()
    assert first["observation"].shape == (8, 4, 1280)
    table = scenes.features[:, 0]
    shown = ((table - table.mean(0)) / table.std(0, correction=0).clamp(min=1e-3)).numpy()
    lookup = {row.tobytes(): i for i, row in enumerate(shown)}
    rng = np.random.default_rng(0)
    observation, ends = first, {"goal": 0, "time": 0}
    clock = np.zeros(8, dtype=int)
    world = TargetNavEnv(scenes, goals=[3, 40], batch_size=[1])._world
    for _ in range(60):
        actions = rng.integers(4, size=8)
        before = [lookup[frames[-1].tobytes()] for frames in observation["observation"]]
        goals = [lookup[row.tobytes()] for row in observation["goal"]]
        observation, reward, done, infos = env.step(actions)
        clock += 1
        for row in range(8):
            reached = int(world.successor[before[row], actions[row]])
            assert done[row] == (reached == goals[row] or clock[row] == 12)
            assert reward[row] == np.float32(1.0 if reached == goals[row] else -0.01)
            last = infos[row]["terminal_observation"] if done[row] else None
            frame = last["observation"][-1] if last else observation["observation"][row][-1]
            assert lookup[frame.tobytes()] == reached
            if last:
                assert infos[row]["TimeLimit.truncated"] == (reached != goals[row])
                ends["goal" if reached == goals[row] else "time"] += 1
                fresh = observation["observation"][row]
                assert (fresh == fresh[0]).all()  # a history that has just begun
                clock[row] = 0
    assert all(ends.values())
    env.close()


def test_it_learns_and_acts():
    scenes = SceneSet.bundled(["bathroom", "bedroom"])
    before = torch.get_num_threads()
    model = make_sb3("A2C", scenes, num_envs=4, width=8, n_steps=3)
    assert torch.get_num_threads() == before
    model.learn(24)
    assert model.num_timesteps == 24
    ids = {
        "state_id": torch.zeros(5, 4, dtype=torch.int64),
        "goal_id": torch.arange(5),
        "scene_id": torch.zeros(5).long(),
    }
    actions = sb3_actions(model, ids)
    assert actions.shape == (5,)
    assert ((actions >= 0) & (actions < 4)).all()
