"""What TorchRL's generic tests ask of a loss module, of every loss but USFLoss."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from tensordict import NonTensorData, TensorDict
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential
from tensordict.nn import TensorDictModule as Mod
from tensordict.nn import TensorDictSequential as Seq
from torch import Tensor, nn
from torch.distributions import Categorical
from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type
from torchrl.objectives.common import LossModule

from vusfa.modules import make_agent
from vusfa.objectives import HindsightLoss, RewardRegressionLoss, SearchLoss, USFLoss
from vusfa.scenes import SceneSet

STATES, SIZE = 6, 4


class Product(nn.Module):
    def forward(self, phi: Tensor, omega: Tensor) -> Tensor:
        return (phi * omega).sum(-1, keepdim=True)


class Last(nn.Embedding):
    """Looks the last frame of a history up."""

    def forward(self, ids: Tensor) -> Tensor:
        return super().forward(ids[..., -1])


def networks(**names: Any) -> tuple[ProbabilisticTensorDictSequential, Seq]:
    """Actor and critic over one trunk; ``names`` renames their entries."""

    def key(name: str) -> Any:
        return names.get(name, name)

    trunk = Mod(Last(STATES, SIZE), in_keys=[key("state_id")], out_keys=[key("state_embedding")])
    goal = Mod(nn.Embedding(STATES, SIZE), in_keys=[key("goal_id")], out_keys=[key("reward_weights")])
    read = [key("state_embedding"), key("reward_weights")]
    value = Mod(Product(), in_keys=read, out_keys=[key("state_value")])
    policy = Mod(nn.Linear(SIZE, 3), in_keys=[key("state_embedding")], out_keys=["logits"])
    sampler = ProbabilisticTensorDictModule(["logits"], [key("action")], distribution_class=Categorical)
    return ProbabilisticTensorDictSequential(trunk, policy, sampler), Seq(trunk, goal, value)


def transitions(*batch: int, **names: Any) -> TensorDict:
    torch.manual_seed(2)
    entries = {
        "state_id": torch.randint(STATES, (*batch, 2)),
        "goal_id": torch.randint(STATES, batch),
        "action": torch.randint(3, batch),
        "steps_to_goal": torch.randint(4, batch),
        ("next", "state_id"): torch.randint(STATES, (*batch, 2)),
        ("next", "reward"): torch.randn(*batch, 1),
        "best_action": torch.rand(*batch, 3) < 0.5,
    }
    td = TensorDict({}, batch)
    for name, value in entries.items():
        nested = isinstance(name, tuple)
        renamed = names.get(name[1] if nested else name, name[1] if nested else name)
        td.set(("next", *((renamed,) if isinstance(renamed, str) else renamed)) if nested else renamed, value)
    return td


@dataclass
class Case:
    """One loss, its terms, and its coefficients."""

    make: Callable[..., LossModule]
    terms: list[str]
    coefficients: list[str]
    diagnostics: tuple[str, ...] = ()


CASES = {
    "hindsight": Case(
        HindsightLoss,
        ["loss_hindsight_critic", "loss_hindsight_objective"],
        ["critic_coeff", "objective_coeff"],
        ("hindsight_value", "hindsight_advantage"),
    ),
    "search": Case(
        SearchLoss,
        ["loss_search_critic", "loss_search_objective"],
        ["critic_coeff", "objective_coeff"],
        ("search_accuracy",),
    ),
    "reward": Case(
        lambda actor, critic, **kwargs: RewardRegressionLoss(critic, **kwargs),
        ["loss_reward"],
        ["reward_coeff"],
    ),
}
MODES = pytest.mark.parametrize("functional", [True, False])


@pytest.fixture(params=CASES)
def case(request: pytest.FixtureRequest) -> Case:
    return CASES[request.param]


def make(case: Case, names: dict[str, Any] | None = None, **kwargs: Any) -> LossModule:
    torch.manual_seed(0)
    return case.make(*networks(**names or {}), **kwargs)


def total(losses: TensorDict) -> Tensor:
    return sum(value.sum() for key, value in losses.items() if key.startswith("loss_"))


@MODES
def test_functional_or_not_is_the_same(case: Case, functional: bool) -> None:
    loss = make(case, functional=functional)
    assert loss.functional is functional
    params = loss.critic_network_params
    assert (params is not None) is functional
    for key, value in loss(transitions(7)).items():
        torch.testing.assert_close(value, make(case)(transitions(7))[key])
    net = loss.get_stateful_net("critic_network")
    torch.testing.assert_close(
        net(transitions(7))["state_value"], networks_value(loss, transitions(7)), rtol=0, atol=0
    )


def networks_value(loss: LossModule, td: TensorDict) -> Tensor:
    if loss.functional:
        with loss.critic_network_params.to_module(loss.critic_network, preserve_module_state=False):
            return loss.critic_network(td)["state_value"]
    return loss.critic_network(td)["state_value"]


def test_parameters_that_a_functional_loss_holds_are_those_it_runs_with(case: Case) -> None:
    loss = make(case)
    before = loss(transitions(7))
    loss.critic_network_params.data.mul_(0.5)
    after = loss(transitions(7))
    assert all((before[key] != after[key]).all() for key in case.terms)


def test_target_parameters_are_the_parameters_detached(case: Case) -> None:
    loss = make(case)
    targets = loss.target_critic_network_params
    for key, value in loss.critic_network_params.items(True, True):
        assert targets.get(key).data_ptr() == value.data_ptr()
        assert not targets.get(key).requires_grad


@MODES
def test_state_dict(case: Case, functional: bool) -> None:
    loss, other = make(case, functional=functional), case.make(*networks(), functional=functional)
    for name in case.coefficients:
        setattr(loss, name, 0.25)
    state = loss.state_dict()
    assert set(case.coefficients) <= set(state)
    other.load_state_dict(state)
    for key, value in loss(transitions(7)).items():
        torch.testing.assert_close(other(transitions(7))[key], value)


def test_coefficients(case: Case) -> None:
    """Each multiplies its term, is set by assignment, and leaves it out as None, where there are others."""
    ones = make(case, **dict.fromkeys(case.coefficients, 1.0))(transitions(7))
    for name, term in zip(case.coefficients, case.terms, strict=True):
        loss = make(case, **dict.fromkeys(case.coefficients, 1.0))
        setattr(loss, name, 3)
        torch.testing.assert_close(loss(transitions(7))[term], 3 * ones[term])
        whole = make(case, **{name: 2})
        setattr(whole, name, 0.5)
        assert getattr(whole, name).item() == 0.5
        with pytest.raises(ValueError, match=f"{name} must be a float"):
            make(case, **{name: "high"})
        if len(case.terms) > 1:
            loss = make(case, **{name: None})
            assert term not in loss.out_keys
            assert set(loss(transitions(7)).keys()) == set(loss.out_keys)


@MODES
@pytest.mark.parametrize("reduction", [None, "none", "mean", "sum"])
@pytest.mark.parametrize("batch", [(7,), (3, 4), (2, 3, 2)])
def test_reduction_and_batch_shapes(
    case: Case, reduction: str | None, functional: bool, batch: tuple[int, ...]
) -> None:
    td = transitions(*batch)
    before = td.clone()
    losses = make(case, reduction=reduction, functional=functional)(td)
    assert losses.batch_size == ()
    for key in case.terms:
        assert losses[key].shape == (batch if reduction == "none" else ())
        assert losses[key].isfinite().all()
    if reduction in ("none", "sum"):
        summed = make(case, reduction="sum")(td)
        for key in case.terms:
            torch.testing.assert_close(losses[key].sum(), summed[key])
    assert not any(losses[key].requires_grad for key in case.diagnostics)
    total(losses).backward()
    assert set(td.keys(True)) == set(before.keys(True))
    assert bool((td == before).all())


def test_an_unknown_reduction_is_refused(case: Case) -> None:
    with pytest.raises(ValueError, match="reduction is 'product'; give one of"):
        make(case, reduction="product")


@pytest.mark.parametrize("mask_key", ["auto", ("my", "valid")])
@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
def test_what_a_mask_hides_does_not_count(case: Case, reduction: str, mask_key: Any) -> None:
    td = transitions(8)
    valid = torch.tensor([True] * 5 + [False] * 3)
    padded = td.clone()
    padded[("collector", "mask") if mask_key == "auto" else mask_key] = valid.unsqueeze(-1)
    padded["next", "reward"][5:] = torch.nan
    loss = make(case, reduction=reduction)
    loss.loss_mask_key = mask_key
    losses, expected = loss(padded), make(case, reduction=reduction)(td[:5])
    for key in (*case.terms, *case.diagnostics):
        value = losses[key]
        if value.ndim:
            assert not value[5:].any()
            value = value[:5]
        torch.testing.assert_close(value, expected[key])
    total(losses).backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in loss.parameters())


def test_a_batch_of_which_nothing_counts_gives_zero() -> None:
    td = transitions(4)
    td["goal_id"] = td["state_id"][:, -1]
    td["steps_to_goal"] = torch.zeros_like(td["steps_to_goal"])
    for name in ("hindsight", "search"):
        losses = make(CASES[name])(td)
        assert not any(bool(value) for value in losses.values())
        total(losses).backward()


RENAMED = {
    "state_id": ("agent", "state"),
    "goal_id": "target",
    "action": ("agent", "action"),
    "steps_to_goal": "way",
    "best_action": ("search", "best"),
    "reward": "payment",
    "state_embedding": "phi",
    "reward_weights": ("head", "omega"),
    "state_value": ("head", "v"),
}
KEYS = {
    "hindsight": {
        "state": RENAMED["state_id"],
        "goal": "target",
        "steps_to_goal": "way",
        "value": ("head", "v"),
    },
    "search": {"best_action": ("search", "best"), "steps_to_goal": "way", "value": ("head", "v")},
    "reward": {"reward": "payment", "state_embedding": "phi", "reward_weights": ("head", "omega")},
}


@MODES
@pytest.mark.parametrize("name", CASES)
def test_every_entry_can_be_renamed(name: str, functional: bool) -> None:
    case = CASES[name]
    loss = make(case, RENAMED, functional=functional)
    loss.set_keys(**KEYS[name])
    td, expected = transitions(7, **RENAMED), make(case)(transitions(7))
    for key, value in loss(td).items():
        torch.testing.assert_close(value, expected[key])
    torch.testing.assert_close(
        loss(td.select(*loss.in_keys, strict=False))[case.terms[0]], expected[case.terms[0]]
    )
    loss.set_keys(**dict.fromkeys(KEYS[name]))
    assert loss.tensor_keys == type(loss.tensor_keys)(
        **({"action": RENAMED["action"]} if name == "hindsight" else {})
    )
    with pytest.raises(ValueError, match="unknown is not an accepted"):
        loss.set_keys(unknown="x")


def test_misspelt_entries_are_named(case: Case) -> None:
    """A critic that writes the entry under another name, and no set_keys."""
    key = "state_value" if case.make in (HindsightLoss, SearchLoss) else "reward_weights"
    with pytest.raises(ValueError, match=rf"the critic writes no '{key}', but .*set_keys"):
        make(case, {key: key[:-1]})(transitions(3))


def test_a_state_that_the_critic_does_not_read_is_named() -> None:
    """Else the next value would be this state's, without a word."""
    loss = make(CASES["hindsight"])
    loss.set_keys(state="observation")
    with pytest.raises(ValueError, match=r"does not read 'observation'.*set_keys\(state="):
        loss(transitions(3))


