from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from vusfa.modules.precision import bucket_size, padded_linear
from vusfa.modules.rows import SceneBlocks, SortedByScene


def test_no_rows_are_no_blocks() -> None:
    assert SceneBlocks.of(*SortedByScene.sort(torch.zeros(0, dtype=torch.int64), 3)) is None


@given(number=st.integers(1, 10**6))
def test_bucket_sizes_are_few_and_near(number: int) -> None:
    size = bucket_size(number)
    assert number <= size < max(number + 16, 1.125 * number + 1)
    assert bucket_size(size) == size
    assert bucket_size(number + 1) >= size


class TestPaddedLinear:
    @given(number=st.integers(1, 700), data=st.data())
    def test_as_if_no_row_were_added(self, number: int, data: st.DataObject) -> None:
        """To the last bit where this was measured; other processors may sum over rows in another order."""
        torch.manual_seed(data.draw(st.integers(0, 9)))
        made = [torch.randn(*shape).bfloat16() for shape in ((number, 24), (16, 24), (16,))]
        outcomes = []
        for compute in (padded_linear, torch.nn.functional.linear):
            inputs = [x.clone().requires_grad_() for x in made]
            out = compute(*inputs)
            torch.manual_seed(1)
            outcomes.append((out, *torch.autograd.grad(out, inputs, torch.randn_like(out))))
        for ours, wanted in zip(*outcomes, strict=True):
            torch.testing.assert_close(ours, wanted, rtol=0.008, atol=0.02)

    def test_few_numbers_of_rows(self, monkeypatch: pytest.MonkeyPatch) -> None:
        seen = []
        plain = torch.nn.functional.linear
        monkeypatch.setattr(
            torch.nn.functional, "linear", lambda x, *rest: (seen.append(len(x)), plain(x, *rest))[1]
        )
        weight, bias = torch.ones(2, 3).bfloat16(), torch.zeros(2).bfloat16()
        asked = range(1, 3000, 7)
        for number in asked:
            assert padded_linear(torch.ones(number, 3).bfloat16(), weight, bias).shape == (number, 2)
        assert len(set(seen)) < 60
        assert all(
            before <= now < max(1.25 * before, before + 16) for before, now in zip(asked, seen, strict=True)
        )

    def test_float32_is_left_alone(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def refuse(*_: object) -> None:
            raise AssertionError("rows were added")

        monkeypatch.setattr(torch.nn.functional, "pad", refuse)
        x, weight, bias = torch.randn(5, 3), torch.randn(2, 3), torch.randn(2)
        torch.testing.assert_close(padded_linear(x, weight, bias), x @ weight.T + bias)
        with torch.autocast("cpu", torch.bfloat16), pytest.raises(AssertionError, match="rows were added"):
            padded_linear(x, weight, bias)
