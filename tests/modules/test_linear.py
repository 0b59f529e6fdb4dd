from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.utils.flop_counter import FlopCounterMode

from vusfa.errors import ConfigError
from vusfa.modules import HistoryLinear, SceneLinear, linear
from vusfa.modules.rows import SceneBlocks, SortedByScene


def by_rows(layer: SceneLinear, x: torch.Tensor, scene_id: torch.Tensor) -> torch.Tensor:
    """The definition, one row at a time."""
    rows = [
        layer.weight[scene] @ row + layer.bias[scene]
        for row, scene in zip(x.flatten(0, -2), scene_id.flatten().tolist(), strict=True)
    ]
    return torch.stack(rows).view(*x.shape[:-1], -1)


class TestSceneLinear:
    def test_by_hand(self) -> None:
        layer = SceneLinear(2, 1, 1)
        with torch.no_grad():
            layer.weight.copy_(torch.tensor([[[2.0]], [[-1.0]]]))
            layer.bias.copy_(torch.tensor([[10.0], [20.0]]))
        out = layer(torch.tensor([[3.0], [3.0], [5.0]]), torch.tensor([1, 0, 1]))
        assert out.tolist() == [[17.0], [16.0], [15.0]]

    @given(scene_id=st.lists(st.integers(0, 3), min_size=1, max_size=12), wide=st.booleans())
    def test_sorted_rows_that_are_counted(self, scene_id: list[int], wide: bool) -> None:
        layer = SceneLinear(4, 5, 40 if wide else 4)
        x, scene = torch.randn(len(scene_id), 5), torch.tensor(sorted(scene_id))
        rows = SortedByScene(scene, [scene_id.count(number) for number in range(4)])
        torch.testing.assert_close(layer(x, rows), by_rows(layer, x, scene))

    @given(scene_id=st.lists(st.integers(0, 3), min_size=1, max_size=40))
    def test_rows_in_blocks(self, scene_id: list[int]) -> None:
        layer, scene = SceneLinear(4, 5, 7), torch.tensor(scene_id)
        x, blocks = torch.randn(len(scene_id), 5), SceneBlocks.of(*SortedByScene.sort(scene, 4))
        most = max(scene_id.count(number) for number in range(4))
        assert (blocks is None) == (4 * most > 1.5 * len(scene_id))
        if blocks is not None:
            assert blocks.size == most
            laid = blocks.lay_out(x)
            assert laid.shape == (4, most, 5)
            torch.testing.assert_close(blocks.pick_up(laid), x)
            torch.testing.assert_close(blocks.pick_up(layer(laid, blocks)), by_rows(layer, x, scene))

    @given(scene_id=st.lists(st.integers(0, 3), min_size=1, max_size=12), wide=st.booleans())
    def test_each_row_meets_its_own_scene(self, scene_id: list[int], wide: bool) -> None:
        """Narrow outputs are computed for all scenes and picked, wide ones by sorting."""
        out_features = 40 if wide else 4
        layer = SceneLinear(4, 5, out_features)
        x = torch.randn(len(scene_id), 5, requires_grad=True)
        scene = torch.tensor(scene_id)
        outcomes = []
        for compute in (layer, lambda *inputs: by_rows(layer, *inputs)):
            out = compute(x, scene)
            gradients = torch.autograd.grad(out.square().sum(), [x, layer.weight, layer.bias])
            outcomes.append((out, *gradients))
        for ours, wanted in zip(*outcomes, strict=True):
            torch.testing.assert_close(ours, wanted, rtol=1e-4, atol=1e-5)

    @pytest.mark.parametrize("batch", [(), (3,), (2, 5)])
    @pytest.mark.parametrize("num_scenes", [1, 3])
    def test_batch_shapes(self, batch: tuple[int, ...], num_scenes: int) -> None:
        layer = SceneLinear(num_scenes, 5, 40)
        x, scene_id = torch.randn(*batch, 5), torch.randint(num_scenes, batch)
        assert layer(x, scene_id).shape == (*batch, 40)
        torch.testing.assert_close(
            layer(x, scene_id), by_rows(layer, x.view(-1, 5), scene_id).view(*batch, 40)
        )

    def test_one_scene_in_the_batch_costs_one_product(self) -> None:
        layer = SceneLinear(4, 32, 64)
        for scene_id in (torch.full((10,), 2), torch.arange(10) % 4):
            with FlopCounterMode(display=False) as flops:
                layer(torch.randn(10, 32), scene_id)
            assert flops.get_total_flops() == 2 * 10 * 32 * 64

    def test_dense_and_sorted_agree(self, monkeypatch: pytest.MonkeyPatch) -> None:
        layer, x, scene_id = SceneLinear(3, 6, 4), torch.randn(20, 6), torch.randint(3, (20,))
        dense = layer(x, scene_id)
        monkeypatch.setattr(linear, "_DENSE_OUTPUTS", 0)
        torch.testing.assert_close(layer(x, scene_id), dense)

    def test_a_scene_out_of_range_is_an_error(self) -> None:
        with pytest.raises(ConfigError, match="scene_id holds 2, and the agent has weights for 2 scenes"):
            SceneLinear(2, 3, 4)(torch.randn(1, 3), torch.tensor([2]))
        with pytest.raises(ConfigError, match="scene_id holds 2"):
            SceneLinear(2, 3, 400)(torch.randn(2, 3), torch.tensor([2, 0]))

    def test_starts_uniform(self) -> None:
        weight = SceneLinear(2, 400, 50).weight
        assert 0.049 < weight.abs().max().item() <= 0.05
        assert weight.std().item() == pytest.approx(0.05 / 3**0.5, rel=0.02)