@pytest.mark.parametrize(
    ("name", "missing", "message"),
    [
        ("hindsight", "steps_to_goal", r"no 'steps_to_goal'.*HindsightReplay"),
        ("hindsight", "action", "no 'action'"),
        ("hindsight", "goal_id", "no 'goal_id'"),
        ("hindsight", ("next", "state_id"), r"no \('next', 'state_id'\).*compact_obs=False"),
        ("search", "steps_to_goal", "no 'steps_to_goal'"),
        ("search", "best_action", "no 'best_action'"),
        ("reward", ("next", "reward"), r"no \('next', 'reward'\)"),
        ("reward", ("next", "state_id"), "none of .*compact_obs=False"),
        ("reward", "goal_id", "no 'goal_id'"),
        ("reward", "next", "no 'next'"),
    ],
)
def test_missing_entries_are_named(name: str, missing: Any, message: str) -> None:
    with pytest.raises(KeyError, match=message):
        make(CASES[name])(transitions(3).exclude(missing))


@pytest.mark.parametrize("name", ["goal_id", "steps_to_goal", "reward"])
def test_shapes_are_not_broadcast(name: str) -> None:
    td = transitions(3)
    if name == "reward":
        td["next", "reward"] = td["next", "reward"].expand(3, 3)
    else:
        td[name] = td[name].unsqueeze(-1)
    with pytest.raises(ValueError, match="shapes differ"):
        make(CASES["reward" if name == "reward" else "hindsight"])(td)


