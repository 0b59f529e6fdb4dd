"""Meters against a plain loop over the batch."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict

from vusfa.envs import TargetNavEnv
from vusfa.scenes import Scene, SceneSet
from vusfa.training import EpisodeMeter, MeanMeter


@pytest.fixture
def rooms(make_scene: Callable[..., Scene]) -> SceneSet:
    return SceneSet([make_scene("hall"), make_scene("attic")])


def in_python(rooms: SceneSet, batches: list[TensorDict]) -> dict[str, float]:
    ended: dict[str, list[tuple[bool, int, int]]] = {}
    collisions = frames = 0
    for batch in batches:
        for row in batch["next"].reshape(-1):
            frames += 1
            collisions += int(row["collided"])
            if not row["done"]:
                continue
            scene = rooms.names[int(row["scene_id"])]
            one = (bool(row["terminated"]), int(row["elapsed_steps"]), int(row["shortest_path"]))
            for key in ("", f"scene/{scene}/", f"goal/{scene}/{int(rooms.local_id(row['goal_id']))}/"):
                ended.setdefault(key, []).append(one)
    result: dict[str, float] = {"collisions": collisions / frames, "episodes": len(ended[""])}
    for key, episodes in ended.items():
        won = [(length, best) for success, length, best in episodes if success]
        result[f"{key}success"] = len(won) / len(episodes)
        result[f"{key}length"] = sum(length for _, length, _ in episodes) / len(episodes)
        if won:
            result[f"{key}length_ratio"] = sum(a for a, _ in won) / sum(b for _, b in won)
    return result


def test_against_a_plain_loop(rooms: SceneSet):
    env = TargetNavEnv(
        rooms, goals=[3, 20, 9, 17], batch_size=[2, 4], max_steps=9, seed=0, shortest_path=True
    )
    torch.manual_seed(0)
    batches = [env.rollout(25, break_when_any_done=False) for _ in range(3)]
    meter = EpisodeMeter(rooms, env.goals)
    for batch in batches:
        meter.update(batch)
    found, expected = meter.flush(), in_python(rooms, batches)
    assert expected["episodes"] > 50
    assert 0.0 < expected["success"] < 1.0
    for key, value in expected.items():
        if not (key.startswith("goal/") and key.endswith("/length")):
            assert found[key] == pytest.approx(value), key
    assert {key.rpartition("/")[0] for key in found} == {
        "",
        "scene/hall",
        "scene/attic",
        *(f"goal/{g}" for g in ("hall/3", "hall/9", "attic/1", "attic/4")),
    }


def test_a_flush_starts_over_with_the_same_keys(rooms: SceneSet):
    env = TargetNavEnv(rooms, goals=[3], batch_size=[4], max_steps=3, seed=0, shortest_path=True)
    meter = EpisodeMeter(rooms, env.goals)
    meter.update(env.rollout(6, break_when_any_done=False))
    first, second = meter.flush(), meter.flush()
    assert list(first) == list(second)
    assert first["episodes"] > 0 == second["episodes"]
    assert all(math.isnan(value) for key, value in second.items() if key != "episodes")


def test_meters_go_on_from_their_state(rooms: SceneSet):
    env = TargetNavEnv(rooms, goals=[3, 20], batch_size=[4], max_steps=5, seed=0, shortest_path=True)
    one, two = (env.rollout(9, break_when_any_done=False) for _ in range(2))
    whole, first, second = (EpisodeMeter(rooms, env.goals) for _ in range(3))
    for batch in (one, two):
        whole.update(batch)
    first.update(one)
    second.load_state_dict(first.state_dict())
    second.update(two)
    assert second.flush() == whole.flush()
    means, again = MeanMeter(), MeanMeter()
    means.update({"a": torch.tensor(1.0), "b": torch.tensor(4)})
    again.load_state_dict(means.state_dict())
    again.update({"b": torch.tensor(2), "a": torch.tensor(2.0)})
    assert again.flush() == {"a": 1.5, "b": 3.0}


def test_of_many_scenes_and_goals_the_log_has_quantiles(rooms: SceneSet, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("vusfa.training.metrics.MAX_SCENES", 1)
    monkeypatch.setattr("vusfa.training.metrics.MAX_GOALS", 2)
    meter = EpisodeMeter(rooms, torch.tensor([3, 5, 20]))
    assert math.isnan(meter.flush()["goals/success_p50"])
    sums = torch.zeros(5, 3, dtype=torch.float64)
    sums[:2] = torch.tensor([[4.0, 0.0, 10.0], [1.0, 0.0, 5.0]])  # episodes and successes
    meter.load_state_dict({"sums": sums, "frames": torch.tensor(1), "collisions": torch.tensor(0)})
    line = meter.flush()
    assert (line["scenes/seen"], line["goals/seen"]) == (2, 2)
    assert line["goals/success_p50"] == pytest.approx(0.375)
    assert line["scenes/success_p90"] == pytest.approx(0.475)
    assert line["success"] == pytest.approx(6 / 14)
    assert not any(key.startswith(("goal/", "scene/")) for key in line)
