from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from vusfa.modules import Fusion, frozen
from vusfa.modules.freezing import Freezable, for_autocast
from vusfa.modules.siamese import Branch


class Counting(Freezable):
    def __init__(self) -> None:
        super().__init__()
        self.calls: list[object] = []

    def freeze(self, grad: bool = False, goals: Tensor | None = None) -> None:
        self.calls.append((grad, None if goals is None else goals.tolist()))

    def thaw(self) -> None:
        self.calls.append("thawed")


def test_every_part_is_frozen_and_thawed_whatever_happens() -> None:
    parts = [Counting(), Counting()]
    whole = nn.Sequential(parts[0], nn.Linear(2, 2), nn.Sequential(parts[1]))
    with pytest.raises(ZeroDivisionError), frozen(whole, grad=True, goals=torch.tensor([4])):
        raise ZeroDivisionError
    for part in parts:
        assert part.calls == [(True, [4]), "thawed"]


def test_parts_of_weights_are_converted_once() -> None:
    torch.manual_seed(0)
    fusion, branch = Fusion(6, 8), Branch(1, 4, 5, 12)
    embedding, sums = torch.randn(7, 6), torch.randn(7, 5)
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        wanted = fusion.state_part(embedding), branch.finish(sums, half=True)
        torch.testing.assert_close(wanted[1], branch.finish(sums)[:, :6])
        fusion.freeze()
        branch.freeze()
        fusion.linear.weight.mul_(2.0)
        branch.last.weight.mul_(2.0)
        assert torch.equal(fusion.state_part(embedding), wanted[0])
        assert torch.equal(branch.finish(sums, half=True), wanted[1])
        with torch.enable_grad():  # gradients are of the weights themselves
            assert not torch.equal(fusion.state_part(embedding), wanted[0])
            assert not torch.equal(branch.finish(sums, half=True), wanted[1])
        fusion.thaw()
        branch.thaw()
        assert not torch.equal(fusion.state_part(embedding), wanted[0])
        assert not torch.equal(branch.finish(sums, half=True), wanted[1])


def test_what_autocast_would_make_of_a_weight() -> None:
    weight = torch.rand(3)
    assert for_autocast(weight) is weight
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(for_autocast(weight), weight.bfloat16())