def test_without_a_tensordict(case: Case) -> None:
    loss, td = make(case), transitions(7)
    arguments = {
        ("_".join(key) if isinstance(key, tuple) else key): td.get(key, None) for key in loss.in_keys
    }
    arguments = {key: value for key, value in arguments.items() if value is not None}
    expected = loss(td)
    results = loss(**arguments)
    results = [results] if isinstance(results, Tensor) else results
    for key, value in zip(loss.out_keys, results, strict=True):
        torch.testing.assert_close(value, expected[key])
    loss.select_out_keys(case.terms[0])
    assert loss.out_keys == case.terms[:1]
    torch.testing.assert_close(loss(**arguments), expected[case.terms[0]])
    loss.reset_out_keys()
    assert loss.out_keys == [*case.terms, *case.diagnostics]


def test_in_keys_and_out_keys_can_be_set(case: Case) -> None:
    loss = make(case)
    assert loss(transitions(3).select(*loss.in_keys, strict=False)).keys() == set(loss.out_keys)
    loss.in_keys, loss.out_keys = ["state_id"], [case.terms[0]]
    assert (loss.in_keys, loss.out_keys) == (["state_id"], [case.terms[0]])


def test_lazy_stacks_and_entries_that_are_no_tensors(case: Case) -> None:
    loss, td = make(case), transitions(2, 3)
    expected = loss(td)
    stacked = TensorDict.lazy_stack([td[0].clone(), td[1].clone()])
    noted = td.clone().set("note", NonTensorData("by hand", batch_size=[2, 3]))
    for batch in (stacked, noted):
        for key, value in loss(batch).items():
            torch.testing.assert_close(value, expected[key])


