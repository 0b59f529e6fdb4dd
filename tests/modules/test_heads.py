"""Trunk, successor, value and policy heads."""

from __future__ import annotations

import pytest
import torch

from vusfa.errors import ConfigError
from vusfa.modules import (
    Fusion,
    PolicyHead,
    RewardHead,
    SceneLayer,
    SuccessorHead,
    SuccessorPolicyHead,
    SuccessorValue,
    ValueHead,
)

BATCHES = [(), (3,), (2, 5)]


@pytest.mark.parametrize("batch", BATCHES)
def test_shapes(batch: tuple[int, ...]) -> None:
    embedding, hidden = torch.randn(*batch, 6), torch.randn(*batch, 8)
    scene_id = torch.randint(3, batch)
    assert Fusion(6, 8)(embedding, embedding).shape == (*batch, 8)
    assert SceneLayer(3, 8, 8)(hidden, scene_id).shape == (*batch, 8)
    psi, omega = SuccessorHead(3, 8, 6)(hidden, scene_id), RewardHead(6, 8)(embedding)
    assert psi.shape == omega.shape == (*batch, 6)
    assert SuccessorValue()(psi, omega).shape == (*batch, 1)
    assert ValueHead(3, 8)(hidden, scene_id).shape == (*batch, 1)
    assert PolicyHead(3, 8, 4)(hidden, scene_id).shape == (*batch, 4)
    assert SuccessorPolicyHead(3, 8, 6, 4)(hidden, psi, scene_id).shape == (*batch, 4)


def test_value_is_the_dot_product() -> None:
    psi = torch.tensor([[1.0, 2.0, 3.0], [0.0, 1.0, 0.0]])
    omega = torch.tensor([[4.0, -1.0, 2.0], [7.0, 8.0, 9.0]])
    assert SuccessorValue()(psi, omega).tolist() == [[8.0], [8.0]]


@pytest.mark.parametrize("module", [Fusion(6, 8), SceneLayer(2, 12, 8)], ids=["fusion", "scene"])
def test_the_trunk_is_rectified(module: torch.nn.Module) -> None:
    if isinstance(module, Fusion):
        out = module(torch.randn(50, 6), torch.randn(50, 6))
    else:
        out = module(torch.randn(50, 12), torch.randint(2, (50,)))
    assert (out == 0).any()
    assert (out > 0).any()
    assert not (out < 0).any()


def test_scales_are_factors() -> None:
    hidden, scene_id = torch.randn(3, 8), torch.tensor([0, 1, 0])
    for head, inputs in ((SuccessorHead(2, 8, 6), (hidden, scene_id)), (RewardHead(8, 6), (hidden,))):
        once = head(*inputs)
        head.scale = 100.0
        torch.testing.assert_close(head(*inputs), 100 * once)


def test_state_comes_before_goal() -> None:
    fusion = Fusion(1, 1)
    with torch.no_grad():
        fusion.linear.weight.copy_(torch.tensor([[1.0, 10.0]]))
        fusion.linear.bias.zero_()
    assert fusion(torch.tensor([2.0]), torch.tensor([3.0])).item() == 32.0


class TestSuccessorPolicy:
    def head(self, **options: object) -> SuccessorPolicyHead:
        torch.manual_seed(0)
        return SuccessorPolicyHead(2, 8, 6, 4, **options)

    def test_no_gradient_reaches_psi_but_hidden_has_one(self) -> None:
        hidden, psi = torch.randn(5, 8, requires_grad=True), torch.randn(5, 6, requires_grad=True)
        for norm in (None, "layer"):
            hidden.grad = None
            self.head(successor_norm=norm)(hidden, psi, torch.randint(2, (5,))).square().sum().backward()
            assert psi.grad is None
            assert hidden.grad.any()

    def test_psi_is_read(self) -> None:
        head, hidden, scene_id = self.head(), torch.randn(5, 8), torch.zeros(5, dtype=torch.int64)
        assert (head(hidden, torch.zeros(5, 6), scene_id) - head(hidden, torch.ones(5, 6), scene_id)).any()

    def test_normalized_psi_has_no_scale(self) -> None:
        hidden, psi, scene_id = torch.randn(5, 8), torch.randn(5, 6), torch.zeros(5, dtype=torch.int64)
        layer = self.head(successor_norm="layer")
        torch.testing.assert_close(
            layer(hidden, 50 * psi + 7, scene_id), layer(hidden, psi, scene_id), rtol=1e-4, atol=1e-5
        )
        assert (
            self.head()(hidden, 50 * psi, scene_id) - self.head()(hidden, psi, scene_id)
        ).abs().max() > 0.1

    def test_by_hand(self) -> None:
        """psi = (1, 7) has mean 4 and deviation 3."""
        head = SuccessorPolicyHead(1, 1, 2, 1, successor_norm="layer")
        seen: list[torch.Tensor] = []
        head.first.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
        head(torch.tensor([7.0]), torch.tensor([1.0, 7.0]), torch.tensor(0))
        torch.testing.assert_close(seen[0], torch.tensor([7.0, -1.0, 1.0]))

    def test_rectified_logits(self) -> None:
        inputs = torch.randn(50, 8), torch.randn(50, 6), torch.randint(2, (50,))
        plain = self.head()(*inputs)
        assert (plain < 0).any()
        torch.testing.assert_close(self.head(rectify_logits=True)(*inputs), plain.clamp(min=0))

    def test_unknown_norm(self) -> None:
        with pytest.raises(ConfigError, match="successor_norm is 'batch'"):
            self.head(successor_norm="batch")

    def test_half_precision(self) -> None:
        inputs = torch.randn(5, 8), torch.randn(5, 6), torch.randint(2, (5,))
        with torch.autocast("cpu", torch.bfloat16):
            logits = self.head(successor_norm="layer")(*inputs)
        assert logits.dtype == torch.float32
