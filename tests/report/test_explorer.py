"""What the explorer shows of an agent is what the agent says."""

from __future__ import annotations

import itertools
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from vusfa.modules import make_agent
from vusfa.report.explorer import (
    choose_goals,
    choose_starts,
    principal_axes,
    sampled_walks,
    state_maps,
)
from vusfa.report.pictures import thumbnails
from vusfa.scenes import Scene, SceneSet


@pytest.fixture
def halls(make_scene) -> SceneSet:
    return SceneSet([make_scene("one", 2, 2), make_scene("two", 3, 2)])


def agent_of(scenes: SceneSet, model: str = "vusfa", **options: Any) -> Any:
    torch.manual_seed(0)
    return make_agent(model, scenes=scenes, hidden_size=8, embedding_size=6, **options).eval()


@pytest.mark.parametrize("model", ["gvf", "usfa", "sfdp", "vusfa"])
def test_maps_are_the_agents_own_words(halls: SceneSet, model: str):
    agent = agent_of(halls, model, history=1)
    maps = state_maps(agent, halls, 1, [3, 20], num_components=2)
    assert maps.value.shape == (2, 24)
    assert maps.probabilities.shape == (2, 24, 4)
    for row, goal in enumerate((3, 20)):
        for state in (0, 23):
            one = TensorDict(
                {"state_id": [[16 + state]], "goal_id": [16 + goal], "scene_id": [1]}, batch_size=[1]
            )
            with torch.no_grad():
                judged = agent.get_value_operator()(one.clone())
                chances = agent.get_policy_operator().get_dist(one).probs
            assert torch.allclose(maps.value[row, state], judged["state_value"].squeeze(), atol=1e-5)
            assert torch.allclose(maps.probabilities[row, state], chances[0], atol=1e-5)
    if model == "gvf":
        assert maps.components is None
        assert maps.explained is None
    else:
        assert maps.components is not None
        assert maps.components.shape == (2, 24, 2)


def test_components_tell_the_distances_of_psi(halls: SceneSet):
    agent = agent_of(halls, "usfa", history=1)
    maps = state_maps(agent, halls, 0, [5], num_components=6)
    ids = torch.arange(16)
    batch = TensorDict(
        {"state_id": ids[:, None], "goal_id": torch.full((16,), 5), "scene_id": torch.zeros(16).long()}, [16]
    )
    with torch.no_grad():
        psi = agent.get_value_operator()(batch)["successor_features"]
    assert maps.components is not None
    # all six components are psi, turned: what lies apart stays as far apart
    assert torch.allclose(
        torch.cdist(maps.components[0], maps.components[0]), torch.cdist(psi, psi), atol=1e-3
    )
    assert maps.explained is not None
    assert maps.explained.sum() == pytest.approx(1)
    assert maps.explained.tolist() == sorted(maps.explained.tolist(), reverse=True)


def test_axes_against_singular_values():
    values = torch.randn(50, 5, generator=torch.Generator().manual_seed(0)) * torch.tensor([5.0, 3, 1, 1, 1])
    mean, directions, share = principal_axes(values, 2)
    found = (values.double() - mean) @ directions
    u, s, _ = torch.linalg.svd(values.double() - mean, full_matrices=False)
    assert torch.allclose(found.abs(), (u * s)[:, :2].abs(), atol=1e-6)
    assert torch.allclose(share.double(), (s**2 / (s**2).sum())[:2], atol=1e-5)
    assert (found.gather(0, found.abs().argmax(0, keepdim=True)) > 0).all()
    assert principal_axes(torch.ones(4, 3), 1)[2].tolist() == [0.0]


