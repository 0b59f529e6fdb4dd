from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from vusfa.errors import ConfigError
from vusfa.modules import FeatureFrames, GaussianBottleneck, LatentSampler, SiameseEncoder, make_agent
from vusfa.modules.trunk import Fusion, SiameseTrunk
from vusfa.scenes import SceneSet


def gaussian(scenes: SceneSet, normalize: bool = False, **options: object) -> SiameseEncoder:
    torch.manual_seed(0)
    bottleneck = GaussianBottleneck(**options)
    frames = FeatureFrames(scenes.features)
    return SiameseEncoder(frames, 4, 16, 8, bottleneck=bottleneck, normalize=normalize)


class TestGaussianBottleneck:
    def test_means_are_the_embeddings(self, scenes: SceneSet) -> None:
        module = gaussian(scenes)
        inputs = torch.randint(21, (3, 4)), torch.randint(21, (3,))
        state, goal, state_loc, state_scale, state_kl, goal_loc, goal_scale, goal_kl = module(*inputs)
        states, goals = module.first_layer(*inputs)
        state_code = module.branch.finish(states.values)
        goal_code = module.branch.finish(goals.values)[goals.inverse]
        assert torch.equal(state, state_loc)
        assert torch.equal(goal, goal_loc)
        for kl, loc, scale in ((state_kl, state_loc, state_scale), (goal_kl, goal_loc, goal_scale)):
            nats = 0.5 * (loc**2 + scale**2 - 1) - scale.abs().log()
            torch.testing.assert_close(kl, nats.sum(-1, keepdim=True))
        assert torch.equal(state_loc, state_code[:, :8])
        assert torch.equal(goal_loc, goal_code[:, :8])
        torch.testing.assert_close(state_scale, (1 + state_code[:, 8:].exp()).log())
        torch.testing.assert_close(goal_scale, (1 + goal_code[:, 8:].exp()).log())

    def test_raw_scales_take_both_signs(self, scenes: SceneSet) -> None:
        module = gaussian(scenes, scale="raw")
        scale = module(torch.randint(21, (30, 4)), torch.randint(21, (30,)))[3]
        assert (scale < 0).any()
        assert (scale > 0).any()

    @pytest.mark.parametrize("initial_scale", [0.05, 0.5, 2.0])
    def test_scales_start_where_asked(self, scenes: SceneSet, initial_scale: float) -> None:
        module = gaussian(scenes, initial_scale=initial_scale)
        inputs = torch.randint(21, (30, 4)), torch.randint(21, (30,))
        _, _, loc, scale, *_ = module(*inputs)
        assert scale.median().item() == pytest.approx(initial_scale, rel=0.25)
        assert torch.equal(loc, gaussian(scenes)(*inputs)[2])  # the means are left alone

    def test_what_is_made_of_the_means_needs_no_scales(
        self, scenes: SceneSet, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        trunk = SiameseTrunk(gaussian(scenes, normalize=True), Fusion(8, 12))
        inputs = torch.randint(21, (30, 4)), torch.randint(21, (30,))
        wanted = trunk(*inputs)[-1]
        halves: list[bool] = []
        branch = trunk.encoder.branch
        finish = branch.finish
        monkeypatch.setattr(
            branch, "finish", lambda *given, half=False: halves.append(half) or finish(*given, half=half)
        )
        torch.testing.assert_close(trunk.fused(*inputs), wanted)
        assert halves == [True, True]
        trunk(*inputs)
        assert halves[2:] == [False, False]

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"scale": "exp"}, "scale is 'exp'"),
            ({"scale": "raw", "initial_scale": 0.1}, "initial_scale is 0.1 with scale 'raw'"),
            ({"initial_scale": 0.0}, "initial_scale is 0.0"),
        ],
    )
    def test_errors(self, scenes: SceneSet, options: dict[str, object], message: str) -> None:
        with pytest.raises(ConfigError, match=message):
            gaussian(scenes, **options)


class TestLatentSampler:
    def test_moments_in_training(self) -> None:
        torch.manual_seed(0)
        loc, scale = torch.tensor([1.0, -2.0]), torch.tensor([0.5, 2.0])
        draws = LatentSampler()(loc.expand(20_000, 2), scale.expand(20_000, 2))
        torch.testing.assert_close(draws.mean(0), loc, atol=0.05, rtol=0)
        torch.testing.assert_close(draws.std(0), scale, atol=0.05, rtol=0)

    def test_by_hand(self, monkeypatch: pytest.MonkeyPatch) -> None:
        sampler = LatentSampler()
        monkeypatch.setattr(sampler, "noise", lambda loc: torch.tensor([2.0, -1.0]))
        assert sampler(torch.tensor([1.0, 1.0]), torch.tensor([3.0, 0.5])).tolist() == [7.0, 0.5]

    def test_the_gradient_reaches_mean_and_scale(self) -> None:
        loc, scale = torch.zeros(4, requires_grad=True), torch.ones(4, requires_grad=True)
        z = LatentSampler()(loc, scale)
        z.sum().backward()
        assert loc.grad.tolist() == [1.0] * 4
        torch.testing.assert_close(scale.grad, z.detach())  # with mean 0 and scale 1, z is the noise

    def test_evaluation(self) -> None:
        loc, scale = torch.zeros(4), torch.ones(4)
        assert LatentSampler().eval()(loc, scale) is loc
        assert LatentSampler("sample").eval()(loc, scale).any()
        with pytest.raises(ConfigError, match="eval_latent is 'median'"):
            LatentSampler("median")


def test_actions_do_not_depend_on_how_the_latent_is_read() -> None:
    """Only omega reads z_g, and no policy reads omega: mean and sampled latents walk alike."""

    rooms = SceneSet.bundled(["bathroom"])
    logits, values = [], []
    for latent in ("mean", "sample"):
        torch.manual_seed(0)
        agent = make_agent("vusfa", scenes=rooms, history=1, hidden_size=16, eval_latent=latent).eval()
        rows = {"state_id": torch.arange(176).unsqueeze(-1), "goal_id": torch.arange(176).flip(0)}
        inputs = TensorDict({**rows, "scene_id": torch.zeros(176, dtype=torch.int64)}, [176])
        logits.append(agent.get_policy_operator().get_dist(inputs.clone()).logits)
        values.append(agent.get_value_operator()(inputs.clone())["state_value"])
    assert torch.equal(*logits)
    assert not torch.equal(*values)
