"""The entries of USFLoss under any name, and the estimators that it works with."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule as Mod
from tensordict.nn import (
    TensorDictSequential,
)
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import ValueEstimators
from torchrl.objectives.value import GAE, VTrace

from vusfa.objectives import USFEstimator, USFLoss

TERMS = ["loss_objective", "loss_critic", "loss_entropy", "loss_successor", "loss_bottleneck"]
DIAGNOSTICS = ["entropy", "explained_variance", "kl", "beta"]
DEFAULT_KEYS = {
    "advantage": "advantage",
    "value_target": "value_target",
    "value": "state_value",
    "successor_features": "successor_features",
    "successor_target": "successor_target",
    "state_embedding": "state_embedding",
    "state_loc": "state_loc",
    "state_scale": "state_scale",
    "goal_loc": "goal_loc",
    "goal_scale": "goal_scale",
    "state_kl": "state_kl",
    "goal_kl": "goal_kl",
    "action": "action",
    "reward": "reward",
    "done": "done",
    "terminated": "terminated",
    "sample_log_prob": "action_log_prob",
}
MODES = pytest.mark.parametrize("functional", [True, False])


def total(losses: TensorDict) -> torch.Tensor:
    return sum(value.sum() for key, value in losses.items() if key.startswith("loss"))


class TestKeys:
    def test_unknown_keys_are_refused(self, usf) -> None:
        networks = usf()
        with pytest.raises(ValueError, match="unknown is not an accepted"):
            USFLoss(networks.actor, networks.critic).set_keys(unknown="x")

    def test_defaults(self, usf) -> None:
        networks = usf()
        loss = USFLoss(networks.actor, networks.critic)
        assert {key: getattr(loss.tensor_keys, key) for key in DEFAULT_KEYS} == DEFAULT_KEYS
        assert set(DEFAULT_KEYS) == set(USFLoss._AcceptedKeys.__dataclass_fields__)

    @pytest.mark.parametrize("key", DEFAULT_KEYS)
    def test_each_can_be_set_and_reset(self, usf, key: str) -> None:
        networks = usf()
        loss = USFLoss(networks.actor, networks.critic)
        loss.set_keys(**{key: "other"})
        assert getattr(loss.tensor_keys, key) == "other"
        assert {k: getattr(loss.tensor_keys, k) for k in DEFAULT_KEYS if k != key} == {
            k: v for k, v in DEFAULT_KEYS.items() if k != key
        }
        loss.set_keys(**{key: None})
        assert getattr(loss.tensor_keys, key) in (DEFAULT_KEYS[key], "sample_log_prob")

    @pytest.mark.parametrize("before", [True, False])
    @pytest.mark.parametrize(
        "value_type",
        [None, ValueEstimators.TD0, ValueEstimators.TD1, ValueEstimators.TDLambda, ValueEstimators.GAE],
    )
    def test_the_estimator_follows(self, plain, value_type: ValueEstimators | None, before: bool) -> None:
        networks = plain(value="v")
        loss = USFLoss(networks.actor, networks.critic)
        names = {
            "advantage": "a",
            "value_target": "vt",
            "value": "v",
            "reward": "r",
            "done": ("flags", "d"),
            "terminated": ("flags", "t"),
            "successor_features": "psi",
            "successor_target": "pt",
            "state_embedding": "phi",
            "sample_log_prob": "lp",
        }
        if before:
            loss.set_keys(**names)
            loss.make_value_estimator(value_type)
        else:
            loss.set_keys(value="v")
            loss.make_value_estimator(value_type)
            loss.set_keys(**names)
        keys = loss.value_estimator.tensor_keys
        assert {name: getattr(keys, name) for name in names} == names

    @pytest.mark.parametrize("value_type", [5, 0.95, True, ["gae"], int])
    def test_what_is_no_estimator_is_named(self, usf, value_type) -> None:
        with pytest.raises(TypeError, match=r"USFLoss: value_type is .*; give a name such as 'gae', one of"):
            USFLoss(usf().actor, usf().critic).make_value_estimator(value_type)

    @MODES
    def test_every_key_renamed_gives_the_same_loss(self, usf, rollout, functional: bool) -> None:
        networks = usf()
        networks.actor.eval()
        networks.critic.eval()
        expected = USFLoss(networks.actor, networks.critic, functional=functional)(rollout(3, 4))
        names = {
            "state_value": ("out", "v"),
            "successor_features": ("out", "psi"),
            "state_embedding": "phi",
            "state_loc": ("latent", "state", "loc"),
            "state_scale": ("latent", "state", "scale"),
            "goal_loc": ("latent", "goal", "loc"),
            "goal_scale": ("latent", "goal", "scale"),
            "observation": ("agent", "observation"),
        }
        renamed = {
            name: Mod(
                part.module,
                in_keys=[names.get(key, key) for key in part.in_keys],
                out_keys=[names.get(key, key) for key in part.out_keys],
            )
            for name, part in networks.parts.items()
        }
        order = ["encoder", "split", "psi", "policy"]
        actor = ProbabilisticActor(
            TensorDictSequential(*(renamed[name] for name in order)),
            in_keys=["logits"],
            out_keys=[("agent", "action")],
            distribution_class=torch.distributions.Categorical,
            return_log_prob=True,
            log_prob_key=("agent", "lp"),
        )
        order = ["encoder", "split", "goal", "goal_split", "psi", "sample", "omega", "value"]
        critic = TensorDictSequential(*(renamed[name] for name in order)).eval()
        loss = USFLoss(actor, critic, functional=functional)
        assert loss.tensor_keys.action == ("agent", "action")
        assert loss.tensor_keys.sample_log_prob == ("agent", "lp")
        loss.set_keys(
            advantage=("targets", "a"),
            value_target=("targets", "v"),
            successor_target=("targets", "psi"),
            reward=("agent", "reward"),
            done=("flags", "done"),
            terminated=("flags", "terminated"),
            value=names["state_value"],
            **{key: value for key, value in names.items() if key in DEFAULT_KEYS and key != "state_value"},
        )
        td = rollout(
            3,
            4,
            keys={
                "observation": ("agent", "observation"),
                "action": ("agent", "action"),
                "reward": ("agent", "reward"),
                "done": ("flags", "done"),
                "terminated": ("flags", "terminated"),
            },
        )
        losses = loss(td)
        assert set(losses.keys()) == set(TERMS + DIAGNOSTICS)
        for key, value in losses.items():
            torch.testing.assert_close(value, expected[key])
        # and with targets computed beforehand, under their own names
        assert ("targets", "psi") in loss.value_estimator(td).keys(True)
        torch.testing.assert_close(loss(td)["loss_successor"], expected["loss_successor"])

    def test_in_keys(self, usf, rollout) -> None:
        networks = usf()
        loss = USFLoss(networks.actor, networks.critic)
        expected = {"action", "observation", "goal"} | {
            ("next", key) for key in ("reward", "done", "terminated", "observation", "goal")
        }
        assert set(loss.in_keys) == expected
        assert len(loss.in_keys) == len(expected)
        losses = loss(rollout(2, 3).select(*loss.in_keys))
        assert set(losses.keys()) == set(loss.out_keys)
        loss.in_keys = ["action"]
        assert loss.in_keys == ["action"]

    @pytest.mark.parametrize("renamed", [False, True])
    def test_without_a_tensordict(self, usf, rollout, renamed: bool) -> None:
        networks = usf(variational=False)
        loss = USFLoss(networks.actor, networks.critic)
        names = {"reward": "reward2", "done": "done2", "terminated": "terminated2"} if renamed else {}
        loss.set_keys(**names)
        td = rollout(2, 3, keys=names)
        reward, done, terminated = (names.get(key, key) for key in ("reward", "done", "terminated"))
        kwargs = {
            "observation": td["observation"],
            "goal": td["goal"],
            "action": td["action"],
            "next_observation": td["next", "observation"],
            "next_goal": td["next", "goal"],
            f"next_{reward}": td["next", reward],
            f"next_{done}": td["next", done],
            f"next_{terminated}": td["next", terminated],
        }
        expected, result = loss(td), loss(**kwargs)
        assert len(result) == len(loss.out_keys)
        for key, value in zip(loss.out_keys, result, strict=True):
            torch.testing.assert_close(value, expected[key])
        loss.select_out_keys("loss_objective", "loss_successor")
        assert loss.out_keys == ["loss_objective", "loss_successor"]
        objective, successor = loss(**kwargs)
        torch.testing.assert_close(objective, expected["loss_objective"])
        torch.testing.assert_close(successor, expected["loss_successor"])
        assert set(loss(td).keys()) == {"loss_objective", "loss_successor"}
        loss.reset_out_keys()
        assert loss.out_keys == [*TERMS[:4], *DIAGNOSTICS[:2]]


class TestEstimators:
    def test_default_is_the_n_step_return(self, usf, rollout) -> None:
        networks = usf(variational=False)
        loss = USFLoss(networks.actor, networks.critic)
        loss(rollout(2, 3))
        assert isinstance(loss.value_estimator, USFEstimator)
        assert (loss.value_estimator.gamma, loss.value_estimator.lmbda) == (0.99, 1.0)
        assert loss.value_type is ValueEstimators.TD1

    @pytest.mark.parametrize(
        ("value_type", "lmbda"),
        [
            (None, 1.0),
            (ValueEstimators.TD0, 0.0),
            (ValueEstimators.TD1, 1.0),
            (ValueEstimators.TDLambda, 0.95),
            (ValueEstimators.GAE, 0.95),
        ],
    )
    def test_value_types(self, usf, rollout, value_type: ValueEstimators | None, lmbda: float) -> None:
        networks = usf(variational=False)
        loss = USFLoss(networks.actor, networks.critic)
        assert loss.make_value_estimator(value_type, gamma=0.9) is loss
        estimator = loss.value_estimator
        assert (estimator.gamma, estimator.lmbda) == (0.9, lmbda)
        td = rollout(3, 4)
        targets = USFEstimator(value_network=networks.critic, gamma=0.9, lmbda=lmbda)(td.clone())
        for key, value in loss(td).items():
            torch.testing.assert_close(value, loss(targets)[key])

    def test_hyperparameters(self, usf) -> None:
        networks = usf()
        loss = USFLoss(networks.actor, networks.critic)
        loss.make_value_estimator(ValueEstimators.GAE, lmbda=0.5, normalize_advantage=True)
        assert loss.value_estimator.lmbda == 0.5
        assert loss.value_estimator.normalize_advantage
        with pytest.raises(TypeError, match="lambda_"):
            loss.make_value_estimator(ValueEstimators.GAE, lambda_=0.5)

    @pytest.mark.parametrize(
        ("value_type", "reason"),
        [
            (ValueEstimators.VTrace, "VTrace has no targets of successor features"),
            ("vtrace", "successor_coeff=None leaves their term out"),
            (ValueEstimators.MAGAE, "MAGAE is for several agents"),
            ("magae", "MAGAE is for several agents"),
        ],
    )
    def test_those_that_are_not_for_successor_features(self, usf, value_type: object, reason: str) -> None:
        networks = usf()
        with pytest.raises(NotImplementedError, match=rf"{reason}.*TD0.*TD1.*TDLambda.*GAE"):
            USFLoss(networks.actor, networks.critic).make_value_estimator(value_type)

    @pytest.mark.parametrize("name", ["gae", "GAE", "td0", "TDLambda", "vtrace"])
    def test_names(self, plain, rollout, name: str) -> None:
        networks = plain()
        value_type = {member.name.lower(): member for member in ValueEstimators}[name.lower()]
        td = rollout(3, 4)
        td["action_log_prob"] = networks.actor.get_dist(td.clone()).log_prob(td["action"]).detach()
        losses = []
        for chosen in (name, value_type):
            loss = USFLoss(networks.actor, networks.critic)
            losses.append(loss.make_value_estimator(chosen, gamma=0.9)(td))
            assert loss.value_type is value_type
        torch.testing.assert_close(losses[0].to_dict(), losses[1].to_dict())
        for unknown in ("gea", "td_lambda", ""):
            with pytest.raises(ValueError, match=f"value_type is '{unknown}'; give one of .*'gae'"):
                loss.make_value_estimator(unknown)

    @pytest.mark.parametrize("functional", [True, False])
    def test_vtrace_is_torchrls(self, plain, rollout, functional: bool) -> None:
        networks, td = plain(), rollout(3, 4)
        td["action_log_prob"] = networks.actor.get_dist(td.clone()).log_prob(td["action"]).detach() - 0.3
        loss = USFLoss(networks.actor, networks.critic, functional=functional)
        result = loss.make_value_estimator("vtrace", gamma=0.9, rho_thresh=0.8)(td)
        own = VTrace(value_network=networks.critic, actor_network=networks.actor, gamma=0.9, rho_thresh=0.8)
        torch.testing.assert_close(result["loss_critic"], loss(own(td.clone()))["loss_critic"])
        total(result).backward()
        assert all(p.grad is not None for p in networks.actor.parameters())

    def test_average_gae_is_torchrls(self, plain, rollout) -> None:
        networks = plain()
        mine = USFLoss(networks.actor, networks.critic).make_value_estimator("gae", average_gae=True)
        theirs = GAE(value_network=networks.critic, gamma=0.99, lmbda=0.95, average_gae=True)
        td = rollout(3, 4)
        result = mine.value_estimator(td.clone())
        torch.testing.assert_close(result["advantage"], theirs(td.clone())["advantage"])
        with pytest.raises(ValueError, match="normalize_advantage and average_gae are both set"):
            mine.make_value_estimator("gae", average_gae=True, normalize_advantage=True)

    def test_an_estimator_or_its_class(self, usf, rollout) -> None:
        networks = usf(variational=False)
        loss = USFLoss(networks.actor, networks.critic)
        mine = USFEstimator(value_network=networks.critic, gamma=0.5)
        loss.make_value_estimator(mine)
        assert loss.value_estimator is mine
        first = loss(rollout(2, 3))
        loss.make_value_estimator(USFEstimator, value_network=networks.critic, gamma=0.5)
        assert isinstance(loss.value_estimator, USFEstimator)
        assert loss.value_estimator is not mine
        torch.testing.assert_close(loss(rollout(2, 3))["loss_successor"], first["loss_successor"])

    @pytest.mark.parametrize("kind", ["gae", "vtrace"])
    @pytest.mark.parametrize("inside", [True, False])
    def test_torchrls_estimators_for_plain_critics(self, plain, rollout, kind: str, inside: bool) -> None:
        networks = plain()
        td = rollout(3, 4)
        td["action_log_prob"] = networks.actor.get_dist(td.clone()).log_prob(td["action"]).detach()
        if kind == "gae":
            estimator = GAE(value_network=networks.critic, gamma=0.9, lmbda=0.9)
        else:
            estimator = VTrace(value_network=networks.critic, actor_network=networks.actor, gamma=0.9)
        loss = USFLoss(networks.actor, networks.critic)
        if inside:
            loss.make_value_estimator(estimator)
        else:
            td = estimator(td)
        total(loss(td)).backward()
        assert all(p.grad is not None for p in loss.parameters())

    @pytest.mark.parametrize("functional", [True, False])
    def test_targets_are_constants_whatever_the_estimator(self, plain, rollout, functional: bool) -> None:
        networks = plain()
        td = rollout(3, 4)
        loss = USFLoss(networks.actor, networks.critic, functional=functional)
        constant = GAE(value_network=networks.critic, gamma=0.9, lmbda=0.9)(td.clone())
        expected = torch.autograd.grad(loss(constant)["loss_critic"], networks.critic.parameters())
        estimator = GAE(value_network=networks.critic, gamma=0.9, lmbda=0.9, differentiable=True)
        loss.make_value_estimator(estimator)
        losses = loss(td)
        result = torch.autograd.grad(losses["loss_critic"], networks.critic.parameters(), retain_graph=True)
        torch.testing.assert_close(result, expected)
        losses["loss_objective"].backward()
        assert all(p.grad is None for p in networks.critic.parameters())

    def test_targets_of_another_estimator_lack_the_successors(self, usf, rollout) -> None:
        networks = usf(variational=False)
        loss = USFLoss(networks.actor, networks.critic)
        estimator = GAE(value_network=networks.critic, gamma=0.9, lmbda=0.9)
        with pytest.raises(KeyError, match=r"no 'successor_target'.*or leave the advantage out"):
            loss(estimator(rollout(3, 4)))
        loss.make_value_estimator(estimator)  # its own: an error that does not point back at it
        with pytest.raises(
            KeyError, match=r"the loss's estimator, GAE, computes none.*make_value_estimator\("
        ):
            loss(rollout(3, 4))
        assert "loss_successor" not in USFLoss(
            networks.actor, networks.critic, successor_coeff=None
        ).make_value_estimator(estimator)(rollout(3, 4))


class TestTermsThatWereAskedFor:
    """A coefficient that is given requires what its term reads; one that is not, does not."""

    @pytest.mark.parametrize(
        ("key", "options", "message"),
        [
            ("successor_features", {"successor_coeff": 1.0}, "successor_coeff=None"),
            ("state_embedding", {"successor_coeff": 5e-4}, "successor_coeff=None"),
            ("state_embedding", {}, "successor_coeff=None"),
            ("goal_loc", {"bottleneck_coeff": 0.1, "bottleneck_on": "goal"}, "bottleneck_coeff=None"),
            ("state_scale", {"bottleneck_on": "state"}, "bottleneck_coeff=None"),
            ("state_value", {}, r"set_keys\(value=\.\.\.\)"),
        ],
    )
    def test_misspelt_entries_are_named(self, usf, rollout, key: str, options: dict, message: str) -> None:
        networks = usf()
        parts = [
            Mod(
                part.module,
                in_keys=[f"{k}x" if k == key else k for k in part.in_keys],
                out_keys=[f"{k}x" if k == key else k for k in part.out_keys],
            )
            for part in (networks.parts[name] for name in ("encoder", "split", "goal", "goal_split"))
        ]
        parts += [
            Mod(
                networks.parts[name].module,
                in_keys=[f"{k}x" if k == key else k for k in networks.parts[name].in_keys],
                out_keys=[f"{k}x" if k == key else k for k in networks.parts[name].out_keys],
            )
            for name in ("psi", "sample", "omega", "value")
        ]
        loss = USFLoss(networks.actor, TensorDictSequential(*parts), **options)
        for use in (loss.check, lambda: loss(rollout(2, 3))):
            with pytest.raises(ValueError, match=f"the critic writes no '{key}'.*'{key}x'.*{message}"):
                use()
        name = "value" if key == "state_value" else key
        loss.set_keys(**{name: f"{key}x"})
        assert set(loss(rollout(2, 3)).keys()) == set(loss.out_keys)

    @pytest.mark.parametrize("options", [{"successor_coeff": 1.0}, {"bottleneck_coeff": 0.0}])
    def test_a_critic_without_them(self, plain, rollout, options: dict) -> None:
        networks = plain()
        with pytest.raises(ValueError, match="leave the term out by"):
            USFLoss(networks.actor, networks.critic, **options)(rollout(2, 3))
        none = dict.fromkeys(options)
        USFLoss(networks.actor, networks.critic, **none)(rollout(2, 3))
        USFLoss(networks.actor, networks.critic)(rollout(2, 3))
