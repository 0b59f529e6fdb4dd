from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from vusfa.errors import ConfigError
from vusfa.modules import FeatureFrames, Fusion, SiameseEncoder
from vusfa.modules.siamese import Branch
from vusfa.modules.trunk import CachedTrunk, SiameseTrunk
from vusfa.scenes import SceneSet

QUIRKS: list[dict[str, Any]] = [{}, {"shared": False}, {"state_layer": True}, {"out_features": None}]


def encoder(scenes: SceneSet, history: int = 4, **options: Any) -> SiameseEncoder:
    torch.manual_seed(0)
    options.setdefault("out_features", 8)
    return SiameseEncoder(FeatureFrames(scenes.features), history, 16, **options)


def ids(scenes: SceneSet, *batch: int, history: int = 4) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(len(batch))
    return tuple(
        torch.randint(scenes.num_states, shape, generator=generator) for shape in ((*batch, history), batch)
    )


def features(scenes: SceneSet, state: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
    return scenes.features[state, 0], scenes.features[goal, 0]


def observed(module: SiameseEncoder, state: Tensor, goal: Tensor) -> tuple[Tensor, ...]:
    """Codes of observations."""
    module.by_id = False
    try:
        return module(state, goal)
    finally:
        module.by_id = True


class TestByIds:
    """Whatever way a batch takes, it gives what encoding every frame of every row gives."""

    # the world has 21 states: fewer rows than distinct frames; as many; more rows than the world has states
    @pytest.mark.parametrize("batch", [(), (3,), (2, 5), (20,), (60,), (6, 10)])
    @pytest.mark.parametrize("history", [1, 2, 4])
    @pytest.mark.parametrize("quirk", QUIRKS, ids=str)
    def test_values_and_gradients(
        self, scenes: SceneSet, batch: tuple[int, ...], history: int, quirk: dict[str, Any]
    ) -> None:
        module = encoder(scenes, history, **quirk)
        state_id, goal_id = ids(scenes, *batch, history=history)
        outcomes = []
        for codes in (
            module(state_id, goal_id),
            observed(module, *features(scenes, state_id, goal_id)),
        ):
            state, goal = codes
            assert state.shape == goal.shape == (*batch, 16 if quirk.get("out_features", 8) is None else 8)
            total = (state.square() + 0.3 * goal + state * goal).sum()
            outcomes.append((state, goal, *torch.autograd.grad(total, list(module.parameters()))))
        for looked_up, direct in zip(*outcomes, strict=True):
            torch.testing.assert_close(looked_up, direct, rtol=1e-4, atol=1e-5)

    def test_few_distinct_frames_in_a_large_world(self, scenes: SceneSet) -> None:
        """Eight rows over three states: less than the world, but fewer distinct frames than rows."""
        module = encoder(scenes)
        state_id, goal_id = torch.randint(3, (8, 4)) + 9, torch.randint(3, (8,)) + 9
        direct = observed(module, *features(scenes, state_id, goal_id))
        torch.testing.assert_close(module(state_id, goal_id), direct)

    @pytest.mark.parametrize("history", [1, 4])
    @pytest.mark.parametrize("rows", [5, 60])
    def test_half_precision(self, scenes: SceneSet, history: int, rows: int) -> None:
        """bfloat16 has 8 bits: both ways stay within a few of its steps of the exact codes, in float32."""
        module = encoder(scenes, history)
        state_id, goal_id = ids(scenes, rows, history=history)
        exact = observed(module, *features(scenes, state_id, goal_id))
        with torch.autocast("cpu", torch.bfloat16):
            by_id = module(state_id, goal_id)
            module.by_id = False
            direct = module(*features(scenes, state_id, goal_id))
        sum(code.sum() for code in by_id).backward()
        assert all(parameter.grad.isfinite().all() for parameter in module.parameters())
        for code, other, wanted in zip(by_id, direct, exact, strict=True):
            assert code.dtype == other.dtype == torch.float32
            torch.testing.assert_close(code, wanted, rtol=0.02, atol=0.02)
            torch.testing.assert_close(code, other, rtol=0.02, atol=0.02)

    @pytest.mark.parametrize("half", [True, False])
    def test_few_numbers_of_distinct_frames_in_half_precision(
        self, scenes: SceneSet, monkeypatch: pytest.MonkeyPatch, half: bool
    ) -> None:
        module, seen, plain = encoder(scenes), [], FeatureFrames.lookup
        monkeypatch.setattr(
            FeatureFrames, "lookup", lambda frames, ids: (seen.append(len(ids)), plain(frames, ids))[1]
        )
        different = range(1, 15)
        for number in different:
            state_id = torch.arange(number).unsqueeze(-1).expand(-1, 4)
            with torch.autocast("cpu", torch.bfloat16, enabled=half):
                module(state_id, torch.arange(number))
        assert seen == ([16] * len(different) if half else list(different))

    def test_a_longer_history_is_cut_to_the_newest_frames(self, scenes: SceneSet) -> None:
        module = encoder(scenes, 2)
        state_id, goal_id = ids(scenes, 6, history=5)
        torch.testing.assert_close(module(state_id, goal_id), module(state_id[:, -2:], goal_id))
        observation, goal = features(scenes, state_id, goal_id)
        torch.testing.assert_close(observed(module, observation, goal), module(state_id, goal_id))

    def test_a_shorter_history_is_an_error(self, scenes: SceneSet) -> None:
        module = encoder(scenes, 4)
        state_id, goal_id = ids(scenes, 6, history=3)
        with pytest.raises(ConfigError, match="state_id has 3 frames a row and the agent reads 4"):
            module(state_id, goal_id)
        with pytest.raises(ConfigError, match="observation has 3 frames"):
            observed(module, *features(scenes, state_id, goal_id))

    def test_a_goal_may_be_several_frames(self, scenes: SceneSet) -> None:
        module = encoder(scenes)
        state_id, goal_id = ids(scenes, 6)
        observation, goal = features(scenes, state_id, goal_id)
        repeated = goal.unsqueeze(-2).expand(6, 4, 12)
        torch.testing.assert_close(
            observed(module, observation, repeated), observed(module, observation, goal)
        )


class TestSharing:
    def test_siamese(self, scenes: SceneSet) -> None:
        """A state that stood still and itself as the goal have one embedding."""
        state, goal = encoder(scenes)(torch.full((4,), 5), torch.tensor(5))
        torch.testing.assert_close(state, goal)

    @pytest.mark.parametrize("quirk", QUIRKS[1:3], ids=str)
    def test_quirks_are_not(self, scenes: SceneSet, quirk: dict[str, Any]) -> None:
        state, goal = encoder(scenes, **quirk)(torch.full((4,), 5), torch.tensor(5))
        assert (state - goal).abs().max() > 0.01

    def test_the_states_own_layer_by_hand(self) -> None:
        """max(0, first) through weight -1 and bias 3, max(0, .), then times 10: 2 becomes 10, 5 becomes 0."""
        branch, extra = Branch(1, 1, 1, 1), torch.nn.Linear(1, 1)
        with torch.no_grad():
            for layer, weight, bias in ((extra, -1.0, 3.0), (branch.last, 10.0, 0.0)):
                layer.weight.fill_(weight)
                layer.bias.fill_(bias)
        first = torch.tensor([[2.0], [5.0], [-4.0]])
        assert branch.finish(first, extra).tolist() == [[10.0], [0.0], [30.0]]
        assert branch.finish(first).tolist() == [[20.0], [50.0], [0.0]]

    def test_both_branches_train_the_same_weights(self, scenes: SceneSet) -> None:
        module = encoder(scenes)
        for which in (0, 1):
            module.zero_grad()
            module(*ids(scenes, 6))[which].sum().backward()
            assert all(parameter.grad.any() for parameter in module.parameters())

    def test_unshared_branches_train_their_own(self, scenes: SceneSet) -> None:
        module = encoder(scenes, shared=False)
        module(*ids(scenes, 6))[0].sum().backward()
        assert all(weight.grad is None or not weight.grad.any() for weight in module.goal_branch.parameters())
        assert all(weight.grad.any() for weight in module.branch.parameters())


class TestCost:
    """In multiply-adds of matrix products, times two."""

    FIRST = 2 * 12 * 16  # one frame through one place's weights

    def flops(self, module: SiameseEncoder, *inputs: Tensor) -> int:
        with FlopCounterMode(display=False) as counter, torch.no_grad():
            module(*inputs)
        return counter.get_total_flops()

    def test_the_first_layer_stops_growing_with_the_batch(self, scenes: SceneSet) -> None:
        module = encoder(scenes, out_features=None)
        world = 21 * 4 * self.FIRST
        for rows in (21, 100, 3000):
            assert self.flops(module, *ids(scenes, rows)) == world

    def test_all_layers_stop_growing_with_one_frame(self, scenes: SceneSet) -> None:
        module = encoder(scenes, 1)
        state_id, goal_id = torch.arange(3000).view(-1, 1) % 21, torch.full((3000,), 3)
        state, goal = 21 * (self.FIRST + 2 * 16 * 8), 2 * 16 * 8  # the goal's first layer is the state's
        assert self.flops(module, state_id, goal_id) == state + goal

    def test_each_distinct_frame_once(self, scenes: SceneSet) -> None:
        module = encoder(scenes, out_features=None)
        state_id = torch.tensor([[4, 4, 4, 7], [7, 4, 4, 4], [7, 7, 7, 7], [4, 4, 4, 4], [4, 7, 4, 7]])
        assert self.flops(module, state_id, torch.full((5,), 7)) == 2 * 4 * self.FIRST

    def test_never_more_than_row_by_row(self, scenes: SceneSet) -> None:
        module = encoder(scenes, out_features=None)
        state_id, goal_id = torch.arange(8).view(2, 4), torch.tensor([8, 8])
        assert self.flops(module, state_id, goal_id) == (2 * 4 + 1) * self.FIRST


def test_normalized_embeddings() -> None:
    """Of (2, 4, 6, 8), mean 5 and deviation sqrt 5, each becomes (x - 5) / sqrt 5; whatever the scale."""
    wanted = torch.tensor([[-3.0, -1.0, 1.0, 3.0]]) / 5**0.5
    frames = FeatureFrames(torch.tensor([[2.0, 4.0, 6.0, 8.0], [200.0, 400.0, 600.0, 800.0]]).unsqueeze(1))
    module = SiameseEncoder(frames, 1, 4, None, normalize=True)
    with torch.no_grad():
        module.branch.first.weight.copy_(torch.eye(4))
        module.branch.first.bias.zero_()
    state, goal = module(torch.tensor([[0]]), torch.tensor([1]))
    torch.testing.assert_close(state, wanted)
    torch.testing.assert_close(goal, wanted)


class TestCached:
    def trunk(self, scenes: SceneSet, history: int, quirk: dict[str, Any]) -> SiameseTrunk:
        size = 16 if quirk.get("out_features", 8) is None else 8
        return SiameseTrunk(encoder(scenes, history, **quirk), Fusion(size, 10))

    @pytest.mark.parametrize("history", [1, 4])
    @pytest.mark.parametrize("quirk", QUIRKS, ids=str)
    def test_same_fusion(self, scenes: SceneSet, history: int, quirk: dict[str, Any]) -> None:
        trunk = self.trunk(scenes, history, quirk)
        inputs = ids(scenes, 30, history=history)
        wanted = trunk(*inputs)[-1]
        torch.testing.assert_close(trunk.fused(*inputs), wanted)
        torch.testing.assert_close(CachedTrunk(trunk).fused(*inputs), wanted)

    def test_nothing_is_multiplied_twice(self, scenes: SceneSet) -> None:
        cached = CachedTrunk(self.trunk(scenes, 1, {}))
        with FlopCounterMode(display=False) as counter:
            cached.fused(*ids(scenes, 5, history=1))
        assert counter.get_total_flops() == 0

    @pytest.mark.parametrize("history", [1, 4])
    @pytest.mark.parametrize("quirk", QUIRKS, ids=str)
    def test_only_the_goals_that_there_are(
        self, scenes: SceneSet, history: int, quirk: dict[str, Any]
    ) -> None:
        trunk = self.trunk(scenes, history, quirk)
        states, _ = ids(scenes, 10, history=history)
        goals = torch.tensor([7, 2, 11])
        chosen = goals[torch.randint(3, (10,))]
        cached = CachedTrunk(trunk, goals)
        torch.testing.assert_close(cached.fused(states, chosen), trunk.fused(states, chosen))
        with pytest.raises(IndexError):
            cached.fused(states, torch.full((10,), 3))

    @pytest.mark.parametrize("history", [1, 4])
    def test_half_precision(self, scenes: SceneSet, history: int) -> None:
        trunk, inputs = self.trunk(scenes, history, {}), ids(scenes, 30, history=history)
        with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
            cached = CachedTrunk(trunk)
            assert cached.trunk.fusion.linear.weight.dtype == torch.bfloat16
            torch.testing.assert_close(cached.fused(*inputs), trunk.fused(*inputs), atol=0.02, rtol=0.02)
        assert trunk.fusion.linear.weight.dtype == torch.float32
