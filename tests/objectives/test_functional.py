"""The pure functions, against numbers computed by hand, plain loops and TorchRL's own returns."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torchrl.objectives.value.functional import generalized_advantage_estimate, td_lambda_return_estimate

from vusfa.objectives import (
    dual_ascent,
    explained_variance,
    gaussian_kl,
    information_bottleneck,
    lambda_return,
    policy_gradient_loss,
    successor_loss,
    successor_return,
)


def flags(*values: int) -> Tensor:
    return torch.tensor(values, dtype=torch.bool).unsqueeze(-1)


def column(*values: float) -> Tensor:
    return torch.tensor(values).unsqueeze(-1)


def transcribed_lambda_return(
    cumulant: list[float],
    next_value: list[float],
    gamma: float,
    lmbda: float,
    done: list[int],
    term: list[int],
) -> list[float]:
    """By the definition: each return on its own, as the weighted sum of the n-step returns of its episode."""
    steps = len(cumulant)
    returns = []
    for t in range(steps):
        end = next((k for k in range(t, steps) if done[k]), steps - 1)
        n_step, discounted = [], 0.0
        for k in range(t, end + 1):
            discounted += gamma ** (k - t) * cumulant[k]
            n_step.append(discounted + gamma ** (k - t + 1) * (0.0 if term[k] else next_value[k]))
        weights = [(1 - lmbda) * lmbda**i for i in range(len(n_step) - 1)] + [lmbda ** (len(n_step) - 1)]
        returns.append(sum(w * g for w, g in zip(weights, n_step, strict=True)))
    return returns


class TestLambdaReturn:
    reward = column(1.0, 2.0, 3.0)
    next_value = column(10.0, 20.0, 30.0)

    def test_n_step_to_the_end_of_the_rollout(self) -> None:
        no = flags(0, 0, 0)
        # 3 + 0.5 * 30 = 18; 2 + 0.5 * 18 = 11; 1 + 0.5 * 11 = 6.5
        result = lambda_return(self.reward, self.next_value, 0.5, 1.0, no, no)
        torch.testing.assert_close(result, column(6.5, 11.0, 18.0))

    def test_one_step(self) -> None:
        no = flags(0, 0, 0)
        result = lambda_return(self.reward, self.next_value, 0.5, 0.0, no, no)
        torch.testing.assert_close(result, column(6.0, 12.0, 18.0))

    def test_in_between(self) -> None:
        no = flags(0, 0, 0)
        # 18; 2 + 0.5 * (0.25 * 20 + 0.75 * 18) = 11.25; 1 + 0.5 * (0.25 * 10 + 0.75 * 11.25) = 6.46875
        result = lambda_return(self.reward, self.next_value, 0.5, 0.75, no, no)
        torch.testing.assert_close(result, column(6.46875, 11.25, 18.0))

    def test_nothing_follows_a_terminal(self) -> None:
        done = flags(0, 1, 0)
        # 18; 2; 1 + 0.5 * 2
        result = lambda_return(self.reward, self.next_value, 0.5, 1.0, done, done)
        torch.testing.assert_close(result, column(2.0, 2.0, 18.0))

    def test_the_value_goes_on_beyond_a_time_out(self) -> None:
        # 18; 2 + 0.5 * 20 = 12; 1 + 0.5 * 12
        result = lambda_return(self.reward, self.next_value, 0.5, 1.0, flags(0, 1, 0), flags(0, 0, 0))
        torch.testing.assert_close(result, column(7.0, 12.0, 18.0))

    def test_an_infinite_value_beyond_a_terminal_does_not_count(self) -> None:
        done = flags(1, 0, 1)
        result = lambda_return(self.reward, column(math.inf, 20.0, math.nan), 0.5, 0.5, done, done)
        torch.testing.assert_close(result, column(1.0, 2 + 0.5 * (0.5 * 20 + 0.5 * 3), 3.0))

    def test_estimates_in_between_have_no_part_in_the_whole_return(self) -> None:
        no = flags(0, 0, 0)
        result = lambda_return(self.reward, column(math.nan, math.inf, 30.0), 0.5, 1.0, no, no)
        torch.testing.assert_close(result, column(6.5, 11.0, 18.0))

    def test_lambda_as_a_tensor(self) -> None:
        no = flags(0, 0, 0)
        result = lambda_return(self.reward, self.next_value, torch.tensor(0.5), torch.tensor(0.75), no, no)
        torch.testing.assert_close(result, column(6.46875, 11.25, 18.0))

    def test_another_time_dimension(self) -> None:
        x = torch.randn(4, 6, 3, dtype=torch.double)
        done = torch.rand(4, 6, 1) < 0.3
        expected = lambda_return(x, 2 * x, 0.9, 0.7, done, done)
        moved = lambda_return(
            x.transpose(0, 1),
            2 * x.transpose(0, 1),
            0.9,
            0.7,
            done.transpose(0, 1),
            done.transpose(0, 1),
            time_dim=0,
        )
        torch.testing.assert_close(moved.transpose(0, 1), expected)

    @given(data=st.data(), steps=st.integers(1, 7), gamma=st.floats(0, 1), lmbda=st.floats(0, 1))
    @settings(max_examples=60)
    def test_equals_the_definition(self, data: st.DataObject, steps: int, gamma: float, lmbda: float) -> None:
        numbers = st.lists(st.floats(-5, 5), min_size=steps, max_size=steps)
        cumulant, next_value = data.draw(numbers), data.draw(numbers)
        done = data.draw(st.lists(st.integers(0, 1), min_size=steps, max_size=steps))
        term = [d and data.draw(st.integers(0, 1)) for d in done]
        expected = transcribed_lambda_return(cumulant, next_value, gamma, lmbda, done, term)
        as_double = [torch.tensor(x, dtype=torch.double).unsqueeze(-1) for x in (cumulant, next_value)]
        result = lambda_return(*as_double, gamma, lmbda, flags(*done), flags(*term))
        torch.testing.assert_close(result.squeeze(-1), torch.tensor(expected, dtype=torch.double))

    @pytest.mark.parametrize("lmbda", [0.0, 0.6, 1.0])
    def test_agrees_with_torchrl(self, lmbda: float) -> None:
        shape = (3, 9, 1)
        reward, value, next_value = torch.randn(3, *shape, dtype=torch.double)
        done = torch.rand(shape) < 0.3
        terminated = done & (torch.rand(shape) < 0.5)
        mine = lambda_return(reward, next_value, 0.97, lmbda, done, terminated)
        theirs = td_lambda_return_estimate(0.97, lmbda, next_value, reward, done, terminated)
        torch.testing.assert_close(mine, theirs, rtol=0, atol=1e-12)
        # the generalised advantage is return minus value only where the next value is the next step's value
        next_value[:, :-1] = torch.where(done[:, :-1], next_value[:, :-1], value[:, 1:])
        mine = lambda_return(reward, next_value, 0.97, lmbda, done, terminated)
        gae, target = generalized_advantage_estimate(0.97, lmbda, value, next_value, reward, done, terminated)
        torch.testing.assert_close(mine - value, gae, rtol=0, atol=1e-6)
        torch.testing.assert_close(mine, target, rtol=0, atol=1e-6)

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"next_value": torch.ones(2, 1)}, "of one shape"),
            ({"done": torch.zeros(3, dtype=torch.bool)}, "1 feature"),
            ({"terminated": torch.zeros(3, 2, dtype=torch.bool)}, "1 feature"),
            ({"done": torch.zeros(3, 1)}, "must be bool"),
            ({"time_dim": 2}, "time_dim=2"),
        ],
    )
    def test_shapes_that_do_not_fit(self, change: dict, message: str) -> None:
        inputs = {"cumulant": self.reward, "next_value": self.next_value, "gamma": 0.9, "lmbda": 1.0}
        inputs |= {"done": flags(0, 0, 0), "terminated": flags(0, 0, 0)} | change
        with pytest.raises(ValueError, match=message):
            lambda_return(**inputs)

    def test_no_step_at_all(self) -> None:
        empty, no = torch.ones(0, 1), torch.zeros(0, 1, dtype=torch.bool)
        with pytest.raises(ValueError, match="at least one step"):
            lambda_return(empty, empty, 0.9, 1.0, no, no)


class TestSuccessorReturn:
    phi = torch.tensor([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    psi = torch.tensor([[4.0, 8.0], [2.0, 6.0], [8.0, 4.0]])

    def test_by_hand(self) -> None:
        # [1, 1] + 0.5 * [8, 4] = [5, 3]; [0, 1] + 0.5 * [5, 3]; [1, 0] + 0.5 * [2.5, 2.5]
        result = successor_return(self.phi, self.psi, 0.5, flags(0, 0, 0), flags(0, 0, 0))
        torch.testing.assert_close(result, torch.tensor([[2.25, 1.25], [2.5, 2.5], [5.0, 3.0]]))

    def test_a_terminal_counts_its_own_embedding_and_nothing_more(self) -> None:
        done = flags(0, 1, 0)
        result = successor_return(self.phi, self.psi, 0.5, done, done)
        torch.testing.assert_close(result, torch.tensor([[1.0, 0.5], [0.0, 1.0], [5.0, 3.0]]))

    def test_a_time_out_bootstraps(self) -> None:
        result = successor_return(self.phi, self.psi, 0.5, flags(0, 1, 0), flags(0, 0, 0))
        torch.testing.assert_close(result, torch.tensor([[1.5, 2.0], [1.0, 4.0], [5.0, 3.0]]))

    def test_lambda(self) -> None:
        # [5, 3]; then [0, 1] + 0.25 * ([2, 6] + [5, 3]); then [1, 0] + 0.25 * ([4, 8] + [1.75, 3.25]), as psi
        # of the last step's state is [8, 4] whatever lambda is
        result = successor_return(self.phi, self.psi, 0.5, flags(0, 0, 0), flags(0, 0, 0), lmbda=0.5)
        torch.testing.assert_close(result, torch.tensor([[2.4375, 2.8125], [1.75, 3.25], [5.0, 3.0]]))

    def test_value_is_its_product_with_the_reward_weights(self) -> None:
        """What successor features are for: with r = phi . w, the value is psi . w."""
        phi, psi = torch.randn(2, 7, 5, 3, dtype=torch.double)
        w = torch.randn(3, 1, dtype=torch.double)
        done = torch.rand(7, 5, 1) < 0.3
        term = done & (torch.rand(7, 5, 1) < 0.5)
        by_features = successor_return(phi, psi, 0.9, done, term, 0.8) @ w
        torch.testing.assert_close(by_features, lambda_return(phi @ w, psi @ w, 0.9, 0.8, done, term))


class TestTerms:
    def test_successor_loss(self) -> None:
        psi = torch.tensor([[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]], requires_grad=True)
        target = torch.tensor([[1.0, 5.0, 0.0], [1.0, 1.0, 2.0]], requires_grad=True)
        loss = successor_loss(psi, target)
        torch.testing.assert_close(loss, torch.tensor([6.0, 2.0]))
        loss.sum().backward()
        assert target.grad is None
        torch.testing.assert_close(psi.grad[1], torch.tensor([-2.0, -2.0, -4.0]) / 3)

    def test_successor_loss_has_the_gradients_of_a_squared_error(self) -> None:
        successor = torch.randn(3, 5, dtype=torch.float64, requires_grad=True)
        target = torch.randn(3, 5, dtype=torch.float64)
        assert torch.autograd.gradcheck(lambda x: successor_loss(x, target), successor)
        assert torch.autograd.gradgradcheck(lambda x: successor_loss(x, target), successor)
        (ours,) = torch.autograd.grad(successor_loss(successor, target).sum(), successor)
        torch.testing.assert_close(ours, 2 * (successor - target).detach() / 5)
        each = torch.func.vmap(torch.func.grad(lambda x, y: successor_loss(x, y)))(successor, target)
        torch.testing.assert_close(each, ours)

    def test_policy_gradient_loss(self) -> None:
        log_prob = torch.tensor([-1.0, -2.0], requires_grad=True)
        advantage = torch.tensor([3.0, -0.5], requires_grad=True)
        loss = policy_gradient_loss(log_prob, advantage)
        torch.testing.assert_close(loss, torch.tensor([3.0, -1.0]))
        loss.sum().backward()
        assert advantage.grad is None
        torch.testing.assert_close(log_prob.grad, torch.tensor([-3.0, 0.5]))

    def test_gaussian_kl_by_hand(self) -> None:
        loc, scale = torch.tensor([0.0, 1.0, 0.0, 0.0]), torch.tensor([1.0, 1.0, 2.0, -2.0])
        two = 0.5 * (4 - math.log(4) - 1)
        torch.testing.assert_close(gaussian_kl(loc, scale), torch.tensor([0.0, 0.5, two, two]))

    def test_gaussian_kl_is_that_of_torch(self) -> None:
        loc, scale = torch.randn(50), torch.rand(50) + 0.05
        normal = torch.distributions.Normal
        expected = torch.distributions.kl_divergence(normal(loc, scale), normal(0.0, 1.0))
        torch.testing.assert_close(gaussian_kl(loc, scale), expected, rtol=1e-4, atol=1e-5)

    def test_gaussian_kl_at_scale_zero_is_finite(self) -> None:
        scale = torch.zeros(1, requires_grad=True)
        kl = gaussian_kl(torch.zeros(1), scale)
        kl.backward()
        torch.testing.assert_close(kl.detach(), torch.tensor([0.5 * (-math.log(1e-8) - 1)]))
        assert scale.grad.isfinite().all()

    def test_gaussian_kl_of_half_precision_is_summed_in_full(self) -> None:
        loc, scale = torch.tensor([0.0, 0.0625]).half(), torch.tensor([0.0, 1.0]).half()
        expected = gaussian_kl(loc.float(), scale.float())
        result = gaussian_kl(loc, scale)
        assert result.dtype == torch.float32
        torch.testing.assert_close(result, expected, rtol=0, atol=0)

    def test_information_bottleneck(self) -> None:
        kl = torch.tensor([0.1, 0.7], requires_grad=True)
        loss = information_bottleneck(kl, 3.0, 0.2)
        torch.testing.assert_close(loss, torch.tensor([-0.3, 1.5]))
        loss.sum().backward()
        torch.testing.assert_close(kl.grad, torch.tensor([3.0, 3.0]))

    @pytest.mark.parametrize(
        ("beta", "violation", "expected"), [(0.0, 2.0, 0.2), (0.3, -1.0, 0.2), (0.3, -10.0, 0.0)]
    )
    def test_dual_ascent(self, beta: float, violation: float, expected: float) -> None:
        result = dual_ascent(torch.tensor(beta), torch.tensor(violation), 0.1)
        torch.testing.assert_close(result, torch.tensor(expected))

    def test_explained_variance(self) -> None:
        target = torch.tensor([1.0, 2.0, 3.0, 4.0])
        # the error is 0, 0, 0, 1: variance 3/16 against 5/4
        prediction = torch.tensor([1.0, 2.0, 3.0, 3.0])
        torch.testing.assert_close(
            explained_variance(target, prediction), torch.tensor(1 - (3 / 16) / (5 / 4))
        )
        torch.testing.assert_close(explained_variance(target, -target), torch.tensor(-3.0))
        torch.testing.assert_close(explained_variance(torch.ones(4), target), torch.tensor(0.0))

    def test_explained_variance_of_what_the_mask_shows(self) -> None:
        target = torch.tensor([1.0, 2.0, math.nan])
        prediction = torch.tensor([3.0, 4.0, math.inf])
        mask = torch.tensor([True, True, False])
        torch.testing.assert_close(explained_variance(target, prediction, mask), torch.tensor(1.0))

    @pytest.mark.parametrize(
        "function", [successor_loss, policy_gradient_loss, gaussian_kl, explained_variance]
    )
    def test_shapes_must_be_equal(self, function: object) -> None:
        with pytest.raises(ValueError, match=rf"{function.__name__}: shapes differ.*\(2, 3\).*\(3,\)"):
            function(torch.ones(2, 3), torch.ones(3))
