"""USFLoss does what it says, number by number and term by term."""

from __future__ import annotations

import math
from typing import ClassVar

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import (
    CompositeDistribution,
    NormalParamExtractor,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    set_composite_lp_aggregate,
)
from tensordict.nn import TensorDictModule as Mod
from tensordict.nn import TensorDictSequential as Seq
from torch import nn
from torchrl.modules import ProbabilisticActor, TanhNormal

from vusfa.objectives import USFEstimator, USFLoss

TERMS = ["loss_objective", "loss_critic", "loss_entropy", "loss_successor", "loss_bottleneck"]
DIAGNOSTICS = ["entropy", "explained_variance", "kl", "beta"]
MODES = pytest.mark.parametrize("functional", [True, False])


def total(losses: TensorDict) -> torch.Tensor:
    return sum(value.sum() for key, value in losses.items() if key.startswith("loss"))


class Constant(nn.Module):
    """Writes given tensors, whatever it reads."""

    def __init__(self, *values: torch.Tensor) -> None:
        super().__init__()
        self.values = nn.ParameterList(values)

    def forward(self, _: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return tuple(self.values)


class TestNumbers:
    """Two steps whose every entry is given."""

    def networks(self) -> tuple[ProbabilisticActor, Mod]:
        policy = Mod(
            Constant(torch.tensor([[0.0, 0.0], [0.0, math.log(3)]])), in_keys=["x"], out_keys=["logits"]
        )
        actor = ProbabilisticActor(
            policy,
            in_keys=["logits"],
            distribution_class=torch.distributions.Categorical,
            return_log_prob=True,
        )
        outputs = {
            "state_value": [[1.0], [3.0]],
            "successor_features": [[1.0, 2.0], [0.0, 0.0]],
            "state_embedding": [[0.0, 0.0], [0.0, 0.0]],
            "state_loc": [[1.0, 0.0], [0.0, 0.0]],
            "state_scale": [[1.0, 1.0], [1.0, 1.0]],
            "goal_loc": [[2.0, 0.0], [2.0, 2.0]],
            "goal_scale": [[1.0, -1.0], [1.0, 1.0]],
        }
        critic = Mod(Constant(*map(torch.tensor, outputs.values())), in_keys=["x"], out_keys=list(outputs))
        return actor, critic

    data = TensorDict(
        {
            "x": torch.zeros(2, 1),
            "action": torch.tensor([0, 1]),
            "advantage": torch.tensor([[2.0], [-4.0]]),
            "value_target": torch.tensor([[2.0], [1.0]]),
            "successor_target": torch.tensor([[0.0, 5.0], [1.0, 1.0]]),
        },
        [2],
    )
    half, three_quarters = math.log(2), -math.log(0.75)
    entropies = (math.log(2), 0.75 * three_quarters + 0.25 * math.log(4))
    # -log pi(a) A; (G - V)^2; -H; the mean of (target - psi)^2; the state has KL (0.25, 0), the goal (1, 2)
    per_step: ClassVar = {
        "loss_objective": (half * 2, three_quarters * -4),
        "loss_critic": (1.0, 4.0),
        "loss_entropy": (-entropies[0], -entropies[1]),
        "loss_successor": ((1 + 9) / 2, 1.0),
    }

    def loss(self, **kwargs: object) -> USFLoss:
        coefficients = dict.fromkeys(
            ("objective_coeff", "critic_coeff", "successor_coeff", "entropy_coeff"), 1.0
        )
        return USFLoss(*self.networks(), **{**coefficients, "bottleneck_coeff": 1.0, **kwargs})

    def test_per_step(self) -> None:
        losses = self.loss(reduction="none", information_target=0.5)(self.data)
        for key, values in self.per_step.items():
            torch.testing.assert_close(losses[key], torch.tensor(values))
        torch.testing.assert_close(losses["loss_bottleneck"], torch.tensor([0.625 - 0.5, 1.0 - 0.5]))

    @pytest.mark.parametrize("reduction", ["mean", "sum"])
    def test_reduced(self, reduction: str) -> None:
        losses = self.loss(reduction=reduction)(self.data)
        for key, values in self.per_step.items():
            expected = sum(values) / (2 if reduction == "mean" else 1)
            assert losses[key].item() == pytest.approx(expected)

    def test_coefficients(self) -> None:
        coefficients = {
            "objective_coeff": 5.0,
            "critic_coeff": 0.25,
            "entropy_coeff": 0.1,
            "successor_coeff": 3.0,
            "bottleneck_coeff": 2.0,
        }
        ones, weighted = self.loss()(self.data), self.loss(**coefficients)(self.data)
        for term, coefficient in zip(TERMS, coefficients.values(), strict=True):
            torch.testing.assert_close(weighted[term], coefficient * ones[term])

    @pytest.mark.parametrize(
        ("options", "kl"),
        [
            ({"bottleneck_on": "both"}, 0.8125),
            ({"bottleneck_on": "state"}, 0.125),
            ({"bottleneck_on": "goal"}, 1.5),
        ],
    )
    def test_information(self, options: dict[str, str], kl: float) -> None:
        losses = self.loss(bottleneck_coeff=0.5, information_target=0.2, **options)(self.data)
        assert losses["kl"].item() == pytest.approx(kl)
        assert losses["loss_bottleneck"].item() == pytest.approx(0.5 * (kl - 0.2))

    def test_diagnostics(self) -> None:
        loss = self.loss(bottleneck_coeff=0.3, entropy_coeff=0.0)
        losses = loss(self.data)
        assert losses["entropy"].item() == pytest.approx(sum(self.entropies) / 2)
        assert losses["beta"].item() == pytest.approx(0.3)
        # targets 2 and 1 vary by 1/4, the errors 1 and -2 by 9/4
        assert losses["explained_variance"].item() == pytest.approx(1 - 9)
        assert not any(losses[key].requires_grad for key in DIAGNOSTICS)
        assert loss.last_kl.item() == losses["kl"].item()
        assert not loss.last_kl.requires_grad

    def test_terms_as_methods(self) -> None:
        loss = self.loss(reduction="none", information_target=0.5)
        losses = loss(self.data)
        torch.testing.assert_close(loss.loss_objective(self.data), losses["loss_objective"])
        torch.testing.assert_close(loss.loss_successor(self.data), losses["loss_successor"])
        term, explained = loss.loss_critic(self.data)
        torch.testing.assert_close(term, losses["loss_critic"])
        torch.testing.assert_close(explained, losses["explained_variance"])
        term, entropy = loss.loss_entropy(self.data)
        torch.testing.assert_close(term, losses["loss_entropy"])
        torch.testing.assert_close(entropy, torch.tensor(self.entropies))
        term, kl = loss.loss_bottleneck(self.data)
        torch.testing.assert_close(term, losses["loss_bottleneck"])
        torch.testing.assert_close(kl, torch.tensor([0.625, 1.0]))

    def test_what_a_mask_hides_does_not_count(self) -> None:
        padded = torch.cat([self.data, self.data[:1].clone()])
        padded["advantage"][2] = math.nan
        padded["value_target"][2] = math.inf
        padded["collector", "mask"] = torch.tensor([True, True, False])
        actor, critic = self.networks()
        for network in (actor, critic):
            for i, parameter in enumerate(
                values := network.get_submodule("module" if network is critic else "module.0.module").values
            ):
                values[i] = nn.Parameter(
                    torch.cat([parameter.data, torch.full_like(parameter.data[:1], 7.0)])
                )
        masked, plain = USFLoss(actor, critic)(padded), USFLoss(*self.networks())(self.data)
        for key in TERMS + DIAGNOSTICS:
            torch.testing.assert_close(masked[key], plain[key])
        total(masked).backward()
        assert all(
            p.grad is None or p.grad.isfinite().all() for p in (*actor.parameters(), *critic.parameters())
        )


class TestTerms:
    def test_present_as_far_as_the_critic_writes_them(self, usf, plain, rollout) -> None:
        expected = {
            "variational": TERMS + DIAGNOSTICS,
            "successor": [*TERMS[:4], *DIAGNOSTICS[:2]],
            "plain": [*TERMS[:3], *DIAGNOSTICS[:2]],
        }
        networks = {"variational": usf(), "successor": usf(variational=False), "plain": plain()}
        for name, keys in expected.items():
            loss = USFLoss(networks[name].actor, networks[name].critic)
            assert loss.out_keys == keys
            assert set(loss(rollout(2, 3)).keys()) == set(keys)

    @pytest.mark.parametrize(
        ("coefficient", "absent"),
        [
            ("objective_coeff", {"loss_objective"}),
            ("critic_coeff", {"loss_critic", "explained_variance"}),
            ("entropy_coeff", {"loss_entropy", "entropy"}),
            ("successor_coeff", {"loss_successor"}),
            ("bottleneck_coeff", {"loss_bottleneck", "kl", "beta"}),
        ],
    )
    def test_absent_where_the_coefficient_is_none(
        self, usf, rollout, coefficient: str, absent: set[str]
    ) -> None:
        networks = usf()
        loss = USFLoss(networks.actor, networks.critic, **{coefficient: None})
        assert set(loss.out_keys) == set(TERMS + DIAGNOSTICS) - absent
        assert set(loss(rollout(2, 3)).keys()) == set(loss.out_keys)

    def test_one_branch_is_enough(self, usf) -> None:
        networks = usf()
        critic = networks.critic.select_out_keys("state_value", "goal_loc", "goal_scale")
        assert USFLoss(networks.actor, critic).has_bottleneck
        assert not USFLoss(networks.actor, critic, bottleneck_on="state").has_bottleneck
        assert not USFLoss(networks.actor, critic).has_successor

    @MODES
    @pytest.mark.parametrize(
        ("term", "reached"),
        [
            ("loss_objective", {"encoder", "policy"}),
            ("loss_entropy", {"encoder", "policy"}),
            ("loss_critic", {"encoder", "goal", "psi", "omega"}),
            ("loss_successor", {"encoder", "psi"}),
            ("loss_bottleneck", {"encoder", "goal"}),
        ],
    )
    def test_what_each_gradient_reaches(
        self, usf, rollout, functional: bool, term: str, reached: set[str]
    ) -> None:
        """No policy gradient in psi; the value's in psi, omega and the trunk; targets are constants."""
        networks = usf()
        loss = USFLoss(networks.actor, networks.critic, functional=functional, bottleneck_coeff=1.0)
        loss(rollout(4, 5))[term].backward()
        moved = {
            name
            for name, part in networks.parts.items()
            if any(p.grad is not None and p.grad.abs().sum() > 0 for p in part.parameters())
        }
        assert moved == reached

    def test_the_gradient_is_that_of_the_loss_with_constant_targets(self, usf, rollout) -> None:
        """Computed inside or before, targets contribute nothing to the gradient."""
        networks = usf(variational=False)
        td = rollout(4, 5)
        loss = USFLoss(networks.actor, networks.critic)
        total(loss(td)).backward()
        inside = {name: p.grad.clone() for name, p in loss.named_parameters() if p.grad is not None}
        loss.zero_grad()
        total(loss(USFEstimator(value_network=networks.critic)(td))).backward()
        for name, parameter in loss.named_parameters():
            if parameter.grad is not None:
                torch.testing.assert_close(parameter.grad, inside[name])

    def test_shared_modules_run_once_beside_the_estimator(self, usf, rollout) -> None:
        networks = usf()
        networks.count()
        loss = USFLoss(networks.actor, networks.critic)
        loss(rollout(4, 5))
        # once for the targets, once for the loss; the policy has no part in the targets
        assert networks.calls == {name: 1 if name == "policy" else 2 for name in networks.parts}


def continuous(composite: bool = False) -> tuple[ProbabilisticTensorDictSequential, Mod]:
    """An actor of continuous actions, or of a continuous and a discrete one together."""
    body = Mod(
        nn.Sequential(nn.Linear(3, 4), NormalParamExtractor()),
        in_keys=["observation"],
        out_keys=[("params", "move", "loc"), ("params", "move", "scale")] if composite else ["loc", "scale"],
    )
    if not composite:
        last = ProbabilisticTensorDictModule(
            ["loc", "scale"], ["action"], distribution_class=TanhNormal, return_log_prob=True
        )
        return ProbabilisticTensorDictSequential(body, last), value_head()
    grip = Mod(nn.Linear(3, 2), in_keys=["observation"], out_keys=[("params", "grip", "logits")])
    with set_composite_lp_aggregate(False):
        last = ProbabilisticTensorDictModule(
            ["params"],
            [("act", "move"), ("act", "grip")],
            distribution_class=CompositeDistribution,
            distribution_kwargs={
                "distribution_map": {"move": TanhNormal, "grip": torch.distributions.Categorical},
                "name_map": {"move": ("act", "move"), "grip": ("act", "grip")},
            },
            return_log_prob=True,
        )
        return ProbabilisticTensorDictSequential(body, grip, last), value_head()


def value_head() -> Mod:
    return Mod(nn.Linear(3, 1), in_keys=["observation"], out_keys=["state_value"])


def continuous_rollout() -> TensorDict:
    no = torch.zeros(4, 5, 1, dtype=torch.bool)
    observation = torch.randn(4, 6, 3)
    following = {
        "observation": observation[:, 1:],
        "reward": torch.randn(4, 5, 1),
        "done": no,
        "terminated": no,
    }
    move, grip = torch.rand(4, 5, 2) - 0.5, torch.randint(2, (4, 5))
    return TensorDict(
        {
            "observation": observation[:, :-1],
            "action": move,
            "act": {"move": move, "grip": grip},
            "next": following,
        },
        [4, 5],
    )


class TestOtherActions:
    @MODES
    @pytest.mark.parametrize("composite", [False, True])
    def test_continuous_and_composite(self, functional: bool, composite: bool) -> None:
        actor, critic = continuous(composite)
        td = continuous_rollout()
        with set_composite_lp_aggregate(False):
            loss = USFLoss(actor, critic, functional=functional, reduction="none")
        losses = loss(td)
        dist = actor.get_dist(td.clone())
        if composite:
            parts = dist.dists
            log_prob = sum(parts[name].log_prob(td[name]) for name in (("act", "move"), ("act", "grip")))
        else:
            log_prob = dist.log_prob(td["action"])
        targets = USFEstimator(value_network=critic)(td.clone())
        torch.testing.assert_close(losses["loss_objective"], -log_prob * targets["advantage"].squeeze(-1))
        assert losses["loss_entropy"].shape == td.shape
        assert losses["entropy"].isfinite()
        total(losses).backward()
        assert all(p.grad is not None and p.grad.isfinite().all() for p in loss.parameters())

    def test_an_action_that_requires_grad_is_refused(self) -> None:
        networks = continuous()
        td = continuous_rollout()
        td["action"].requires_grad_()
        with pytest.raises(RuntimeError, match="tensordict stored action requires grad"):
            USFLoss(*networks)(td)


class TestKnownDivergence:
    def test_what_the_critic_writes_is_taken(self, usf, rollout) -> None:
        """A critic that writes the divergences itself: the same term, and no mean or scale is looked at."""
        networks, td = usf(), rollout(2, 4)

        def divergence(loc: torch.Tensor, scale: torch.Tensor) -> torch.Tensor:
            nats = 0.5 * (loc**2 + scale**2 - (scale**2 + 1e-8).log() - 1)
            return nats.sum(-1, keepdim=True)

        extra = [
            Mod(divergence, in_keys=[f"{name}_loc", f"{name}_scale"], out_keys=[f"{name}_kl"])
            for name in ("state", "goal")
        ]
        options = {"bottleneck_coeff": 0.5}
        plain = USFLoss(networks.actor, networks.critic, **options)(td)
        known = USFLoss(networks.actor, Seq(networks.critic, *extra), **options)(td)
        torch.testing.assert_close(known["kl"], plain["kl"])
        torch.testing.assert_close(known["loss_bottleneck"], plain["loss_bottleneck"])
        extra[0].module = lambda loc, scale: torch.full((*loc.shape[:-1], 1), 7.0)
        other = USFLoss(networks.actor, Seq(networks.critic, *extra), **options)(td)
        assert (other["kl"] - plain["kl"]).abs() > 0.1


class TestOnePass:
    def test_targets_come_from_the_losss_own_pass(self, usf, rollout) -> None:
        """With no noise in the critic: the terms of targets computed first, and fewer states evaluated."""
        networks, td = usf(variational=False), rollout(3, 5)
        loss = USFLoss(networks.actor, networks.critic)
        loss.make_value_estimator(gamma=0.9)
        sizes: list[int] = []
        loss.critic_network.register_forward_hook(lambda module, args, out: sizes.append(args[0].numel()))
        first = loss(loss.value_estimator(td.copy(), params=loss.critic_network_params))
        once = loss(td)
        ends = 3 + int(td["next", "done"][:, :-1].sum())
        assert sizes == [15 + ends, 15, 15, ends]
        for key in first.keys():
            torch.testing.assert_close(once[key], first[key])
