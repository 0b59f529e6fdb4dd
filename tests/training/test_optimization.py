"""Losses, steps and rates."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import nn
from torchrl.objectives import A2CLoss

from vusfa.algorithms import annealed, make_usf_loss
from vusfa.envs import TargetNavEnv
from vusfa.errors import ConfigError
from vusfa.modules import make_agent
from vusfa.scenes import Scene, SceneSet
from vusfa.training import descend, make_optimizer, total_loss

COEFFICIENTS = {
    "objective_coeff": 2.0,
    "critic_coeff": 0.5,
    "entropy_coeff": 0.25,
    "successor_coeff": 0.125,
    "bottleneck_coeff": 0.5,
    "bottleneck_step_size": 0.1,
}


@pytest.fixture
def rooms(make_scene: Callable[..., Scene]) -> SceneSet:
    return SceneSet([make_scene("hall")])


def parts(rooms: SceneSet, model: str):
    torch.manual_seed(0)
    agent = make_agent(model, scenes=rooms, hidden_size=8, embedding_size=8, history=1)
    actor = agent.get_policy_operator()
    batch = TargetNavEnv(rooms, goals=[3, 9], batch_size=[4], history=1, seed=0).rollout(
        6, actor, break_when_any_done=False
    )
    return agent, actor, agent.get_value_operator(), batch


@pytest.mark.parametrize("model", ["gvf", "usfa", "sfdp", "vusfa"])
def test_every_model_gets_its_loss_and_all_its_weights_a_gradient(rooms: SceneSet, model: str):
    agent, actor, critic, batch = parts(rooms, model)
    loss, multiplier = make_usf_loss(actor, critic, **COEFFICIENTS)
    assert (multiplier is not None) == (model == "vusfa")
    total_loss(loss(batch.clone())).backward()
    assert all(param.grad is not None and param.grad.isfinite().all() for param in agent.parameters())


def test_coefficients_hold_for_the_terms_that_a_model_has(rooms: SceneSet):
    """... such as a bottleneck of the state alone; and a part of what a term needs is an error."""
    _, actor, critic, batch = parts(rooms, "vusfa")
    keys = [key for key in critic.out_keys if key not in ("goal_loc", "goal_scale")]
    loss, multiplier = make_usf_loss(actor, critic.select_out_keys(*keys), **COEFFICIENTS)
    assert multiplier is not None
    assert loss(batch)["beta"] == loss.state_dict()["bottleneck_coeff"] == 0.5
    critic.reset_out_keys()
    with pytest.raises(ConfigError, match=r"objective: .*no 'goal_scale'.*bottleneck_coeff=None"):
        make_usf_loss(actor, critic.select_out_keys(*keys, "goal_loc"), **COEFFICIENTS)


def test_gvf_is_plain_advantage_actor_critic(rooms: SceneSet):
    # torchrl's A2CLoss has no coefficient for the policy's term
    _, actor, critic, batch = parts(rooms, "gvf")
    loss, _ = make_usf_loss(actor, critic, **COEFFICIENTS)
    loss.value_estimator(batch)
    expected = A2CLoss(actor, critic, entropy_coeff=0.25, critic_coeff=0.5, loss_critic_type="l2")(batch)
    terms = loss(batch)
    torch.testing.assert_close(terms["loss_objective"], 2.0 * expected["loss_objective"])
    torch.testing.assert_close(terms["loss_critic"], expected["loss_critic"])
    torch.testing.assert_close(terms["loss_entropy"], expected["loss_entropy"])


def test_diagnostics_are_not_added_up(rooms: SceneSet):
    _, actor, critic, batch = parts(rooms, "vusfa")
    loss, _ = make_usf_loss(actor, critic, **COEFFICIENTS)
    terms = loss(batch)
    names = ("objective", "critic", "successor", "entropy", "bottleneck")
    torch.testing.assert_close(total_loss(terms), sum(terms[f"loss_{name}"] for name in names))


@pytest.mark.parametrize(
    ("wrong", "words"), [({"gamma": 2.0}, "gamma is 2"), ({"bottleneck_on": "none"}, "bottleneck_on")]
)
def test_bad_numbers_are_named(rooms: SceneSet, wrong, words):
    _, actor, critic, _ = parts(rooms, "vusfa")
    with pytest.raises(ConfigError, match=f"objective: .*{words}"):
        make_usf_loss(actor, critic, **COEFFICIENTS, **wrong)


def test_the_step_is_clipped_as_one_vector():
    weight = nn.Parameter(torch.zeros(2))
    norm = descend(torch.optim.SGD([weight], lr=9.0), (weight * torch.tensor([3.0, 4.0])).sum(), 0.5, 1.0)
    assert norm.item() == pytest.approx(5.0)
    torch.testing.assert_close(weight.data, torch.tensor([-0.3, -0.4]))


def test_tf_rmsprop_clips_by_itself():
    weight, other = nn.Parameter(torch.zeros(1)), nn.Parameter(torch.zeros(1))
    optimizer = make_optimizer([weight, other], "tf_rmsprop", 1.0, 2.0, alpha=0.0, eps=0.0)
    norm = descend(optimizer, 8.0 * weight.sum() + 1.0 * other.sum(), 1.0, 2.0)
    assert norm.item() == pytest.approx(65**0.5)
    # with alpha = 0 the step is g / |g| whatever the clipping; the accumulators tell
    assert [optimizer.state[p]["square_avg"].item() for p in (weight, other)] == [4.0, 1.0]


def test_optimizers_by_name():
    params = [nn.Parameter(torch.zeros(1))]
    assert isinstance(make_optimizer(params, "adam", 0.1, eps=1e-5), torch.optim.Adam)
    assert isinstance(make_optimizer(params, "rmsprop", 0.1), torch.optim.RMSprop)
    with pytest.raises(ConfigError, match="'adamm'"):
        make_optimizer(params, "adamm", 0.1)
    with pytest.raises(ConfigError, match="momentun"):
        make_optimizer(params, "rmsprop", 0.1, momentun=0.9)
    with pytest.raises(ConfigError, match=r"optim\.lr=-1"):
        make_optimizer(params, "adam", -1.0)


def test_the_rate_ends_at_zero():
    assert annealed(0, 7e-4, 100) == 7e-4
    assert annealed(100, 7e-4, 100) == 0.0
    assert annealed(130, 7e-4, 100) == 0.0


def test_a_coefficient_goes_from_start_to_end_and_stays():
    assert annealed(0, 0.08, 200, end=0.008) == 0.08
    assert annealed(100, 0.08, 200, end=0.008) == pytest.approx(0.044)
    assert annealed(500, 0.08, 200, end=0.008) == pytest.approx(0.008)
    assert annealed(500, 0.08, None, end=0.008) == 0.08