class TestHistoryLinear:
    def test_is_a_linear_layer_on_frames_end_to_end(self) -> None:
        layer = HistoryLinear(4, 6, 5)
        frames = torch.randn(3, 2, 4, 6)
        flat = torch.nn.functional.linear(
            frames.flatten(-2), layer.weight.transpose(0, 1).reshape(5, 24), layer.bias
        )
        torch.testing.assert_close(layer(frames), flat)

    def test_the_order_of_frames_matters(self) -> None:
        layer, frames = HistoryLinear(2, 3, 1), torch.zeros(1, 2, 3)
        with torch.no_grad():
            layer.weight.copy_(torch.tensor([[[1.0, 0, 0]], [[100.0, 0, 0]]]))
            layer.bias.zero_()
        frames[0, 0, 0], frames[0, 1, 0] = 3.0, 4.0
        assert layer(frames).item() == 3.0 + 400.0

    def test_repeated(self) -> None:
        layer, frame = HistoryLinear(4, 6, 5), torch.randn(7, 6)
        wanted = layer(frame.unsqueeze(-2).expand(7, 4, 6))
        torch.testing.assert_close(layer.repeated(frame), wanted)

    @pytest.mark.parametrize("history", [1, 4])
    @pytest.mark.parametrize("batch", [(), (3,), (2, 5)])
    def test_sums_of_products_give_values_and_gradients(self, history: int, batch: tuple[int, ...]) -> None:
        layer, frames = HistoryLinear(history, 6, 5), torch.randn(8, 6, requires_grad=True)
        index = torch.randint(8, (*batch, history))
        outcomes = []
        for out in (layer(frames[index]), layer.gather(layer.project(frames), index)):
            assert out.shape == (*batch, 5)
            gradients = torch.autograd.grad(out.square().sum(), [frames, layer.weight, layer.bias])
            outcomes.append((out, *gradients))
        for direct, summed in zip(*outcomes, strict=True):
            torch.testing.assert_close(summed, direct, rtol=1e-4, atol=1e-5)

    def test_starts_uniform_over_the_whole_history(self) -> None:
        weight = HistoryLinear(4, 100, 50).weight
        assert 0.049 < weight.abs().max().item() <= 0.05
