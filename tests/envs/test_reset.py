"""``reset`` with the state of an episode in its tensordict, under the rules of TorchRL 0.14 and 0.15."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.envs import (
    Compose,
    EnvBase,
    ExcludeTransform,
    RenameTransform,
    RewardSum,
    SelectTransform,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs, step_mdp

from vusfa.envs import SceneObservation, TargetNavEnv
from vusfa.errors import ConfigError, GoalError
from vusfa.scenes import SceneSet

#: How ``set_state`` reaches the environment: unspecified as 0.14 and as 0.15 take it, and as it is given.
RULES: dict[str, dict[str, bool]] = {"0.14": {}, "0.15": {"set_state": False}, "given": {"set_state": True}}


def reset(env: EnvBase, data: TensorDictBase, rule: str) -> TensorDictBase:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # "The state is honored for now"
        return env.reset(data, **RULES[rule])


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
@pytest.mark.parametrize("wrapped", [False, True])
def test_a_mask_begins_new_episodes_and_leaves_the_others(
    scenes: SceneSet, rule: str, batch: tuple[int, ...], wrapped: bool
) -> None:
    env: EnvBase = TargetNavEnv(scenes, "all", batch, max_steps=3, seed=0)
    if wrapped:
        env = TransformedEnv(env, RewardSum())
    torch.manual_seed(0)
    data, ends = env.reset(), 0
    for _ in range(20):
        before = step_mdp(env.rand_step(data))
        done = before["done"]
        ends += int(done.sum())
        data = reset(env, before.clone().set("_reset", done.clone()), rule) if done.any() else before
        assert not data["done"].any()
        assert not data["elapsed_steps"][done].any()
        assert (data["state_id"][..., -1] != data["goal_id"]).all()
        kept = ~done.squeeze(-1)
        for key in ("state_id", "goal_id", "scene_id", "elapsed_steps"):
            assert torch.equal(data[key][kept], before[key][kept])
    assert ends > 3


def test_rows_outside_the_mask_are_not_judged(scenes: SceneSet) -> None:
    env = TargetNavEnv(scenes, [3], [2], seed=0)
    data = env.reset()
    data["state_id"][1] = 3  # at its goal
    data["_reset"] = torch.tensor([[True], [False]])
    after = env.reset(data.clone(), set_state=True)
    assert torch.equal(after["state_id"][1], data["state_id"][1])


@pytest.mark.parametrize("rule", ["0.14", "given"])
def test_without_a_mask_episodes_that_are_over_begin_anew(scenes: SceneSet, rule: str) -> None:
    env = TransformedEnv(TargetNavEnv(scenes, "all", [3], max_steps=9, seed=0), RewardSum())
    data = env.reset()
    data["state_id"], data["goal_id"] = torch.tensor([[3] * 4, [5] * 4, [6] * 4]), torch.tensor([3, 2, 2])
    data["elapsed_steps"] = torch.tensor([[4], [9], [5]])  # at its goal; time is up; on its way
    after = reset(env, data.clone(), rule)
    assert after["elapsed_steps"].flatten().tolist() == [0, 0, 5]
    assert after["state_id"][2].tolist() == [6] * 4
    assert (after["state_id"][..., -1] != after["goal_id"]).all()


def test_a_state_without_goal_and_a_goal_at_its_state(scenes: SceneSet) -> None:
    env = TargetNavEnv(scenes, [3], [1])
    with pytest.raises(ConfigError, match="no 'goal_id'; give both"):
        env.reset(env.reset().select("state_id"), set_state=True)
    with pytest.raises(GoalError, match="goal 3 is state 3"):
        env.set_state(3, 3)


def walk(env: EnvBase) -> Any:
    torch.manual_seed(0)
    env.set_seed(0)
    return env.rollout(40, break_when_any_done=False)


@pytest.mark.parametrize(
    "transforms",
    [
        lambda scenes: [SceneObservation(scenes), SelectTransform("observation", "goal_observation")],
        lambda scenes: [SelectTransform("scene_id")],
        lambda scenes: [RewardSum(), SelectTransform("episode_reward"), StepCounter(max_steps=30)],
    ],
)
def test_select_transform_does_not_freeze_the_agent(
    scenes: SceneSet, transforms: Callable[[SceneSet], list[Any]]
) -> None:
    env = TransformedEnv(TargetNavEnv(scenes, "all", [4], max_steps=7), Compose(*transforms(scenes)))
    plain = walk(TargetNavEnv(scenes, "all", [4], max_steps=7))
    assert torch.equal(walk(env)["state_id"], plain["state_id"])
    assert plain["next", "done"].sum() > 10
    check_env_specs(env)


def test_select_transform_around_several_environments(scenes: SceneSet) -> None:
    inner = SerialEnv(2, lambda: TargetNavEnv(scenes, "all", [3], max_steps=4))
    data = walk(TransformedEnv(inner, SelectTransform("scene_id")))
    moved = scenes.successor[data["state_id"][..., -1], data["action"]]
    assert torch.equal(data["next", "state_id"][..., -1], moved)
    assert torch.equal(data["elapsed_steps"][:, :, 1:2], data["next", "elapsed_steps"][:, :, :1])


def test_renamed_state_is_read_back(scenes: SceneSet) -> None:
    plain = walk(TargetNavEnv(scenes, "all", [4], max_steps=7))
    rename = RenameTransform(["state_id"], ["place"], ["state_id"], ["place"])
    env = TransformedEnv(TargetNavEnv(scenes, "all", [4], max_steps=7), rename)
    check_env_specs(env)
    assert torch.equal(walk(env)["place"], plain["state_id"])


@pytest.mark.parametrize("key", ["state_id", "goal_id", "elapsed_steps"])
def test_excluded_state_is_an_error_at_the_first_step(scenes: SceneSet, key: str) -> None:
    env = TransformedEnv(TargetNavEnv(scenes, "all", [4]), ExcludeTransform(key))
    with pytest.raises(ConfigError, match=f"given no '{key}'"):
        env.rollout(3)


def test_what_no_agent_could_see_is_left_out_by_default(scenes: SceneSet) -> None:
    assert "shortest_path" not in TargetNavEnv(scenes).observation_spec.keys()
    assert "shortest_path" not in TargetNavEnv(scenes).rollout(2).keys(True)
    env = TargetNavEnv(scenes, "all", [30], seed=0, shortest_path=True)
    data = env.reset()
    assert torch.equal(data["shortest_path"][:, 0], scenes.distance(data["state_id"][:, -1], data["goal_id"]))
