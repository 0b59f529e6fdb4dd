"""TensorFlow's RMSProp and the multiplier."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from torch import nn

from vusfa.objectives import DualAscent, TFRMSprop, USFLoss, optim


@pytest.fixture(params=["_update_one_by_one", "_update_foreach"])
def path(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a CPU takes by itself, and what a GPU takes."""
    monkeypatch.setattr(optim, "_update_one_by_one", getattr(optim, request.param))


PATHS = pytest.mark.usefixtures("path")


def parameters(*shapes: tuple[int, ...]) -> list[nn.Parameter]:
    return [nn.Parameter(torch.randn(shape)) for shape in shapes]


class TestTFRMSprop:
    @PATHS
    def test_by_hand(self) -> None:
        weight = nn.Parameter(torch.tensor([2.0, -1.0]))
        optimiser = TFRMSprop(
            [weight],
            lr=0.5,
            alpha=0.75,
            eps=0.25,
            initial_accumulator=1.0,
            max_grad_norm=5.0,
        )
        weight.grad = torch.tensor([3.0, 4.0])  # norm 5: not clipped
        optimiser.step()
        # m = 0.75 + 0.25 * (9, 16) = (3, 4.75)
        expected = torch.tensor([2 - 0.5 * 3 / 3.25**0.5, -1 - 0.5 * 4 / 5**0.5])
        torch.testing.assert_close(weight.data, expected)
        weight.grad = torch.tensor([6.0, 8.0])  # norm 10: halved
        optimiser.step()
        # m = 0.75 * (3, 4.75) + 0.25 * (9, 16) = (4.5, 7.5625)
        expected = expected - 0.5 * torch.tensor([3 / 4.75**0.5, 4 / 7.8125**0.5])
        torch.testing.assert_close(weight.data, expected)
        torch.testing.assert_close(weight.grad, torch.tensor([6.0, 8.0]))

    @PATHS
    @pytest.mark.parametrize("max_grad_norm", [None, 2.0])
    def test_many_steps_against_a_transcription(self, max_grad_norm: float | None) -> None:
        shapes = [(4, 3), (5,), (), (2, 2, 2)]
        mine = parameters(*shapes)
        optimiser = TFRMSprop(mine, lr=0.1, max_grad_norm=max_grad_norm)
        theirs = [p.detach().double().numpy().copy() for p in mine]
        accumulators = [np.ones_like(p) for p in theirs]
        for step in range(5):
            for i, param in enumerate(mine):
                param.grad = torch.randn_like(param) * 10 ** (step - 2)
                grad = param.grad.double().numpy()
                norm = np.sqrt((grad**2).sum())
                if max_grad_norm is not None and norm > max_grad_norm:
                    grad = grad * max_grad_norm / norm
                accumulators[i] = 0.99 * accumulators[i] + 0.01 * grad**2
                theirs[i] = theirs[i] - 0.1 * grad / np.sqrt(accumulators[i] + 0.1)
            optimiser.step()
            for param, expected in zip(mine, theirs, strict=True):
                np.testing.assert_allclose(param.detach().numpy(), expected, atol=1e-5)

    @PATHS
    def test_zero_and_missing_gradients(self) -> None:
        still, absent = parameters((3,), (3,))
        before = [still.detach().clone(), absent.detach().clone()]
        optimiser = TFRMSprop([still, absent])
        still.grad = torch.zeros(3)
        optimiser.step()
        torch.testing.assert_close(still.data, before[0], rtol=0, atol=0)
        torch.testing.assert_close(absent.data, before[1], rtol=0, atol=0)
        torch.testing.assert_close(optimiser.state[still]["square_avg"], torch.full((3,), 0.99))
        assert absent not in optimiser.state

    @PATHS
    def test_resumes_from_its_state_dict(self) -> None:
        def run(steps: int, model: nn.Module, optimiser: TFRMSprop, start: int = 0) -> None:
            for step in range(start, steps):
                generator = torch.Generator().manual_seed(step)
                x = torch.randn(8, 3, generator=generator)
                optimiser.zero_grad()
                model(x).square().sum().backward()
                optimiser.step()

        model = nn.Linear(3, 2)
        twin = copy.deepcopy(model)
        optimiser = TFRMSprop(model.parameters(), lr=0.01)
        run(6, model, optimiser)
        first = TFRMSprop(twin.parameters(), lr=0.01)
        run(3, twin, first)
        second = TFRMSprop(twin.parameters(), lr=0.5)
        second.load_state_dict(copy.deepcopy(first.state_dict()))
        run(6, twin, second, start=3)
        for a, b in zip(model.parameters(), twin.parameters(), strict=True):
            torch.testing.assert_close(a, b, rtol=0, atol=0)

    def test_groups_schedules_and_closures(self) -> None:
        a, b = parameters((2,), (2,))
        optimiser = TFRMSprop([{"params": [a], "lr": 0.0}, {"params": [b]}], lr=1.0, eps=1.0, alpha=1.0)
        schedule = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, 0.0, total_iters=2)
        before = a.detach().clone(), b.detach().clone()

        def closure() -> torch.Tensor:
            optimiser.zero_grad()
            loss = a.sum() + 2 * b.sum()
            loss.backward()
            return loss

        assert optimiser.step(closure).item() == pytest.approx((before[0].sum() + 2 * before[1].sum()).item())
        schedule.step()
        optimiser.step(closure)
        schedule.step()
        optimiser.step(closure)
        torch.testing.assert_close(a.data, before[0])
        # gradient 2, root of 1 + 1: full, half and no rate
        torch.testing.assert_close(b.data, before[1] - 1.5 * 2 / 2**0.5)

    @pytest.mark.parametrize(
        "wrong",
        [{"lr": -1.0}, {"alpha": 1.5}, {"eps": -1e-3}, {"initial_accumulator": -1.0}, {"max_grad_norm": 0.0}],
    )
    def test_hyperparameters_out_of_range(self, wrong: dict[str, float]) -> None:
        with pytest.raises(ValueError, match=f"{next(iter(wrong))} is"):
            TFRMSprop(parameters((2,)), **wrong)

    def test_sparse_gradients_are_refused(self) -> None:
        table = nn.Embedding(4, 2, sparse=True)
        table(torch.tensor([1])).sum().backward()
        with pytest.raises(RuntimeError, match="sparse"):
            TFRMSprop(table.parameters()).step()


