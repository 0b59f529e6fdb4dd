"""What actor and critic share runs once; what they do not, does not matter."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictSequential,
    WrapModule,
)
from tensordict.nn import TensorDictModule as Mod
from torch import nn
from torchrl.modules import ActorValueOperator, ProbabilisticActor, ValueOperator

from vusfa.objectives.networks import flatten, run_actor_critic, run_critic, select_inputs


def run(
    actor: nn.Module, critic: nn.Module, td: TensorDict
) -> tuple[torch.distributions.Distribution, TensorDict]:
    return run_actor_critic(actor, critic, select_inputs(td, *actor.in_keys, *critic.in_keys))


class TestSharing:
    def test_each_module_once(self, usf, rollout) -> None:
        networks = usf()
        networks.count()
        td = rollout(2, 3)
        before = set(td.keys(True))
        run(networks.actor, networks.critic, td)
        assert set(networks.calls.values()) == {1}
        assert set(td.keys(True)) == before

    def test_results_are_those_of_two_passes(self, usf, plain, rollout) -> None:
        for networks in (usf(variational=False), plain()):
            td = rollout(2, 3)
            dist, written = run(networks.actor, networks.critic, td)
            torch.testing.assert_close(dist.logits, networks.actor.get_dist(td.clone()).logits)
            expected = networks.critic(td.clone())
            for key in networks.critic.out_keys:
                torch.testing.assert_close(written[key], expected[key])

    def test_torchrls_own_shared_trunk(self, rollout) -> None:
        calls = []
        trunk = Mod(nn.Linear(3, 4), in_keys=["observation"], out_keys=["hidden"])
        trunk.register_forward_hook(lambda *_: calls.append(1))
        policy = ProbabilisticActor(
            Mod(nn.Linear(4, 4), in_keys=["hidden"], out_keys=["logits"]),
            in_keys=["logits"],
            distribution_class=torch.distributions.Categorical,
        )
        both = ActorValueOperator(trunk, policy, ValueOperator(nn.Linear(4, 1), in_keys=["hidden"]))
        actor, critic, td = both.get_policy_operator(), both.get_value_operator(), rollout(2, 3)
        dist, written = run(actor, critic, td)
        assert len(calls) == 1
        torch.testing.assert_close(dist.logits, actor.get_dist(td.clone()).logits)
        torch.testing.assert_close(written["state_value"], critic(td.clone())["state_value"])

    def test_the_same_module_on_other_tensors_runs_again(self) -> None:
        """One module object, on the state and then on what became of its own output."""
        inner = nn.Linear(3, 3)
        encoder = Mod(inner, in_keys=["x"], out_keys=["y"])
        actor = ProbabilisticTensorDictSequential(
            encoder,
            Mod(nn.Identity(), in_keys=["y"], out_keys=["logits"]),
            ProbabilisticTensorDictModule(
                ["logits"], ["action"], distribution_class=torch.distributions.Categorical
            ),
        )
        again = Mod(nn.Identity(), in_keys=["y"], out_keys=["x"])
        critic = TensorDictSequential(encoder, again, encoder)
        x = torch.randn(2, 3)
        dist, written = run(actor, critic, TensorDict({"x": x}, [2]))
        torch.testing.assert_close(written["y"], inner(inner(x)))
        torch.testing.assert_close(dist.logits, torch.distributions.Categorical(logits=inner(x)).logits)

    def test_an_entry_of_the_same_name_is_not_mistaken(self, rollout) -> None:
        """Both networks have a 'hidden' of their own."""
        mine = Mod(nn.Linear(3, 4), in_keys=["observation"], out_keys=["hidden"])
        theirs = Mod(nn.Linear(3, 4), in_keys=["observation"], out_keys=["hidden"])
        actor = ProbabilisticTensorDictSequential(
            mine,
            ProbabilisticTensorDictModule(
                ["hidden"], ["action"], distribution_class=lambda hidden: categorical(hidden)
            ),
        )
        head = Mod(nn.Linear(4, 1), in_keys=["hidden"], out_keys=["state_value"])
        td = rollout(2, 3)
        _, written = run(actor, TensorDictSequential(theirs, head), td)
        expected = head.module(theirs.module(td["observation"]))
        torch.testing.assert_close(written["state_value"], expected)

    def test_a_shared_sample_is_one_sample(self) -> None:
        noise = Mod(torch.rand_like, in_keys=["x"], out_keys=["z"])
        actor = ProbabilisticTensorDictSequential(
            noise,
            ProbabilisticTensorDictModule(["z"], ["action"], distribution_class=lambda z: categorical(z)),
        )
        dist, written = run(actor, TensorDictSequential(noise), TensorDict({"x": torch.zeros(2, 3)}, [2]))
        torch.testing.assert_close(dist.logits, categorical(written["z"]).logits)

    def test_lazy_stacks_share_too(self, usf, rollout) -> None:
        networks = usf()
        networks.count()
        run(networks.actor, networks.critic, TensorDict.lazy_stack([rollout(2, 3), rollout(2, 3, seed=1)]))
        assert networks.calls["encoder"] == 1

    def test_an_actor_built_otherwise_is_run_as_it_is(self, rollout) -> None:
        """Two distributions, one after the other: TorchRL samples the first and conditions the second."""
        first = Mod(nn.Linear(3, 4), in_keys=["observation"], out_keys=["logits"])
        second = Mod(lambda a: a.unsqueeze(-1) * torch.ones(4), in_keys=["a"], out_keys=["more"])
        categories = torch.distributions.Categorical
        actor = ProbabilisticTensorDictSequential(
            first,
            ProbabilisticTensorDictModule(["logits"], ["a"], distribution_class=categories),
            second,
            ProbabilisticTensorDictModule({"logits": "more"}, ["b"], distribution_class=categories),
        )
        dist, _ = run(actor, TensorDictSequential(first), rollout(2, 3))
        assert {"a", "b"} == set(dist.dists)


class TestFlatten:
    a = Mod(nn.Identity(), in_keys=["x"], out_keys=["y"])
    b = Mod(nn.Identity(), in_keys=["y"], out_keys=["z"])

    def test_nested_sequences(self) -> None:
        nested = TensorDictSequential(TensorDictSequential(self.a), TensorDictSequential(self.b, self.a))
        assert [id(m) for m in flatten(nested)] == [id(self.a), id(self.b), id(self.a)]
        assert flatten(self.a) == [self.a]

    @pytest.mark.parametrize("how", ["selected", "tolerant", "elsewhere", "hooked", "overridden"])
    def test_sequences_that_do_more_stay_whole(self, how: str) -> None:
        class Doubling(TensorDictSequential):
            def forward(self, tensordict: TensorDict) -> TensorDict:
                return super().forward(super().forward(tensordict))

        sequence = {
            "selected": lambda: TensorDictSequential(self.a, self.b).select_out_keys("z"),
            "tolerant": lambda: TensorDictSequential(self.a, self.b, partial_tolerant=True),
            "elsewhere": lambda: TensorDictSequential(self.a, self.b, inplace=False),
            "hooked": lambda: TensorDictSequential(self.a, self.b),
            "overridden": lambda: Doubling(self.a, self.b),
        }[how]()
        if how == "hooked":
            sequence.register_forward_hook(lambda *_: None)
        assert flatten(sequence) == [sequence]

    def test_functions_without_keys_are_always_run(self) -> None:
        calls = []

        def triple(td: TensorDict) -> TensorDict:
            calls.append(1)
            return td.set("x", 3 * td["x"])

        critic = TensorDictSequential(WrapModule(triple), self.a)
        written = run_critic(critic, TensorDict({"x": torch.ones(2)}, [2]))
        assert len(calls) == 1
        assert written["y"].tolist() == [3.0, 3.0]


def categorical(logits: torch.Tensor) -> torch.distributions.Categorical:
    return torch.distributions.Categorical(logits=logits)
