"""Parts of an evaluation: which goals they have, and that their draws are their own."""

from __future__ import annotations

import pytest
import torch

from vusfa.evaluation import Episodes, evaluate
from vusfa.evaluation.exact import expected_walks, join_walks, uniform_probabilities, walks_within
from vusfa.evaluation.parts import evaluate_parts, parts_of
from vusfa.modules import InferencePolicy, make_agent
from vusfa.scenes import SceneSet


def test_a_part_has_goals_of_one_scene_and_so_many_episodes(rooms: SceneSet):
    goals = torch.tensor([30, 3, 15, 0, 20])  # 0 to 15 are in the hall, 16 to 39 in the attic
    assert [part.tolist() for part in parts_of(rooms, goals, 128)] == [[3, 15], [0], [30, 20]]
    assert [part.tolist() for part in parts_of(rooms, goals, 1000)] == [[3], [15], [0], [30], [20]]
    assert [part.tolist() for part in parts_of(rooms, goals, 5)] == [[3, 15, 0], [30, 20]]
    assert parts_of(rooms, goals[:0], 5) == []


@pytest.mark.parametrize("history", [1, 3])
def test_a_part_is_as_a_single_evaluation_walks_it(rooms: SceneSet, history: int):
    agent = make_agent("gvf", scenes=rooms, history=history, hidden_size=8, embedding_size=4)
    policy, parts = InferencePolicy(agent), parts_of(rooms, torch.arange(40), 30)
    given = {"episodes_per_goal": 30, "max_steps": 20, "history": history, "trained": torch.tensor([3])}
    seen: list[tuple[int, int]] = []
    whole = evaluate_parts(policy, rooms, parts, seed=7, progress=lambda *n: seen.append(n), **given)
    assert [len(table) for table in whole] == [30 * len(part) for part in parts]
    assert seen[-1] == (1200, 1200)
    assert seen == sorted(seen)
    for number in (0, 3):
        alone = evaluate(policy, rooms, parts[number], seed=7 + number, by_scene=True, **given)
        assert whole[number].equal(alone)
    second = evaluate_parts(policy, rooms, parts, slice(1, None, 2), seed=7, **given)
    assert len(second) == len(parts) // 2
    assert all(table.equal(whole[2 * number + 1]) for number, table in enumerate(second))
    joined = Episodes.joined(whole)
    assert (joined.max_steps, joined.scene_names) == (20, ("hall", "attic"))
    assert torch.equal(joined.length, torch.cat([table.length for table in whole]))
    assert torch.equal(joined.remaining, torch.cat([table.remaining for table in whole]))


def test_a_part_that_nothing_reaches_has_no_episodes(island: SceneSet, policies):
    reached = torch.tensor([goal for goal in range(island.num_states) if _starts(island, goal)])
    lonely = torch.tensor([goal for goal in range(island.num_states) if not _starts(island, goal)])
    tables = evaluate_parts(policies["turner"](0), island, [lonely, reached], max_steps=4, history=1)
    assert [len(table) for table in tables] == [0, 10 * len(reached)]
    assert len(Episodes.joined(tables)) == 10 * len(reached)


def _starts(scenes: SceneSet, goal: int) -> int:
    return int((scenes.scenes[0].distances_to(torch.tensor([goal])) > 0).sum())


def test_walks_are_the_same_in_any_parts(rooms: SceneSet):
    goals = torch.arange(2, 40, 5)
    whole = expected_walks(None, rooms, goals, 50)
    parts = [walks_within(uniform_probabilities(4), rooms, part, 50) for part in parts_of(rooms, goals, 100)]
    assert [index for index, _, _ in parts] == [0, 0, 1, 1, 1]
    for found, expected in zip(join_walks(parts, rooms), whole, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-12, atol=0, equal_nan=True)
