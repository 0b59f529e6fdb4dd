"""A3C's step against the sequence of updates that it stands for, one per thread."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from vusfa.objectives import TFRMSprop
from vusfa.objectives.a3c import A3CRMSprop

THREADS, STEPS = 20, 5


def network() -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(6, 8), nn.Tanh(), nn.Linear(8, 2)).double()


@pytest.fixture
def threads() -> tuple[Tensor, Tensor]:
    """Inputs (K, T, 6) and targets (K, T, 2) of all threads."""
    generator = torch.Generator().manual_seed(1)
    inputs = torch.randn(THREADS, STEPS, 6, generator=generator, dtype=torch.float64)
    targets = inputs[..., :2].sin() + torch.randn(THREADS, STEPS, 2, generator=generator, dtype=torch.float64)
    return inputs, targets


def loss_of(net: nn.Module, inputs: Tensor, targets: Tensor) -> Tensor:
    """One thread's loss, or the mean of several threads': the sum over steps, as in the released code."""
    return 0.001 * (net(inputs) - targets).square().sum((-1, -2)).mean()


def gradients(net: nn.Module, inputs: Tensor, targets: Tensor) -> None:
    net.zero_grad()
    loss_of(net, inputs, targets).backward()


def sequence(
    net: nn.Module, inputs: Tensor, targets: Tensor, *, lr: float, start: float = 1.0, limit: float = 40.0
) -> list[list[float]]:
    """A3C in plain Python: thread after thread, each with its own gradient at the weights as they are.

    Returns the accumulators; the network is updated.
    """
    accumulators = [[start] * param.numel() for param in net.parameters()]
    for thread in range(len(inputs)):
        gradients(net, inputs[thread], targets[thread])
        for param, accumulator in zip(net.parameters(), accumulators, strict=True):
            grad = param.grad.flatten().tolist()  # type: ignore[union-attr]
            norm = math.sqrt(sum(g * g for g in grad))
            grad = [g * limit / max(norm, limit) for g in grad]
            weights = param.detach().flatten().tolist()
            for i, g in enumerate(grad):
                accumulator[i] = 0.99 * accumulator[i] + 0.01 * g * g
                weights[i] -= lr * g / math.sqrt(accumulator[i] + 0.1)
            param.data.copy_(torch.tensor(weights, dtype=param.dtype).view_as(param))
    return accumulators


def flat(net: nn.Module) -> Tensor:
    return torch.cat([param.detach().flatten() for param in net.parameters()])


def moved_by(
    make: Callable[[nn.Module], TFRMSprop], inputs: Tensor, targets: Tensor, per_update: int
) -> Tensor:
    net = network()
    before, optimizer = flat(net), make(net)
    for group in range(0, THREADS, per_update):
        rows = slice(group, group + per_update)
        gradients(net, inputs[rows], targets[rows])
        optimizer.step()
    return flat(net) - before


def error(step: Tensor, exact: Tensor) -> float:
    return ((step - exact).norm() / exact.norm()).item()


def exact_step(inputs: Tensor, targets: Tensor, **numbers: float) -> Tensor:
    net = network()
    before = flat(net)
    sequence(net, inputs, targets, **numbers)
    return flat(net) - before


def test_one_thread_per_update_is_the_sequence(threads: tuple[Tensor, Tensor]) -> None:
    net = network()
    accumulators = sequence(net, *threads, lr=0.1)
    ours = network()
    optimizer = A3CRMSprop(ours.parameters(), lr=0.1, threads=1)
    for inputs, targets in zip(*threads, strict=True):
        gradients(ours, inputs, targets)
        optimizer.step()
    torch.testing.assert_close(flat(ours), flat(net), rtol=1e-12, atol=1e-14)
    for param, accumulator in zip(ours.parameters(), accumulators, strict=True):
        assert optimizer.state[param]["square_avg"].flatten().tolist() == pytest.approx(accumulator)


def test_one_thread_per_update_is_the_released_update_bit_for_bit() -> None:
    generator = torch.Generator().manual_seed(0)
    start = torch.randn(30, 7, generator=generator)
    one, other = nn.Parameter(start.clone()), nn.Parameter(start.clone())
    optimizers = A3CRMSprop([one], threads=1), TFRMSprop([other])
    for scale in (1.0, 100.0, 1e-3):  # the second is clipped
        grad = scale * torch.randn(30, 7, generator=generator)
        for param, optimizer in zip((one, other), optimizers, strict=True):
            param.grad = grad.clone()
            optimizer.step()
    assert torch.equal(one, other)
    assert torch.equal(optimizers[0].state[one]["square_avg"], optimizers[1].state[other]["square_avg"])


def test_the_released_codes_numbers(golden: Path) -> None:
    """golden_optim, its first step, as one thread's update."""
    about = json.loads((golden / "golden_optim.json").read_text())
    with np.load(golden / "golden_optim.npz") as stored:
        arrays = dict(stored)
    for j, (shape, scale) in enumerate(zip(about["shapes"], about["grad_scales"], strict=True)):
        start = np.random.default_rng([about["seed"], 5000, j]).uniform(-1, 1, shape).astype(np.float32)
        draw = np.random.default_rng([about["seed"], 5001, 0, j]).standard_normal(shape) * scale
        weight = nn.Parameter(torch.from_numpy(start))
        weight.grad = torch.from_numpy(draw.astype(np.float32))
        optimizer = A3CRMSprop([weight], lr=about["lrs"][0], threads=1)
        optimizer.step()
        np.testing.assert_allclose(weight.detach().numpy(), arrays[f"var_1_v{j}"], rtol=1e-6, atol=1e-6)
        accumulator = optimizer.state[weight]["square_avg"].numpy()
        np.testing.assert_allclose(accumulator, arrays[f"rms_1_v{j}"], rtol=2e-6)


