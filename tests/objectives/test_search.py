"""The loss of known shortest paths, against its equation by hand."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor
from torch.distributions import Categorical, Normal

from vusfa.objectives import SearchLoss, best_action_log_prob

LOGITS = torch.tensor([[0.2, 0.5, 0.3], [0.6, 0.3, 0.1], [0.1, 0.1, 0.8]]).log().requires_grad_()
VALUES = torch.tensor([[0.5], [0.9], [0.0]])


def loss_of(distribution: type = Categorical, **arguments: object) -> SearchLoss:
    names = ["logits"] if distribution is Categorical else ["loc", "scale"]
    outputs = (
        (lambda i: LOGITS[i]) if distribution is Categorical else (lambda i: (LOGITS[i], LOGITS[i].exp()))
    )
    sampler = ProbabilisticTensorDictModule(names, ["action"], distribution_class=distribution)
    actor = ProbabilisticTensorDictSequential(TensorDictModule(outputs, ["row"], names), sampler)
    critic = TensorDictModule(lambda i: VALUES[i], ["row"], ["state_value"])
    return SearchLoss(actor, critic, functional=False, **arguments)  # type: ignore[arg-type]


def pairs() -> TensorDict:
    marks = [[True, False, True], [True, False, False], [False, False, False]]
    steps = torch.tensor([1, 3, 0])
    return TensorDict(
        {"row": torch.arange(3), "best_action": torch.tensor(marks), "steps_to_goal": steps}, [3]
    )


def test_by_hand() -> None:
    losses = loss_of(gamma=0.9, goal_reward=1.0, step_reward=-0.1, critic_coeff=2.0, objective_coeff=3.0)(
        pairs()
    )
    returns = [1.0, -0.1 - 0.1 * 0.9 + 0.9**2]  # one step, and two before the one that arrives
    error = ((0.5 - returns[0]) ** 2 + (0.9 - returns[1]) ** 2) / 2
    assert losses["loss_search_critic"].item() == pytest.approx(2 * error)
    assert losses["loss_search_objective"].item() == pytest.approx(-3 * (math.log(0.5) + math.log(0.6)) / 2)
    assert losses["search_accuracy"].item() == 0.5  # of the first row action 1 is the most probable


def test_the_gradient_does_not_choose_among_best_actions() -> None:
    """It is pi(a) minus the share of a among the best actions: two of these keep their ratio."""
    (gradient,) = torch.autograd.grad(loss_of()(pairs())["loss_search_objective"], LOGITS)
    expected = torch.tensor([[0.2 - 0.4, 0.5, 0.3 - 0.6], [0.6 - 1, 0.3, 0.1], [0.0, 0.0, 0.0]]) / 2
    torch.testing.assert_close(gradient, expected)


def test_best_action_log_prob() -> None:
    logits = torch.randn(5, 4, generator=torch.Generator().manual_seed(1))
    marks = torch.rand(5, 4, generator=torch.Generator().manual_seed(2)) < 0.5
    expected = (logits.softmax(-1) * marks).sum(-1).log()
    torch.testing.assert_close(best_action_log_prob(logits, marks), expected)
    assert best_action_log_prob(logits[:1], torch.zeros(1, 4, dtype=torch.bool)).item() == -math.inf


def test_a_policy_without_logits_is_refused() -> None:
    with pytest.raises(TypeError, match="distribution is Normal, which has no logits"):
        loss_of(Normal)(pairs())


@pytest.mark.parametrize("gamma", [0.0, 1.0, -0.5])
def test_gamma_is_checked(gamma: float) -> None:
    with pytest.raises(ValueError, match=f"gamma is {gamma}; give a number between 0 and 1"):
        loss_of(gamma=gamma)


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("best_action", torch.ones(3, 2, dtype=torch.bool)),
        ("best_action", torch.ones(3, dtype=torch.bool)),
        ("steps_to_goal", torch.ones(3, 1, dtype=torch.int64)),
    ],
)
def test_shapes_are_not_broadcast(name: str, wrong: Tensor) -> None:
    with pytest.raises(ValueError, match="shapes differ"):
        loss_of()(pairs().set(name, wrong))
