"""The hindsight loss, against sums done by hand and its equation written in plain Python."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictSequential,
)
from torch import Tensor, nn
from torch.distributions import Categorical

from vusfa.modules import make_agent
from vusfa.objectives import HindsightLoss, expectile_loss, relabelled_target, walked_return
from vusfa.scenes import SceneSet


class Tables(nn.Module):
    """V and logits by lookup: [state, goal]."""

    def __init__(self, states: int = 6, actions: int = 3) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(3)
        self.value = nn.Parameter(torch.rand(states, states, generator=generator))
        self.logits = nn.Parameter(torch.randn(states, states, actions, generator=generator))


def networks(tables: Tables) -> tuple[ProbabilisticTensorDictSequential, TensorDictSequential]:
    read = ["state_id", "goal_id"]
    logits = TensorDictModule(lambda s, g: tables.logits[s[..., -1], g], read, ["logits"])
    sampler = ProbabilisticTensorDictModule(["logits"], ["action"], distribution_class=Categorical)
    value = TensorDictModule(lambda s, g: tables.value[s[..., -1], g].unsqueeze(-1), read, ["state_value"])
    return ProbabilisticTensorDictSequential(logits, sampler), TensorDictSequential(value)


def transitions() -> TensorDict:
    state, goal, after = (
        torch.tensor([0, 1, 2, 3, 4]),
        torch.tensor([5, 2, 2, 0, 1]),
        torch.tensor([1, 2, 4, 5, 0]),
    )
    return TensorDict(
        {
            "state_id": torch.stack([torch.zeros_like(state), state], -1),
            "goal_id": goal,
            "action": torch.tensor([0, 2, 1, 1, 0]),
            "steps_to_goal": torch.tensor([3, 1, 0, 0, 2]),
            "next": {"state_id": torch.stack([state, after], -1)},
        },
        [5],
    )


@torch.no_grad()
def in_plain_python(tables: Tables, steps: TensorDict, settings: dict[str, Any]) -> tuple[float, float]:
    gamma, tau, goal_reward, step_reward = (
        settings[name] for name in ("gamma", "expectile", "goal_reward", "step_reward")
    )
    errors, weights, imitated = [], [], []
    for row in range(len(steps)):
        state, after = int(steps["state_id"][row, -1]), int(steps["next", "state_id"][row, -1])
        goal, action, walked = (
            int(steps["goal_id"][row]),
            int(steps["action"][row]),
            int(steps["steps_to_goal"][row]),
        )
        if state == goal:
            continue
        value = float(tables.value[state, goal])
        target = goal_reward
        if after != goal:
            target = step_reward + gamma * min(float(tables.value[after, goal]), goal_reward)
        better = target
        if walked:
            earned = goal_reward
            for _ in range(walked - 1):
                earned = step_reward + gamma * earned
            better = max(target, earned)
        errors.append(2 * (tau if better > value else 1 - tau) * (better - value) ** 2)
        weights.append(min(math.exp((target - value) / settings["temperature"]), settings["max_weight"]))
        logits = [float(x) for x in tables.logits[state, goal]]
        imitated.append(logits[action] - math.log(sum(math.exp(x) for x in logits)))
    critic = settings["critic_coeff"] * sum(errors) / len(errors)
    policy = sum(w * log for w, log in zip(weights, imitated, strict=True)) / sum(weights)
    return critic, -settings["objective_coeff"] * policy


@pytest.mark.parametrize("temperature", [0.02, 0.5])
@pytest.mark.parametrize("expectile", [0.5, 0.7])
def test_terms_are_those_of_the_equation(temperature: float, expectile: float):
    settings = {
        "critic_coeff": 3.0,
        "objective_coeff": 0.5,
        "gamma": 0.9,
        "expectile": expectile,
        "temperature": temperature,
        "max_weight": 4.0,
        "goal_reward": 0.8,
        "step_reward": -0.02,
    }
    tables, steps = Tables(), transitions()
    terms = HindsightLoss(*networks(tables), **settings)(steps)
    critic, policy = in_plain_python(tables, steps, settings)
    assert terms["loss_hindsight_critic"].item() == pytest.approx(critic, rel=1e-5)
    assert terms["loss_hindsight_objective"].item() == pytest.approx(policy, rel=1e-5)


def test_targets_and_weights_are_constants():
    tables, steps = Tables(), transitions()
    loss = HindsightLoss(*networks(tables))
    loss(steps)["loss_hindsight_objective"].backward()
    assert tables.value.grad is None
    loss(steps)["loss_hindsight_critic"].backward()
    assert tables.value.grad is not None
    touched = {tuple(pair) for pair in tables.value.grad.nonzero().tolist()}
    assert touched == {(0, 5), (1, 2), (3, 0), (4, 1)}  # V(s, g) alone; not V(s', g), not where s is g


def test_walked_return_is_what_the_environment_would_have_paid():
    steps = torch.arange(0, 7)
    result = walked_return(steps, gamma=0.7, goal_reward=2.0, step_reward=-0.5)
    assert result[0] == -torch.inf
    for count, value in zip(steps[1:].tolist(), result[1:].tolist(), strict=True):
        rewards = [-0.5] * (count - 1) + [2.0]
        assert value == pytest.approx(sum(r * 0.7**t for t, r in enumerate(rewards)), rel=1e-5)


def test_the_target_is_bounded_by_arriving():
    values = torch.tensor([-3.0, 0.4, 50.0])
    torch.testing.assert_close(
        relabelled_target(values, torch.zeros(3, dtype=torch.bool), gamma=0.5),
        torch.tensor([-1.51, 0.19, 0.49]),
    )


def test_an_expectile_of_one_half_is_the_square():
    value, target = torch.randn(9), torch.randn(9)
    torch.testing.assert_close(expectile_loss(value, target, 0.5), (target - value).square())


def test_the_trunk_runs_twice_for_three_results(monkeypatch: pytest.MonkeyPatch):
    scenes = SceneSet.bundled(["bathroom"])
    agent = make_agent("vusfa", scenes=scenes, history=1, hidden_size=8, embedding_size=8)
    calls: list[int] = []
    monkeypatch.setattr(
        agent.scene_layer.linear, "forward", _counting(calls, agent.scene_layer.linear.forward)
    )
    steps = transitions().set("scene_id", torch.zeros(5, dtype=torch.int64))
    loss = HindsightLoss(agent.get_policy_operator(), agent.get_value_operator())
    terms = loss(steps)
    sum(value for key, value in terms.items() if key.startswith("loss")).backward()
    assert len(calls) == 2
    assert agent.encoder.branch.first.weight.grad.abs().sum() > 0


def _counting(calls: list[int], function: Any) -> Any:
    def counted(*args: Tensor) -> Tensor:
        calls.append(1)
        return function(*args)

    return counted


@pytest.mark.parametrize("setting", ["gamma", "expectile", "temperature", "max_weight"])
def test_numbers_that_make_no_sense_are_refused(setting: str):
    with pytest.raises(ValueError, match=f"HindsightLoss: {setting} is 0"):
        HindsightLoss(*networks(Tables()), **{setting: 0})