class TestDualAscent:
    def test_a_step_before_any_forward_changes_nothing(self, usf) -> None:
        networks = usf()
        loss = USFLoss(networks.actor, networks.critic, bottleneck_coeff=0.3)
        DualAscent(loss, step_size=10.0).step()
        assert loss.bottleneck_coeff.item() == pytest.approx(0.3)

    def test_follows_the_constraint(self, usf, rollout) -> None:
        networks = usf()
        loss = USFLoss(networks.actor, networks.critic, information_target=0.2)
        multiplier = DualAscent(loss, step_size=0.1)
        beta = 0.0
        for seed in range(3):
            out = loss(rollout(4, 5, seed=seed))
            assert out["beta"].item() == pytest.approx(beta)
            multiplier.step()
            beta = max(0.0, beta + 0.1 * (out["kl"].item() - 0.2))
            assert loss.bottleneck_coeff.item() == pytest.approx(beta)
        assert beta > 0

    def test_never_negative(self, usf, rollout) -> None:
        networks = usf()
        loss = USFLoss(networks.actor, networks.critic, bottleneck_coeff=0.1, information_target=1000.0)
        loss(rollout(4, 5))
        DualAscent(loss, step_size=1.0).step()
        assert loss.bottleneck_coeff.item() == 0.0

    def test_may_step_between_forward_and_backward(self, usf, rollout) -> None:
        networks = usf()
        loss = USFLoss(networks.actor, networks.critic, bottleneck_coeff=0.5)
        out = loss(rollout(4, 5))
        DualAscent(loss, step_size=1.0).step()
        out["loss_bottleneck"].backward()
        with_step = networks.parts["goal"].module.weight.grad.clone()
        networks.actor.zero_grad()
        networks.critic.zero_grad()
        loss.bottleneck_coeff = 0.5
        loss(rollout(4, 5))["loss_bottleneck"].backward()
        torch.testing.assert_close(networks.parts["goal"].module.weight.grad, with_step)

    def test_its_state_is_in_the_loss(self, usf, rollout) -> None:
        """Saved after a forward pass and before the step, the next step is the same."""
        networks, other = usf(), usf()
        loss = USFLoss(networks.actor, networks.critic)
        twin = USFLoss(other.actor, other.critic)
        multiplier, twins = DualAscent(loss, 0.1), DualAscent(twin, 0.1)
        loss(rollout(4, 5))
        multiplier.step()
        loss(rollout(4, 5, seed=1))
        twin.load_state_dict(loss.state_dict())
        multiplier.step()
        twins.step()
        assert twin.bottleneck_coeff.item() == loss.bottleneck_coeff.item() > 0

    def test_needs_a_bottleneck(self, usf, plain) -> None:
        for networks, coefficient in ((usf(), None), (usf(variational=False), 0.0), (plain(), "auto")):
            loss = USFLoss(networks.actor, networks.critic, bottleneck_coeff=coefficient)
            with pytest.raises(ValueError, match="no bottleneck term; give USFLoss a bottleneck_coeff"):
                DualAscent(loss)

    def test_one_step_of_several_threads_is_that_many_steps(self, usf, rollout) -> None:
        networks = usf()
        loss = USFLoss(networks.actor, networks.critic, bottleneck_coeff=0.1, information_target=0.0)
        loss(rollout(3, 4))
        for _ in range(3):
            DualAscent(loss, step_size=0.5).step()
        after = loss.bottleneck_coeff.item()
        loss.bottleneck_coeff = 0.1
        DualAscent(loss, step_size=0.5, threads=3).step()
        assert loss.bottleneck_coeff.item() == pytest.approx(after) != 0.1

    def test_step_size_out_of_range(self, usf) -> None:
        networks = usf()
        with pytest.raises(ValueError, match=r"step_size is -1\.0"):
            DualAscent(USFLoss(networks.actor, networks.critic), step_size=-1.0)
