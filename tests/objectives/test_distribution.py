"""Log-probabilities and entropies are one number a step, whatever the distribution."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import CompositeDistribution, set_composite_lp_aggregate
from torch.distributions import Categorical, Independent, Normal
from torchrl.modules import TanhNormal

from vusfa.objectives.distribution import action_entropy, action_log_prob

GAUSSIAN_ENTROPY = 0.5 * math.log(2 * math.pi * math.e)


def composite() -> CompositeDistribution:
    """Two steps: a coin that is fair, then not; and a move of two features."""
    probabilities = torch.tensor([[0.5, 0.5], [0.25, 0.75]])
    loc, scale = torch.zeros(2, 2), torch.ones(2, 2)
    return CompositeDistribution(
        TensorDict({"coin": {"probs": probabilities}, "move": {"loc": loc, "scale": scale}}, [2]),
        distribution_map={"coin": Categorical, "move": Normal},
    )


class TestLogProb:
    def test_discrete(self) -> None:
        dist = Categorical(probs=torch.tensor([[[0.5, 0.5], [0.25, 0.75]]]))
        td = TensorDict({"a": torch.tensor([[0, 1]])}, [1, 2])
        torch.testing.assert_close(action_log_prob(dist, td, "a"), torch.tensor([[0.5, 0.75]]).log())

    @pytest.mark.parametrize("aggregate", [False, True])
    def test_the_parts_of_a_composite_action_are_summed(self, aggregate: bool) -> None:
        td = TensorDict({"coin": torch.tensor([0, 1]), "move": torch.zeros(2, 2)}, [2])
        with set_composite_lp_aggregate(aggregate):
            result = action_log_prob(composite(), td, ["coin", "move"])
        density = -math.log(2 * math.pi)  # twice that of a standard Gaussian at its mean
        torch.testing.assert_close(result, torch.tensor([math.log(0.5) + density, math.log(0.75) + density]))


class TestEntropy:
    def test_in_closed_form(self) -> None:
        coin = Categorical(probs=torch.tensor([[0.5, 0.5], [0.0, 1.0]]))
        torch.testing.assert_close(action_entropy(coin), torch.tensor([math.log(2), 0.0]))
        gaussian = Independent(Normal(torch.zeros(1, 3), torch.ones(1, 3)), 1)
        torch.testing.assert_close(action_entropy(gaussian), torch.tensor([3 * GAUSSIAN_ENTROPY]))

    @pytest.mark.parametrize("aggregate", [False, True])
    def test_the_parts_of_a_composite_action_are_summed(self, aggregate: bool) -> None:
        with set_composite_lp_aggregate(aggregate):
            result = action_entropy(composite())
        uneven = -0.25 * math.log(0.25) - 0.75 * math.log(0.75)
        move = 2 * GAUSSIAN_ENTROPY
        torch.testing.assert_close(result, torch.tensor([math.log(2) + move, uneven + move]))

    def test_estimated_where_there_is_no_closed_form(self) -> None:
        """A narrow squashed Gaussian far from the bounds is nearly a Gaussian of that width."""
        scale = torch.full((20_000, 1), 0.01).requires_grad_()
        entropy = action_entropy(TanhNormal(torch.zeros(20_000, 1), scale))
        assert entropy.shape == (20_000,)
        assert entropy.mean().item() == pytest.approx(GAUSSIAN_ENTROPY + math.log(0.01), abs=0.02)
        entropy.mean().backward()
        # d/dscale of log(scale), for each of the 20,000
        assert scale.grad.sum().item() == pytest.approx(100, rel=0.05)
