"""The bare update computes what the library computes: targets, loss and gradients of the same batch."""

from __future__ import annotations

import itertools

import pytest
import torch

from benchmarks.peers.bare_network import group
from benchmarks.peers.bare_update import BareTraining, Batch, Noise
from benchmarks.trainer import running
from vusfa.training import total_loss


def _as_bare(batch, bare: BareTraining) -> Batch:
    after = batch["next"]
    return Batch(
        batch["state_id"].transpose(0, 1),
        bare.slot[batch["goal_id"].T],
        batch["scene_id"].T,
        batch["action"].T,
        after["state_id"].transpose(0, 1),
        after["reward"].squeeze(-1).T,
        after["terminated"].squeeze(-1).T,
        after["done"].squeeze(-1).T,
    )


@pytest.mark.parametrize(
    ("model", "history", "preset"),
    [
        *itertools.product(["gvf", "usfa", "sfdp", "vusfa"], [1, 4], ["fast"]),
        ("vusfa", 4, "paper"),
        ("sfdp", 1, "paper"),
    ],
)
def test_loss_and_gradients_are_those_of_the_library(model: str, history: int, preset: str, tiny):
    threads = torch.get_num_threads()
    overrides = [
        f"preset={preset}",
        f"agent.model={model}",
        f"agent.history={history}",
        "collector.rollout=12",
    ]
    with running(tiny(*overrides, "collector.num_envs=16", "objective.lmbda=0.9", "autocast=false")) as ours:
        trainer = ours.trainer
        bare, loss = BareTraining(trainer), trainer.algorithm.loss
        loss.entropy_coeff = trainer.settings["entropy"]["start"]
        if model == "vusfa":
            loss.bottleneck_coeff = 0.3
            bare.beta = torch.tensor(0.3)
            trainer.agent.latent.noise = torch.zeros_like  # the draws come in another order
        batch = next(ours.batches).clone()
    assert batch["next", "done"].any()
    expected = total_loss(loss(batch))
    expected.backward()
    plain = _as_bare(batch, bare)
    net = bare.net
    w = net.weights()
    zeros = torch.zeros(192, 8)
    ends = int(plain.done[:-1].sum()) + 16
    noise = Noise(zeros, zeros[:1].expand(ends, 8), zeros) if model == "vusfa" else Noise(None, None, None)
    found, _ = bare.loss(w, net.states(w), net.goals(w, bare.goal_ids), plain, noise)
    found.backward()
    torch.set_num_threads(threads)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-6)
    for (name, theirs), param in zip(net.params.items(), trainer.agent.parameters(), strict=True):
        scale = float(param.grad.abs().max())
        torch.testing.assert_close(theirs.grad, param.grad, rtol=1e-3, atol=1e-4 * scale + 1e-9, msg=name)


@pytest.mark.parametrize("history", [1, 4])
@pytest.mark.parametrize("model", ["gvf", "vusfa"])
def test_acting_leaves_out_what_logits_do_not_need(model: str, history: int, tiny):
    with running(tiny(f"agent.model={model}", f"agent.history={history}", "autocast=false")) as ours:
        bare, batch = BareTraining(ours.trainer), next(ours.batches)
    plain = _as_bare(batch, bare)
    columns = plain.state.flatten(0, 1), plain.goal.flatten(), plain.scene.flatten()
    rows, w = group(*columns, bare.net.num_scenes), bare.net.weights()
    states, goals = bare.net.states(w), bare.net.goals(w, bare.goal_ids)
    every, some = (bare.net.rows(w, states, goals, rows, acting=acting) for acting in (False, True))
    assert some.scale is None
    torch.testing.assert_close(some.logits, every.logits)


def test_updates_move_every_weight_and_the_multiplier(tiny):
    with running(tiny("agent.model=vusfa")) as ours:
        bare = BareTraining(ours.trainer)
    before = [param.detach().clone() for param in bare.params]
    assert [bare.update() for _ in range(4)] == [24] * 4
    assert bare.frames == 96
    assert bare.beta > 0
    for old, new in zip(before, bare.params, strict=True):
        assert not torch.equal(old, new)


def test_a_step_of_the_papers_preset_is_the_librarys(tiny):
    settings = tiny("preset=paper", "agent.model=usfa", "autocast=false", "collector.num_envs=10")
    with running(settings) as ours:
        bare = BareTraining(ours.trainer)
        batch, _ = ours.trainer.update(ours.batches)
    w, plain = bare.net.weights(), _as_bare(batch, bare)
    loss, _ = bare.loss(w, bare.net.states(w), bare.net.goals(w, bare.goal_ids), plain)
    loss.backward()
    bare.optimizer.step()
    for moved, param in zip(bare.params, ours.trainer.agent.parameters(), strict=True):
        torch.testing.assert_close(moved, param, rtol=1e-4, atol=1e-6)


def test_what_it_does_not_know_is_refused(tiny):
    with running(tiny("optim=rmsprop")) as ours, pytest.raises(ValueError, match="adam"):
        BareTraining(ours.trainer)
