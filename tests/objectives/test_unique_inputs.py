"""Distinct rows: the same rows come back, and the loss and its gradients stay what they were."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict

from vusfa.modules import gather, make_agent
from vusfa.objectives import USFEstimator, USFLoss
from vusfa.objectives.networks import unique_inputs
from vusfa.scenes import SceneSet


@given(
    st.lists(st.tuples(st.integers(0, 3), st.integers(0, 2), st.integers(0, 1)), min_size=1, max_size=40).map(
        lambda rows: rows * 2
    )
)
def test_each_row_finds_itself(rows: list[tuple[int, int, int]]) -> None:
    state, goal, scene = torch.tensor(rows).unbind(-1)
    ids = TensorDict({"state_id": state.unsqueeze(-1), "goal_id": goal, "scene_id": scene}, [len(rows)])
    found = unique_inputs(ids)
    assert found is not None
    different, index = found
    assert len(different) == len(set(rows))
    assert bool((different[index] == ids).all())


def test_what_is_not_worth_it_or_no_id() -> None:
    assert unique_inputs(TensorDict({"state_id": torch.arange(8)}, [8])) is None
    assert unique_inputs(TensorDict({"observation": torch.zeros(8, 1)}, [8])) is None
    assert unique_inputs(TensorDict({"state_id": torch.zeros(8, 4, dtype=torch.int64)}, [8])) is None
    assert unique_inputs(TensorDict({}, [8])) is None


@pytest.mark.parametrize("shape", [(3, 2), (3,), (3, 2, 2)])
def test_gather_is_indexing(shape: tuple[int, ...]) -> None:
    values, index = torch.randn(shape), torch.tensor([[0, 2], [2, 1]])
    assert torch.equal(gather(values, index), values[index])


def rollout(rows: int = 6, time: int = 20) -> TensorDict:
    torch.manual_seed(1)
    state = torch.randint(7, (rows, time + 1, 1))
    goal = torch.randint(2, (rows, 1)).expand(rows, time)
    done = torch.rand(rows, time, 1) < 0.1
    following = {"state_id": state[:, 1:], "reward": torch.randn(rows, time, 1)}
    following |= {"done": done, "terminated": done}
    return TensorDict(
        {
            "state_id": state[:, :-1],
            "goal_id": goal,
            "scene_id": torch.zeros(rows, time, dtype=torch.int64),
            "action": torch.randint(4, (rows, time)),
            "next": following,
        },
        [rows, time],
    )


@pytest.mark.parametrize("model", ["usfa", "sfdp", "vusfa"])
@pytest.mark.parametrize("reduction", ["mean", "none"])
def test_the_loss_and_its_gradients_are_the_same(model: str, reduction: str) -> None:
    """The latent is read at its mean: a drawn one differs by the draws alone."""
    terms, gradients = [], []
    for distinct in (True, False):
        torch.manual_seed(0)
        rooms = SceneSet.bundled(["bathroom"])
        agent = make_agent(model, scenes=rooms, history=1, hidden_size=16, embedding_size=8)
        if agent.latent is not None:
            agent.latent.eval()
        critic = agent.get_value_operator()
        loss = USFLoss(
            agent.get_policy_operator(),
            critic,
            bottleneck_coeff=0.3 if agent.latent is not None else "auto",
            reduction=reduction,  # type: ignore[arg-type]
            distinct=distinct,
        )
        loss.make_value_estimator(USFEstimator(value_network=critic, normalize_advantage=True))
        assert loss.distinct == distinct
        out = loss(rollout())
        sum(value.sum() for key, value in out.items() if key.startswith("loss_")).backward()
        terms.append({key: value.detach() for key, value in out.items()})
        gradients.append({name: p.grad for name, p in agent.named_parameters() if p.grad is not None})
    torch.testing.assert_close(*terms, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(*gradients, rtol=1e-3, atol=1e-4)


def test_equal_rows_go_through_the_networks_once() -> None:
    torch.manual_seed(0)
    agent = make_agent("usfa", scenes=SceneSet.bundled(["bathroom"]), history=1, hidden_size=16)
    seen: list[int] = []
    agent.scene_layer.register_forward_hook(lambda _, inputs, __: seen.append(len(inputs[0])))
    loss = USFLoss(agent.get_policy_operator(), agent.get_value_operator(), functional=False, distinct=True)
    batch = rollout()
    loss(batch)
    pairs = torch.stack([batch["state_id"].squeeze(-1), batch["goal_id"]]).flatten(1).unique(dim=1)
    assert seen[0] == pairs.shape[1] <= 14


def test_several_epochs_on_one_batch() -> None:
    """Nothing is kept from one pass to the next: each encodes the batch with the weights as they are."""
    torch.manual_seed(0)
    agent = make_agent("usfa", scenes=SceneSet.bundled(["bathroom"]), history=1, hidden_size=16)
    critic = agent.get_value_operator()
    loss, batch = USFLoss(agent.get_policy_operator(), critic, distinct=True), rollout()
    USFEstimator(value_network=critic)(batch)
    optimizer, totals = torch.optim.SGD(agent.parameters(), lr=1e-3), []
    for _ in range(2):
        optimizer.zero_grad()
        total = sum(value for key, value in loss(batch).items() if key.startswith("loss_"))
        total.backward()
        totals.append(total.item())
        optimizer.step()
    assert totals[1] < totals[0]
