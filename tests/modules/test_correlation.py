"""Comparison of the parts of two pictures, against plain loops, and the agents that have it."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict
from torch.nn import functional

from vusfa.errors import ConfigError
from vusfa.modules import Agent, InferencePolicy, PartCorrelation, transplant
from vusfa.scenes import Scene, SceneSet

MakeAgent = Callable[..., Agent]


def mapped(scenes: SceneSet, grid: str = "2x3") -> SceneSet:
    """The same rooms, their 12 features taken as two channels on a grid."""
    rooms = []
    for one in scenes.scenes:
        rooms.append(Scene(one.name, one.graph, one.features, attributes={"feature_grid": grid}))
    return SceneSet(rooms)


def test_scores_are_products_of_parts() -> None:
    correlation = PartCorrelation(6 * 2, parts=6, out_features=5, heads=2, head_size=4, width=3)
    state, goal = torch.randn(3, 12), torch.randn(3, 12)
    with torch.no_grad():
        found = correlation(correlation.queries(state), correlation.keys(goal))
        for row in range(3):
            scores = torch.zeros(2, 6, 6)
            for i in range(6):
                for j in range(6):
                    # channel by channel: feature c * 6 + part
                    x = torch.stack([state[row, i], state[row, 6 + i]])
                    y = torch.stack([goal[row, j], goal[row, 6 + j]])
                    first = functional.gelu(correlation.part(x) + correlation.position[i])
                    second = functional.gelu(correlation.part(y) + correlation.position[j])
                    q, k = correlation.query(first).view(2, 4), correlation.key(second).view(2, 4)
                    scores[:, i, j] = (q * k).sum(-1) / math.sqrt(4)
            torch.testing.assert_close(found[row], correlation.linear(scores.flatten()))


def test_parts_must_divide_the_features() -> None:
    with pytest.raises(ValueError, match="12 features are not those of 5 parts"):
        PartCorrelation(12, parts=5, out_features=4)


@pytest.mark.parametrize("model", ["gvf", "vusfa"])
def test_rows_computed_once_are_those_computed_one_by_one(
    small_agent: MakeAgent, make_batch: Callable[..., TensorDict], scenes: SceneSet, model: str
) -> None:
    rooms = mapped(scenes)
    agent = small_agent(model, scenes=rooms, fusion="correlation", history=2).eval()
    plain = small_agent(model, scenes=rooms, fusion="correlation", history=2, deduplicate=False).eval()
    plain.load_state_dict(agent.state_dict())
    rows = make_batch(4, 10, history=2)
    once, apart = (each.get_value_operator()(rows.clone()) for each in (agent, plain))
    torch.testing.assert_close(once["state_value"], apart["state_value"])
    assert once["fused"].shape == (4, 10, 16)
    trunk = agent.actor_steps()[0].module
    torch.testing.assert_close(trunk.fused(rows["state_id"], rows["goal_id"]), once["fused"])


def test_an_agent_that_is_handed_features_computes_the_same(
    small_agent: MakeAgent, make_batch: Callable[..., TensorDict], scenes: SceneSet
) -> None:
    rooms, rows = mapped(scenes), make_batch(6, history=2)
    agent = small_agent("gvf", scenes=rooms, fusion="correlation", history=2).eval()
    seeing = small_agent("gvf", scenes=rooms, fusion="correlation", history=2, observation="features").eval()
    seeing.load_state_dict(agent.state_dict())
    seen = rows.select("scene_id")
    seen["observation"] = rooms.features[rows["state_id"], 0]
    seen["goal_observation"] = rooms.features[rows["goal_id"], 0]
    logits = [each.get_policy_operator().get_dist(x).logits for each, x in ((agent, rows), (seeing, seen))]
    torch.testing.assert_close(*logits)


def test_the_fusion_reads_the_comparison(small_agent: MakeAgent, scenes: SceneSet) -> None:
    """Gradients reach the correlation; without its last layer the fusion is that of the embeddings."""
    agent = small_agent("gvf", scenes=mapped(scenes), fusion="correlation", history=1)
    state, goal = torch.tensor([[0], [3]]), torch.tensor([2, 5])
    trunk = agent.actor_steps()[0].module
    trunk.fused(state, goal).sum().backward()
    assert all(parameter.grad.any() for parameter in agent.correlation.parameters())  # type: ignore[union-attr]
    with torch.no_grad():
        for parameter in agent.correlation.linear.parameters():  # type: ignore[union-attr]
            parameter.zero_()
        embeddings = agent.encoder(state, goal)
        torch.testing.assert_close(trunk.fused(state, goal), agent.fusion(*embeddings))


def test_cached_answers_are_the_same(
    small_agent: MakeAgent, make_batch: Callable[..., TensorDict], scenes: SceneSet
) -> None:
    agent = small_agent("vusfa", scenes=mapped(scenes), fusion="correlation", history=2).eval()
    policy, rows = InferencePolicy(agent), make_batch(9, history=2)
    columns = rows["state_id"], rows["goal_id"], rows["scene_id"]
    plain = policy.logits(*columns)
    with policy.cached(rows["goal_id"].unique(), rows=9):
        torch.testing.assert_close(policy.logits(*columns), plain)


def test_it_goes_to_other_rooms(small_agent: MakeAgent, scenes: SceneSet) -> None:
    agent = small_agent("gvf", scenes=mapped(scenes), fusion="correlation", shared_heads=True)
    copy = transplant(agent, mapped(SceneSet(scenes.scenes[1:])))
    assert torch.equal(copy.correlation.query.weight, agent.correlation.query.weight)  # type: ignore[union-attr]


def test_features_of_whole_pictures_and_convolutions_are_refused(
    small_agent: MakeAgent, scenes: SceneSet, filmed: SceneSet
) -> None:
    with pytest.raises(ConfigError, match=r"features are of whole pictures; encode them .* --grid 3x4"):
        small_agent(fusion="correlation")
    with pytest.raises(ConfigError, match=r"12 features on grids of \['5x1'\]"):
        small_agent(scenes=mapped(scenes, "5x1"), fusion="correlation")
    with pytest.raises(ConfigError, match="the conv encoder has none"):
        small_agent(scenes=filmed, encoder="conv", observation="pixels", fusion="correlation")
    with pytest.raises(ConfigError, match="fusion is 'attention'"):
        small_agent(fusion="attention")
    with pytest.raises(ConfigError, match="no part of architecture 'paper'"):
        small_agent(architecture="paper", fusion="correlation")
