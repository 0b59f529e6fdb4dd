"""A fifth model in one file: it acts, and is differentiated, by its own policy head."""

from __future__ import annotations

import runpy
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from vusfa.modules import MODELS, Agent, InferencePolicy

EXAMPLE = Path(__file__).parents[2] / "examples" / "extending" / "model.py"


@pytest.fixture
def gated(small_agent: Callable[..., Agent]) -> Iterator[Agent]:
    runpy.run_path(str(EXAMPLE))
    yield small_agent("gated")
    MODELS.pop("gated")


def test_it_acts_by_its_own_head(gated: Agent, make_batch: Callable[..., TensorDict]) -> None:
    data, policy = make_batch(30), InferencePolicy(gated)
    rows = data["state_id"], data["goal_id"], data["scene_id"]
    wanted = gated.get_policy_operator().get_dist_params(data.clone())["logits"]
    torch.testing.assert_close(policy.logits(*rows), wanted)
    with policy.cached():
        torch.testing.assert_close(policy.logits(*rows), wanted)
    wanted.sum().backward()
    assert gated.policy.gate.weight.grad.any()
    with torch.no_grad():
        gated.policy.head.linear.bias.zero_()[:, 2] = 1e6
    assert bool((policy(data)["action"] == 2).all())
