"""What TorchRL's generic tests ask of a loss module, of USFLoss."""

from __future__ import annotations

import copy
import gc
import pickle
import weakref

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type
from torchrl.objectives.value import GAE

from vusfa.objectives import USFLoss

TERMS = ["loss_objective", "loss_critic", "loss_entropy", "loss_successor", "loss_bottleneck"]
DIAGNOSTICS = ["entropy", "explained_variance", "kl", "beta"]
MODES = pytest.mark.parametrize("functional", [True, False])


def total(losses: TensorDict) -> torch.Tensor:
    return sum(value.sum() for key, value in losses.items() if key.startswith("loss"))


class TestModule:
    """What TorchRL's generic tests ask of a loss module."""

    @MODES
    @pytest.mark.parametrize("advantage", ["inside", "before", "gae"])
    def test_gradients_of_two_networks_are_apart(
        self, plain, rollout, functional: bool, advantage: str
    ) -> None:
        networks = plain()
        loss = USFLoss(networks.actor, networks.critic, functional=functional)
        td = rollout(3, 4)
        if advantage == "before":
            loss.value_estimator(td)
        elif advantage == "gae":
            GAE(value_network=networks.critic, gamma=0.9, lmbda=0.9)(td)
        losses = loss(td)
        losses["loss_critic"].backward(retain_graph=True)
        for name, parameter in loss.named_parameters():
            assert (parameter.grad is not None and parameter.grad.norm() > 0) == ("critic" in name)
        loss.zero_grad()
        (losses["loss_objective"] + losses["loss_entropy"]).backward()
        for name, parameter in loss.named_parameters():
            assert (parameter.grad is not None and parameter.grad.norm() > 0) == ("actor" in name)
        loss.reset()

    @pytest.mark.parametrize("separate_losses", [False, True])
    def test_separate_losses(self, usf, rollout, separate_losses: bool) -> None:
        networks = usf()
        loss = USFLoss(networks.actor, networks.critic, separate_losses=separate_losses)
        losses = loss(rollout(3, 4))
        losses["loss_critic"].backward(retain_graph=True)
        trunk = networks.parts["encoder"].module.weight
        assert (trunk.grad is None) == separate_losses
        assert networks.parts["omega"].module.weight.grad.norm() > 0
        losses["loss_objective"].backward()
        assert trunk.grad.norm() > 0

    def test_separate_losses_give_the_same_numbers(self, usf, rollout) -> None:
        networks = usf(variational=False)
        joint = USFLoss(networks.actor, networks.critic)(rollout(3, 4))
        separate = USFLoss(networks.actor, networks.critic, separate_losses=True)(rollout(3, 4))
        for key, value in joint.items():
            torch.testing.assert_close(separate[key], value)

    def test_separate_losses_need_parameters_apart(self, usf) -> None:
        networks = usf()
        with pytest.raises(ValueError, match="separate_losses=True needs functional=True"):
            USFLoss(networks.actor, networks.critic, separate_losses=True, functional=False)

    @MODES
    @pytest.mark.parametrize("reduction", [None, "none", "mean", "sum"])
    def test_reduction(self, usf, rollout, reduction: str | None, functional: bool) -> None:
        networks = usf()
        networks.critic.eval()
        td = rollout(3, 4)
        losses = USFLoss(networks.actor, networks.critic, reduction=reduction, functional=functional)(td)
        each = USFLoss(networks.actor, networks.critic, reduction="none")(td)
        for key, value in losses.items():
            assert value.shape == (td.shape if reduction == "none" and key in TERMS else ())
            if key in TERMS and reduction != "none":
                torch.testing.assert_close(value, getattr(each[key], reduction or "mean")())
        total(losses).backward()

    @MODES
    @pytest.mark.parametrize("batch", [(5,), (3, 4), (2, 3, 4)])
    def test_batch_shapes(self, usf, rollout, batch: tuple[int, ...], functional: bool) -> None:
        networks = usf()
        td = rollout(*batch)
        keys = set(td.keys(True))
        before = td.clone()
        loss = USFLoss(networks.actor, networks.critic, functional=functional)
        losses = loss(td)
        assert losses.batch_size == ()
        assert all(value.isfinite().all() for value in losses.values())
        assert set(td.keys(True)) == keys
        assert (td == before).all()

    @MODES
    def test_functional_or_not_is_the_same(self, usf, rollout, functional: bool) -> None:
        networks = usf(variational=False)
        loss = USFLoss(networks.actor, networks.critic, functional=functional)
        assert loss.functional is functional
        expected = USFLoss(networks.actor, networks.critic)(rollout(3, 4))
        for key, value in loss(rollout(3, 4)).items():
            torch.testing.assert_close(value, expected[key])

    @MODES
    def test_state_dict(self, usf, rollout, functional: bool) -> None:
        networks, others = usf(), usf()
        loss = USFLoss(networks.actor, networks.critic, functional=functional)
        other = USFLoss(others.actor, others.critic, functional=functional, entropy_coeff=0.5)
        loss.entropy_coeff, loss.bottleneck_coeff = 0.25, 0.75
        loss.make_value_estimator(gamma=0.9, lmbda=0.5)
        loss(rollout(2, 3))
        state = loss.state_dict()
        buffers = {"objective_coeff", "critic_coeff", "successor_coeff", "entropy_coeff", "bottleneck_coeff"}
        assert buffers | {"information_target", "last_kl"} <= set(state)
        other.load_state_dict(state)
        assert (other.entropy_coeff.item(), other.bottleneck_coeff.item()) == (0.25, 0.75)
        assert other.last_kl.item() == loss.last_kl.item() != 0.2
        assert (other.value_estimator.gamma.item(), other.value_estimator.lmbda.item()) == (0.9, 0.5)
        networks.critic.eval()
        others.critic.eval()
        expected = loss(rollout(2, 3))
        for key, value in other(rollout(2, 3)).items():
            torch.testing.assert_close(value, expected[key])

    def test_a_state_of_version_0_1_has_no_discount(self, usf, rollout) -> None:
        networks = usf()
        loss = USFLoss(networks.actor, networks.critic)
        loss.make_value_estimator(gamma=0.9)
        state = {key: value for key, value in loss.state_dict().items() if "_value_estimator" not in key}
        assert len(state) == len(loss.state_dict()) - 2
        loss.load_state_dict(state)
        assert loss.value_estimator.gamma.item() == 0.9
        fresh = USFLoss(networks.actor, networks.critic)
        fresh.load_state_dict(state)
        assert fresh.value_estimator.gamma.item() == 0.99

    def test_coefficients_are_scheduled_by_assignment(self, usf, rollout) -> None:
        networks = usf()
        loss = USFLoss(networks.actor, networks.critic, entropy_coeff=1)
        for name in (
            "objective_coeff",
            "critic_coeff",
            "successor_coeff",
            "entropy_coeff",
            "bottleneck_coeff",
        ):
            buffer = dict(loss.named_buffers())[name]
            setattr(loss, name, 0.125)
            assert dict(loss.named_buffers())[name] is buffer
            assert buffer.item() == 0.125
            setattr(loss, name, 2)
            assert buffer.item() == 2.0
        loss.information_target = 0.5
        assert loss.information_target.item() == 0.5
        loss.successor_coeff = 0.0
        assert loss(rollout(2, 3))["loss_successor"].item() == 0.0

    def test_moves_to_another_precision_with_what_is_shared(self, usf, rollout) -> None:
        networks = usf(variational=False)
        loss = USFLoss(networks.actor, networks.critic).to(torch.double)
        td = rollout(3, 4).to(torch.double)
        total(loss(td)).backward()
        assert all(p.dtype == torch.double for p in loss.parameters())
        assert networks.parts["encoder"].module.weight.grad.dtype == torch.double
        networks.count()
        loss(td)
        assert networks.calls["encoder"] == 2

    @MODES
    def test_copies_are_whole_and_apart(self, usf, rollout, functional: bool) -> None:
        networks = usf(variational=False)
        loss = USFLoss(networks.actor, networks.critic, functional=functional)
        expected = loss(rollout(3, 4))
        twin = copy.deepcopy(loss)
        for parameter in loss.parameters():
            parameter.data.zero_()
        for key, value in twin(rollout(3, 4)).items():
            torch.testing.assert_close(value, expected[key])
        shared = twin.actor_network.module[0].module[0].module[0]
        assert shared is twin.critic_network.module[0].module[0]

    def test_pickles(self, plain, rollout) -> None:
        networks = plain()
        loss = USFLoss(networks.actor, networks.critic)
        expected = loss(rollout(3, 4))
        for key, value in pickle.loads(pickle.dumps(loss))(rollout(3, 4)).items():
            torch.testing.assert_close(value, expected[key])

    def test_reset_parameters_recursive(self, usf) -> None:
        networks = usf()
        loss = USFLoss(networks.actor, networks.critic)
        with torch.no_grad():
            for parameter in loss.parameters():
                parameter += 1000.0
        loss.reset_parameters_recursive()
        assert all(parameter.abs().max() < 100 for parameter in loss.parameters())

    def test_stateful_networks_in_and_out(self, usf, rollout) -> None:
        networks, others = usf(variational=False), usf(variational=False)
        loss = USFLoss(networks.actor, networks.critic)
        net = loss.get_stateful_net("critic_network")
        td = rollout(2, 3)
        torch.testing.assert_close(net(td.clone())["state_value"], networks.critic(td.clone())["state_value"])
        loss.from_stateful_net("critic_network", others.critic)
        torch.testing.assert_close(
            networks.critic(td.clone())["state_value"], others.critic(td)["state_value"]
        )

    def test_exploration_is_off_inside_and_restored_after(self, usf, rollout) -> None:
        networks, seen = usf(), []
        networks.parts["omega"].register_forward_hook(lambda *_: seen.append(exploration_type()))
        loss = USFLoss(networks.actor, networks.critic)
        with set_exploration_type(ExplorationType.RANDOM):
            loss(rollout(2, 3))
            assert exploration_type() is ExplorationType.RANDOM
        assert set(seen) == {ExplorationType.DETERMINISTIC}

    def test_a_latent_drawn_by_torch_is_drawn_all_the_same(self, usf, rollout) -> None:
        networks = usf()
        loss = USFLoss(networks.actor, networks.critic)
        assert loss(rollout(3, 4))["loss_critic"].item() != loss(rollout(3, 4))["loss_critic"].item()
        loss.critic_network.eval()
        assert loss(rollout(3, 4))["loss_critic"].item() == loss(rollout(3, 4))["loss_critic"].item()

    def test_keeps_nothing_of_its_input_alive(self, usf, rollout) -> None:
        networks = usf()
        loss = USFLoss(networks.actor, networks.critic)
        td = rollout(2, 3)
        watched = [weakref.ref(td), *(weakref.ref(value) for value in td.values(True, True))]
        losses = loss(td)
        total(losses).backward()
        del td, losses
        gc.collect()
        assert [ref() for ref in watched] == [None] * len(watched)

    def test_no_attribute_looks_like_a_loss(self, usf) -> None:
        """Trainers add up what starts with 'loss'; TorchRL wraps every attribute that ends with it."""
        networks = usf()
        loss = USFLoss(networks.actor, networks.critic)
        assert not [key for key in DIAGNOSTICS if key.startswith("loss")]
        assert not [name for name in dir(loss) if name.endswith("loss") and not callable(getattr(loss, name))]

    @pytest.mark.parametrize(
        ("wrong", "message"),
        [
            ({"bottleneck_on": "policy"}, "bottleneck_on is 'policy'"),
            ({"reduction": "product"}, "reduction is 'product'"),
            ({"entropy_coeff": True}, "entropy_coeff must be a float"),
            ({"critic_coeff": torch.ones(2)}, "critic_coeff must be a float"),
        ],
    )
    def test_arguments_out_of_range(self, usf, wrong: dict, message: str) -> None:
        networks = usf()
        with pytest.raises(ValueError, match=message):
            USFLoss(networks.actor, networks.critic, **wrong)