def test_axes_of_a_part_show_all_pairs(halls: SceneSet, monkeypatch: pytest.MonkeyPatch):
    agent, goals = agent_of(halls, "usfa", history=1), list(range(24))
    whole = state_maps(agent, halls, 1, goals)
    monkeypatch.setattr("vusfa.report.explorer._PAIRS_FOR_AXES", 100)
    monkeypatch.setattr("vusfa.report.explorer._ROWS", 50)
    part = state_maps(agent, halls, 1, goals)
    assert torch.allclose(part.value, whole.value, atol=1e-5)
    assert torch.allclose(part.probabilities, whole.probabilities, atol=1e-5)
    assert part.components is not None
    assert whole.components is not None
    for one, other in zip(part.components.unbind(-1), whole.components.unbind(-1), strict=True):
        assert torch.corrcoef(torch.stack([one.flatten(), other.flatten()]))[0, 1].abs() > 0.9


@pytest.mark.parametrize(
    "options", [{"history": 1}, {"history": 4}, {"memory": "lstm"}, {"observation": "features"}]
)
def test_walks_go_along_the_graph(halls: SceneSet, options: dict[str, Any]):
    agent = agent_of(halls, **options)
    start, goal = torch.tensor([0, 17, 30]), torch.tensor([9, 39, 16])
    state_maps(agent, halls, 0, [1])
    before = torch.random.get_rng_state()
    ways = sampled_walks(agent, halls, start, goal, max_steps=40, seed=3)
    assert torch.equal(torch.random.get_rng_state(), before)
    assert ways == sampled_walks(agent, halls, start, goal, max_steps=40, seed=3)
    assert ways != sampled_walks(agent, halls, start, goal, max_steps=40, seed=4)
    for way, begin, end in zip(ways, start.tolist(), goal.tolist(), strict=True):
        assert way[0] == begin
        assert end not in way[:-1]
        assert way[-1] == end or len(way) == 41
        for here, there in itertools.pairwise(way):
            assert there in halls.successor[here]


def test_a_walk_ends_where_it_arrives(halls: SceneSet):
    agent = agent_of(halls, history=1)
    ways = sampled_walks(agent, halls, torch.arange(15), torch.full((15,), 15), max_steps=5000)
    assert [way[-1] for way in ways] == [15] * 15
    assert len({len(way) for way in ways}) > 3


def test_goals_trained_then_failed_then_spread():
    room = Scene.bundled("bathroom")
    success = torch.ones(room.num_states)
    success[[50, 60, 70]] = torch.tensor([0.2, 0.1, 0.3])
    success[80] = torch.nan
    assert choose_goals(room, [9, 4], success, 6)[:4] == [4, 9, 60, 50]
    assert 70 not in choose_goals(room, [9, 4], success, 6)[:4]
    chosen = choose_goals(room, [9, 4], success, 20)
    assert len(set(chosen)) == 20
    assert chosen[2:5] == [60, 50, 70]  # no success of 1 among the failures
    assert choose_goals(room, [9, 4, 7], None, 2) == [4, 7]
    assert len(choose_goals(room, [], None, 1000)) == room.num_states


def test_starts_far_and_near():
    room = Scene.bundled("bathroom")
    away = room.distance[choose_starts(room, 73, 4), 73].tolist()
    assert away[0] == int(room.distance[:, 73].max())
    assert away == sorted(away, reverse=True)
    assert min(away) > 0
    lonely = Scene("lonely", torch.tensor([[0], [0]]), torch.rand(2, 1, 2))
    assert choose_starts(lonely, 1, 3) == []


def test_pictures_within_a_budget():
    import base64

    room = Scene.bundled("bathroom")
    some = thumbnails(room, [9, 4, 9], 20_000)
    data = base64.b64decode(some["data"])
    assert some["ids"][:3] == [9, 4, 0]
    assert len(data) == some["ends"][-1] <= 20_000
    starts = [0, *some["ends"][:-1]]
    assert all(data[start : start + 2] == b"\xff\xd8" for start in starts)
    assert thumbnails(room, [9], 0)["ids"] == []
    every = thumbnails(room, [9], 10**9)
    assert sorted(every["ids"]) == list(range(176))


def test_no_pictures_of_a_scene_without(make_scene):
    assert thumbnails(make_scene(), [1], 10**6) == {"ids": [], "ends": [], "data": ""}