@MODES
def test_copies_and_pickles_are_whole_and_apart(case: Case, functional: bool) -> None:
    loss = make(case, functional=functional)
    expected = loss(transitions(7))
    twins = [copy.deepcopy(loss), pickle.loads(pickle.dumps(loss))]
    for parameter in loss.parameters():
        parameter.data.zero_()
    for twin in twins:
        for key, value in twin(transitions(7)).items():
            torch.testing.assert_close(value, expected[key])


def test_moves_to_another_precision(case: Case) -> None:
    loss = make(case).to(torch.double)
    assert all(p.dtype == torch.double for p in loss.parameters())
    assert all(getattr(loss, name).dtype == torch.double for name in case.coefficients)
    td = transitions(7)
    td["next", "reward"] = td["next", "reward"].double()
    total(loss(td)).backward()


def test_exploration_is_off_inside_and_restored_after(case: Case) -> None:
    loss, seen = make(case, functional=False), []
    loss.critic_network.module[0].register_forward_hook(lambda *_: seen.append(exploration_type()))
    with set_exploration_type(ExplorationType.RANDOM):
        loss(transitions(3))
        assert exploration_type() is ExplorationType.RANDOM
    assert set(seen) == {ExplorationType.DETERMINISTIC}


def test_reset_parameters_recursive(case: Case) -> None:
    loss = make(case)
    with torch.no_grad():
        for parameter in loss.parameters():
            parameter += 1000.0
    loss.reset_parameters_recursive()
    assert all(parameter.abs().max() < 100 for parameter in loss.parameters())