def test_the_error_falls_with_the_learning_rate(threads: tuple[Tensor, Tensor]) -> None:
    """Of second order is what the threads' moving of the weights between them adds."""
    errors = []
    for lr in (1.0, 0.1, 0.01):
        exact = exact_step(*threads, lr=lr, start=0.0)
        step = moved_by(
            lambda net, lr=lr: A3CRMSprop(  # type: ignore[misc]
                net.parameters(), lr=lr, initial_accumulator=0.0, threads=THREADS
            ),
            *threads,
            per_update=THREADS,
        )
        errors.append(error(step, exact))
    assert errors[0] > 5 * errors[1] > 25 * errors[2] > 0, errors
    assert errors[2] < 0.01, errors


@pytest.mark.parametrize("start", [0.0, 1.0])
def test_far_nearer_than_one_update_with_the_mean(threads: tuple[Tensor, Tensor], start: float) -> None:
    exact = exact_step(*threads, lr=7e-4, start=start)
    options = {"lr": 7e-4, "initial_accumulator": start}
    today = moved_by(lambda net: TFRMSprop(net.parameters(), **options), *threads, per_update=THREADS)  # type: ignore[arg-type]
    ours = moved_by(
        lambda net: A3CRMSprop(net.parameters(), threads=THREADS, **options),  # type: ignore[arg-type]
        *threads,
        per_update=THREADS,
    )
    assert error(today, exact) > 0.9
    assert error(ours, exact) < 0.02


def test_fewer_threads_per_update_are_nearer(threads: tuple[Tensor, Tensor]) -> None:
    exact = exact_step(*threads, lr=1.0)
    errors = [
        error(
            moved_by(
                lambda net, n=n: A3CRMSprop(net.parameters(), lr=1.0, threads=n),  # type: ignore[misc]
                *threads,
                per_update=n,
            ),
            exact,
        )
        for n in (20, 10, 4, 1)
    ]
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 1e-12


def test_the_accumulator_is_that_of_the_sequence() -> None:
    """Exactly, where the threads agree."""
    ours, theirs = (nn.Parameter(torch.zeros(3, dtype=torch.float64)) for _ in range(2))
    grad = torch.tensor([0.5, -2.0, 0.0], dtype=torch.float64)
    optimizer, sequential = A3CRMSprop([ours], threads=50), TFRMSprop([theirs])
    ours.grad = theirs.grad = grad
    optimizer.step()
    for _ in range(50):
        sequential.step()
    torch.testing.assert_close(optimizer.state[ours], sequential.state[theirs])
    torch.testing.assert_close(ours, theirs, rtol=0.03, atol=0.0)


def test_every_threads_gradient_is_clipped_tensor_by_tensor() -> None:
    """Fifty threads that agree on a gradient of norm 400 each apply one of norm 40; a short one stays."""
    long, short = (nn.Parameter(torch.zeros(4)) for _ in range(2))
    long.grad, short.grad = torch.full((4,), 200.0), torch.full((4,), 0.1)
    clipped, kept = nn.Parameter(torch.zeros(4)), nn.Parameter(torch.zeros(4))
    clipped.grad, kept.grad = torch.full((4,), 20.0), torch.full((4,), 0.1)
    A3CRMSprop([long, short], threads=50).step()
    A3CRMSprop([clipped, kept], threads=50, max_grad_norm=None).step()
    torch.testing.assert_close(long, clipped)
    assert torch.equal(short, kept)


def test_a_state_that_is_saved_goes_on(threads: tuple[Tensor, Tensor]) -> None:
    net, other = network(), network()
    optimizer = A3CRMSprop(net.parameters(), threads=THREADS)
    gradients(net, *threads)
    optimizer.step()
    resumed = A3CRMSprop(other.parameters(), threads=THREADS)
    resumed.load_state_dict(copy.deepcopy(optimizer.state_dict()))
    other.load_state_dict(net.state_dict())
    for model, stepper in ((net, optimizer), (other, resumed)):
        gradients(model, *threads)
        stepper.step()
    assert torch.equal(flat(net), flat(other))


def test_the_closures_loss_comes_back() -> None:
    weight = nn.Parameter(torch.ones(2))

    def closure() -> float:
        loss = weight.sum()
        loss.backward()
        return loss.item()

    assert A3CRMSprop([weight], threads=2).step(closure) == 2.0
    assert (weight < 1).all()


@pytest.mark.parametrize("number", [0, -1, 2.0, True, None])
def test_a_bad_number_of_threads_is_refused(number: object) -> None:
    with pytest.raises(ValueError, match=r"^A3CRMSprop: threads is .*; give a whole number of 1 or more$"):
        A3CRMSprop([nn.Parameter(torch.ones(1))], threads=number)  # type: ignore[arg-type]


def test_rates_out_of_range_are_refused_as_ever() -> None:
    with pytest.raises(ValueError, match="alpha is 2"):
        A3CRMSprop([nn.Parameter(torch.ones(1))], alpha=2.0, threads=4)
