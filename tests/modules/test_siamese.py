from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from vusfa.errors import ConfigError
from vusfa.modules import FeatureFrames, NormalisedEncoder, SiameseEncoder, frozen
from vusfa.modules.siamese import Branch
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
            module.from_ids(state_id, goal_id),
            module.from_observations(*features(scenes, state_id, goal_id)),
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
        direct = module.from_observations(*features(scenes, state_id, goal_id))
        torch.testing.assert_close(module.from_ids(state_id, goal_id), direct)

    @pytest.mark.parametrize("history", [1, 4])
    @pytest.mark.parametrize("rows", [5, 60])
    def test_half_precision(self, scenes: SceneSet, history: int, rows: int) -> None:
        """bfloat16 has 8 bits: both ways stay within a few of its steps of the exact codes, in float32."""
        module = encoder(scenes, history)
        state_id, goal_id = ids(scenes, rows, history=history)
        exact = module.from_observations(*features(scenes, state_id, goal_id))
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
        torch.testing.assert_close(module.from_observations(observation, goal), module(state_id, goal_id))

    def test_a_shorter_history_is_an_error(self, scenes: SceneSet) -> None:
        module = encoder(scenes, 4)
        state_id, goal_id = ids(scenes, 6, history=3)
        with pytest.raises(ConfigError, match="state_id has 3 frames a row and the agent reads 4"):
            module(state_id, goal_id)
        with pytest.raises(ConfigError, match="observation has 3 frames"):
            module.from_observations(*features(scenes, state_id, goal_id))

    def test_a_goal_may_be_several_frames(self, scenes: SceneSet) -> None:
        module = encoder(scenes)
        state_id, goal_id = ids(scenes, 6)
        observation, goal = features(scenes, state_id, goal_id)
        repeated = goal.unsqueeze(-2).expand(6, 4, 12)
        torch.testing.assert_close(
            module.from_observations(observation, repeated), module.from_observations(observation, goal)
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


def test_normalised_embeddings(scenes: SceneSet) -> None:
    """Of (2, 4, 6, 8), mean 5 and deviation sqrt 5, each becomes (x - 5) / sqrt 5; whatever the scale."""
    wanted = torch.tensor([-3.0, -1.0, 1.0, 3.0]) / 5**0.5
    given = torch.tensor([2.0, 4.0, 6.0, 8.0])

    class Encoder:
        def both(
            self, state: torch.Tensor, goal: torch.Tensor, heads: Any, part: int | None
        ) -> tuple[Any, Any]:
            return heads[0](state), heads[1](goal)

    state, goal = NormalisedEncoder(Encoder())(given, 100 * given)
    torch.testing.assert_close(state, wanted)
    torch.testing.assert_close(goal, wanted)


class TestFrozen:
    @pytest.mark.parametrize("history", [1, 4])
    @pytest.mark.parametrize("quirk", QUIRKS, ids=str)
    def test_same_codes(self, scenes: SceneSet, history: int, quirk: dict[str, Any]) -> None:
        module = encoder(scenes, history, **quirk)
        inputs = ids(scenes, 2, 5, history=history)
        wanted = module(*inputs)
        with frozen(torch.nn.Sequential(module)), torch.no_grad():
            torch.testing.assert_close(module(*inputs), wanted)

    def test_nothing_is_multiplied_twice(self, scenes: SceneSet) -> None:
        module = encoder(scenes, 1)
        with frozen(module), FlopCounterMode(display=False) as counter, torch.no_grad():
            before = counter.get_total_flops()
            module(*ids(scenes, 5, history=1))
            assert counter.get_total_flops() == before

    def test_thaws_even_after_an_error(self, scenes: SceneSet) -> None:
        module = encoder(scenes)
        inputs = ids(scenes, 5)
        with pytest.raises(KeyError), frozen(module):
            raise KeyError
        with torch.no_grad():
            before = module(*inputs)[1]
            module.branch.last.bias.add_(1.0)
            torch.testing.assert_close(module(*inputs)[1], before + 1.0)

    def test_gradients_are_of_the_weights_as_they_are(self, scenes: SceneSet) -> None:
        module = encoder(scenes)
        with frozen(module):
            module(*ids(scenes, 5))[0].sum().backward()
        assert all(parameter.grad.any() for parameter in module.parameters())

    @pytest.mark.parametrize("history", [1, 4])
    def test_gradients_through_what_is_looked_up(self, scenes: SceneSet, history: int) -> None:
        """Encoded once with gradients, collected with and differentiated: the gradients of encoding anew."""
        module, inputs = encoder(scenes, history), ids(scenes, 2, 5, history=history)
        gradients = []
        for grad in (False, True):
            module.zero_grad()
            with frozen(module, grad=grad):
                with torch.no_grad():
                    module(*inputs)
                with FlopCounterMode(display=False) as counter:
                    state, goal = module(*inputs)
                (state.square().sum() + goal.sum()).backward()
            gradients.append([parameter.grad.clone() for parameter in module.parameters()])
        torch.testing.assert_close(gradients[0], gradients[1], atol=1e-4, rtol=1e-4)
        if history == 1:
            assert counter.get_total_flops() == 0

    @pytest.mark.parametrize("history", [1, 4])
    @pytest.mark.parametrize("quirk", QUIRKS, ids=str)
    def test_only_the_goals_that_there_are(
        self, scenes: SceneSet, history: int, quirk: dict[str, Any]
    ) -> None:
        module = encoder(scenes, history, **quirk)
        states, _ = ids(scenes, 2, 5, history=history)
        goals = torch.tensor([7, 2, 11])
        chosen = goals[torch.randint(3, (2, 5))]
        wanted = module(states, chosen)
        with frozen(module, goals=goals), torch.no_grad():
            torch.testing.assert_close(module(states, chosen), wanted)
            with pytest.raises(IndexError):
                module(states, torch.full((2, 5), 3))

    @pytest.mark.parametrize("history", [1, 4])
    def test_one_part_of_what_the_heads_return(self, scenes: SceneSet, history: int) -> None:
        def head(code: torch.Tensor) -> tuple[torch.Tensor, ...]:
            return code + 1, code * 2

        module, inputs = encoder(scenes, history), ids(scenes, 60, history=history)
        for some in (inputs, tuple(part[:3] for part in inputs)):
            for context in (nullcontext(), frozen(module)):
                with context, torch.no_grad():
                    state, goal = module(*some)
                    twice = module.both(*some, (head, head), 1)
                torch.testing.assert_close(twice, (2 * state, 2 * goal))

    def test_an_agent_fed_features_has_nothing_to_freeze(self, scenes: SceneSet) -> None:
        module = SiameseEncoder(FeatureFrames(scenes.features, lookup=False), 4, 16, 8, by_id=False)
        inputs = features(scenes, *ids(scenes, 5))
        with frozen(module), torch.no_grad():
            torch.testing.assert_close(module(*inputs), module.from_observations(*inputs))
