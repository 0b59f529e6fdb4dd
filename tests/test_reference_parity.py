"""The released code's numbers, reproduced: ``pytest tests/test_reference_parity.py --golden DIR``.

DIR holds what the authors' TensorFlow code computed, and how it was fed; its README describes every file.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from vusfa.envs import TargetNavEnv
from vusfa.scenes import Scene, SceneSet


class TestEnvironment:
    """golden_env.json: walks of 40 given actions in a room of 12 states, 4 starts, 1 and 4 frames."""

    @pytest.fixture
    def traces(self, golden: Path) -> dict[str, Any]:
        return json.loads((golden / "golden_env.json").read_text())

    @pytest.fixture
    def scenes(self, golden: Path) -> SceneSet:
        return SceneSet([Scene.load(golden / "tiny_scene.h5")])

    def test_the_scene_file_holds_what_the_traces_describe(
        self, traces: dict[str, Any], scenes: SceneSet
    ) -> None:
        scene = scenes.scenes[0]
        assert scene.graph.tolist() == traces["graph"]
        assert scene.distance.tolist() == traces["shortest_path_distance"]
        assert scene.rotation.tolist() == traces["rotation"]
        torch.testing.assert_close(scene.location, torch.tensor(traces["location"]))
        torch.testing.assert_close(scene.features, torch.tensor(traces["resnet_feature"]), rtol=0, atol=1e-7)

    @pytest.mark.parametrize("rewards", ["environment", "thread"])
    def test_every_walk(self, traces: dict[str, Any], scenes: SceneSet, rewards: str) -> None:
        """All starts walk at once, one row each; rows that end begin again at their own start."""
        goal = traces["terminal_state_id"]
        raw = {"goal_reward": 10.0, "step_reward": -0.01, "collision_reward": -0.1}
        for history in sorted({run["history_length"] for run in traces["runs"]}):
            runs = [run for run in traces["runs"] if run["history_length"] == history]
            env = TargetNavEnv(
                scenes,
                goals=[goal],
                batch_size=[len(runs)],
                history=history,
                max_steps=10_000,
                **(raw if rewards == "environment" else {}),
            )
            starts = torch.tensor([run["start_state"] for run in runs])
            begin = env.set_state(starts, torch.tensor(goal))
            now = begin
            assert len(runs) > 0
            assert {len(run["steps"]) for run in runs} == {len(traces["actions"])}
            for expected in zip(*(run["steps"] for run in runs), strict=True):
                again = torch.tensor([step["reset_to_start_before"] for step in expected])
                now = torch.where(again, begin, now)
                assert now["state_id"].tolist() == [step["history_before"] for step in expected]
                assert now["state_id"][:, -1].tolist() == [step["state_before"] for step in expected]
                action = torch.tensor([step["action"] for step in expected])
                after = env.step(now.clone().set("action", action))["next"]
                assert after["state_id"].tolist() == [step["history_after"] for step in expected]
                assert after["state_id"][:, -1].tolist() == [step["state_after"] for step in expected]
                assert after["collided"][:, 0].tolist() == [step["collided"] for step in expected]
                assert after["terminated"][:, 0].tolist() == [step["terminal"] for step in expected]
                wanted = torch.tensor(
                    [step[f"reward_{'env' if rewards == 'environment' else 'thread'}"] for step in expected]
                )
                torch.testing.assert_close(after["reward"][:, 0], wanted.float(), rtol=0, atol=1e-7)
                now = after.exclude("reward")

    def test_the_goal_fills_the_whole_target(self, traces: dict[str, Any]) -> None:
        """The goal's frame is repeated over the history, which is why one ``goal_id`` says it all."""
        for run in traces["runs"]:
            assert run["target_history"] == [traces["terminal_state_id"]] * run["history_length"]

    def test_resets_begin_where_the_released_code_begins(
        self, traces: dict[str, Any], scenes: SceneSet
    ) -> None:
        env = TargetNavEnv(
            scenes, goals=[traces["terminal_state_id"]], batch_size=[traces["reset"]["samples"]], seed=0
        )
        assert env.reset()["state_id"].unique().tolist() == traces["reset"]["states_seen"]

    def test_states_that_cannot_reach_the_goal_never_begin(
        self, traces: dict[str, Any], scenes: SceneSet
    ) -> None:
        """The released code reads the distance table, ours the graph: here the states' own moves are cut."""
        blocked, goal = traces["reset"]["blocked_rows"], traces["terminal_state_id"]
        graph = scenes.scenes[0].graph.clone()
        graph[blocked] = -1
        cut = Scene("cut", graph, scenes.scenes[0].features)
        env = TargetNavEnv(SceneSet([cut]), goals=[goal], batch_size=[traces["reset"]["samples"]], seed=0)
        seen = env.reset()["state_id"].unique().tolist()
        assert seen == (cut.distance[:, goal] > 0).nonzero()[:, 0].tolist()
        assert set(seen) <= set(traces["reset"]["states_seen_when_rows_blocked"])
