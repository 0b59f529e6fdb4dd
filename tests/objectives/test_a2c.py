"""For a critic that writes a value alone USFLoss is TorchRL's A2CLoss with the same targets."""

from __future__ import annotations

from functools import partial

import torch
from torchrl.objectives import A2CLoss

from tests.objectives.test_unique_inputs import rollout
from vusfa.modules import make_agent
from vusfa.objectives import USFEstimator, USFLoss
from vusfa.scenes import SceneSet


def test_terms_and_gradients_are_those_of_a2c() -> None:
    torch.manual_seed(0)
    agent = make_agent("gvf", scenes=SceneSet.bundled(["bathroom"]), history=1, hidden_size=16)
    actor, critic, batch = agent.get_policy_operator(), agent.get_value_operator(), rollout()
    USFEstimator(value_network=critic)(batch)
    terms, gradients = [], []
    for make in (USFLoss, partial(A2CLoss, loss_critic_type="l2")):
        agent.zero_grad()
        loss = make(actor, critic, critic_coeff=0.5, entropy_coeff=0.01, functional=False)
        out = loss(batch.clone())
        chosen = {key: value for key, value in out.items() if key.startswith("loss_")}
        sum(chosen.values()).backward()
        terms.append({key: value.detach() for key, value in sorted(chosen.items())})
        gradients.append({name: p.grad.clone() for name, p in agent.named_parameters()})
    torch.testing.assert_close(*terms)
    torch.testing.assert_close(*gradients)