def test_vmap_randomness_can_be_asked(case: Case) -> None:
    assert make(case).vmap_randomness == "error"


class TestWrongNetworks:
    """An agent in the place of its actor or critic, networks in the wrong order, and None."""

    @pytest.fixture
    def agent(self) -> nn.Module:
        return make_agent("usfa", scenes=SceneSet.bundled(["bathroom"]), hidden_size=8, embedding_size=8)

    @pytest.mark.parametrize("make", [USFLoss, HindsightLoss])
    def test_an_actor_and_a_critic_are_asked_for(self, make: Any, agent: Any) -> None:
        with pytest.raises(TypeError, match=r"actor_network is of class Agent.*get_policy_operator\(\)"):
            make(agent, agent)
        with pytest.raises(TypeError, match=r"critic_network is of class Agent.*get_value_operator\(\)"):
            make(agent.get_policy_operator(), agent)
        with pytest.raises(TypeError, match=r"actor_network is of class TensorDictSequential.*get_dist"):
            make(agent.get_value_operator(), agent.get_policy_operator())
        with pytest.raises(TypeError, match="critic_network is of class NoneType"):
            make(agent.get_policy_operator(), None)

    def test_a_critic_is_asked_for(self, agent: Any) -> None:
        with pytest.raises(TypeError, match=r"critic_network is of class Agent.*get_value_operator\(\)"):
            RewardRegressionLoss(agent)


class Interrupting(nn.Module):
    """A layer in which a signal arrives."""

    def __init__(self, error: type[BaseException]) -> None:
        super().__init__()
        self.weight, self.error = nn.Parameter(torch.ones(1)), error

    def forward(self, x: Tensor) -> Tensor:
        raise self.error


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit, ZeroDivisionError])
@pytest.mark.parametrize("kind", ["usf", "estimator", "hindsight", "reward"])
def test_what_ends_a_forward_pass_comes_out_as_it_was(kind: str, error: type[BaseException]) -> None:
    """... and the networks have their own parameters again."""
    actor, critic = networks()
    interrupted = Mod(Interrupting(error), in_keys=["state_embedding"], out_keys=["successor_features"])
    critic = Seq(critic.module[0], interrupted, *critic.module[1:])
    td = transitions(2, 3)
    td["next", "done"] = torch.zeros(2, 3, 1, dtype=torch.bool)
    if kind == "reward":
        critic = Seq(
            interrupted.__class__(Interrupting(error), ["state_id"], ["reward_weights"]), critic.module[0]
        )
        loss: LossModule = RewardRegressionLoss(critic)
    elif kind == "hindsight":
        loss = HindsightLoss(actor, critic)
    else:
        loss = USFLoss(actor, critic)
    before = dict(critic.named_parameters())
    replaced = loss.critic_network_params.clone()
    with pytest.raises(error):
        loss.value_estimator(td, params=replaced) if kind == "estimator" else loss(td)
    assert all(parameter is before[name] for name, parameter in critic.named_parameters())
