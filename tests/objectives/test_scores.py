"""Losses of critics of all goals, and of a policy of their scores, against their equations by hand."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictModule
from torch.distributions import Categorical, Normal

from vusfa.objectives import ScoreLoss
from vusfa.objectives.goal_critics import (
    implicit_q_loss,
    implied_reward,
    info_nce_loss,
    measure_loss,
    orthonormality_loss,
)

LOGITS = torch.tensor([[0.2, 0.5, 0.3], [0.6, 0.3, 0.1]]).log().requires_grad_()
VALUES = torch.tensor([[0.5], [0.9]])


def loss_of(distribution: type = Categorical, **arguments: object) -> ScoreLoss:
    names = ["logits"] if distribution is Categorical else ["loc", "scale"]
    outputs = (
        (lambda i: LOGITS[i]) if distribution is Categorical else (lambda i: (LOGITS[i], LOGITS[i].exp()))
    )
    sampler = ProbabilisticTensorDictModule(names, ["action"], distribution_class=distribution)
    actor = ProbabilisticTensorDictSequential(TensorDictModule(outputs, ["row"], names), sampler)
    critic = TensorDictModule(lambda i: VALUES[i], ["row"], ["state_value"])
    return ScoreLoss(actor, critic, functional=False, **arguments)  # type: ignore[arg-type]


def pairs() -> TensorDict:
    scores = torch.tensor([[1.0, 2.0, 0.0], [0.0, 0.0, 4.0]])
    return TensorDict({"row": torch.arange(2), "action_scores": scores}, [2])


def test_a_policy_of_scores_by_hand() -> None:
    losses = loss_of(temperature=2.0, critic_coeff=3.0, objective_coeff=5.0)(pairs())
    crossed = 0.0
    for scores, probs in (([1.0, 2.0, 0.0], [0.2, 0.5, 0.3]), ([0.0, 0.0, 4.0], [0.6, 0.3, 0.1])):
        weights = [math.exp(score / 2) for score in scores]
        crossed -= sum(w / sum(weights) * math.log(p) for w, p in zip(weights, probs, strict=True)) / 2
    assert losses["loss_score_objective"].item() == pytest.approx(5 * crossed)
    assert losses["loss_score_critic"].item() == pytest.approx(3 * (1.5**2 + 3.1**2) / 2)
    assert losses["score_agreement"].item() == 0.5  # the first row's most probable action is the best


def test_the_least_loss_is_the_softmax() -> None:
    (gradient,) = torch.autograd.grad(loss_of(temperature=0.5)(pairs())["loss_score_objective"], LOGITS)
    expected = (LOGITS.softmax(-1) - (pairs()["action_scores"] / 0.5).softmax(-1)) / 2
    torch.testing.assert_close(gradient, expected)


def test_rows_behind_a_mask_do_not_count() -> None:
    masked, loss = pairs().set("kept", torch.tensor([True, False])), loss_of()
    loss.loss_mask_key = "kept"
    for term, value in loss_of()(pairs()[:1]).items():
        torch.testing.assert_close(loss(masked)[term], value)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: loss_of(temperature=0.0), "temperature is 0.0; give a number above 0"),
        (lambda: loss_of()(pairs().set("action_scores", torch.zeros(2, 4))), "action_scores"),
    ],
)
def test_what_makes_no_sense_is_refused(make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_a_policy_without_logits_is_refused() -> None:
    with pytest.raises(
        TypeError, match="ScoreLoss: the policy's distribution is Normal, which has no logits"
    ):
        loss_of(Normal)(pairs())


def test_contrastive_loss_is_that_of_every_pair_against_the_sample() -> None:
    """Five positive pairs, two of them the same, row by row as the papers write it."""
    scores = torch.randn(3, 2, generator=torch.Generator().manual_seed(0))
    sample, penalty = [(0, 0), (0, 0), (1, 1), (2, 1), (0, 1)], 0.1
    count, f = torch.zeros(3, 2), scores.tolist()
    for row, goal in sample:
        count[row, goal] += 1
    expected = 0.0
    for row, goal in sample:
        of_row = math.log(sum(math.exp(f[row][other]) for _, other in sample))
        of_goal = math.log(sum(math.exp(f[other][goal]) for other, _ in sample))
        expected += of_row - f[row][goal] + of_goal - f[row][goal] + penalty * of_row**2
    assert info_nce_loss(scores, count, penalty).item() == pytest.approx(expected / 5, rel=1e-5)


def test_contrastive_loss_is_least_at_the_density_ratio() -> None:
    """f = log p(g | x) / p(g), where goals and rows are known by counts."""
    count = torch.tensor([[6.0, 1.0, 1.0], [1.0, 4.0, 3.0]])
    joint = count / count.sum()
    best = (joint / (joint.sum(0) * joint.sum(1, keepdim=True))).log().requires_grad_()
    (gradient,) = torch.autograd.grad(info_nce_loss(best, count), best)
    torch.testing.assert_close(gradient, torch.zeros(2, 3), atol=1e-6, rtol=0)


def test_implicit_q_loss_by_hand() -> None:
    action_value, value = torch.tensor([[0.5, 0.2]]), torch.tensor([[0.4, 0.9]])
    target, slow = torch.tensor([[1.0, 0.0]]), torch.tensor([[0.8, 0.1]])
    loss = implicit_q_loss(action_value, value, target, slow, 0.9, torch.tensor([[3.0, 1.0]]))
    first = 0.5**2 + 2 * 0.9 * 0.4**2  # V is too low
    second = 0.2**2 + 2 * 0.1 * 0.8**2  # V is too high
    assert loss.item() == pytest.approx((3 * first + second) / 4)


def test_measure_loss_is_the_bellman_error_of_every_pair() -> None:
    """Three transitions between two states, pair by pair as the paper writes it."""
    generator = torch.Generator().manual_seed(0)
    measure, slow = torch.rand(3, 2, generator=generator), torch.rand(3, 2, generator=generator)
    following, gamma = [0, 1, 0], 0.8
    density = torch.tensor([2 / 3, 1 / 3])  # of the states that follow
    expected, m, slow_m = 0.0, measure.tolist(), slow.tolist()
    for i in range(3):
        for other in following:
            expected += (m[i][other] - gamma * slow_m[i][other]) ** 2 / 9
        expected -= 2 * m[i][following[i]] / 3
    assert measure_loss(measure, slow, torch.tensor(following), density, gamma).item() == pytest.approx(
        expected
    )


def test_measure_loss_is_least_at_the_visits_of_a_ring() -> None:
    """Of a ring of three states with one action, whose discounted visits are known."""
    gamma, density = 0.5, torch.full((3,), 1 / 3)
    following = torch.tensor([1, 2, 0])
    step = torch.eye(3)[following]
    visits = step @ torch.linalg.inv(torch.eye(3) - gamma * step)  # from the next state on
    measure = (visits / density).requires_grad_()
    loss = measure_loss(measure, measure.detach()[following], following, density, gamma)
    (gradient,) = torch.autograd.grad(loss, measure)
    torch.testing.assert_close(gradient, torch.zeros(3, 3), atol=1e-5, rtol=0)


def test_orthonormality_loss_is_the_distance_of_the_second_moment() -> None:
    back = torch.randn(4, 2, generator=torch.Generator().manual_seed(0))
    density = torch.tensor([0.1, 0.2, 0.3, 0.4])
    moment = sum(d * torch.outer(b, b) for d, b in zip(density, back, strict=True))
    expected = (moment - torch.eye(2)).square().sum() - 2
    torch.testing.assert_close(orthonormality_loss(back, density), expected)


def test_a_reward_is_implied_by_the_task_that_it_gives() -> None:
    """z = E[r B] of any reward that is linear in B gives that reward back."""
    back = torch.randn(5, 2, generator=torch.Generator().manual_seed(0))
    density, reward = torch.tensor([0.1, 0.2, 0.3, 0.2, 0.2]), back @ torch.tensor([2.0, -1.0])
    task = (density * reward) @ back
    found = implied_reward(back, density, task.expand(5, -1), torch.arange(5))
    torch.testing.assert_close(found, reward, atol=0.02, rtol=0)
