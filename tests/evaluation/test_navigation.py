"""Evaluation's walks: against plain Python, against the environment, and for what they cost."""

from __future__ import annotations

import pytest
import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, exploration_type

from vusfa.envs import TargetNavEnv
from vusfa.errors import ConfigError, GoalError
from vusfa.evaluation import episode_starts, evaluate, random_walk, walk
from vusfa.modules import InferencePolicy, make_agent
from vusfa.scenes import SceneSet


def walk_in_python(scenes: SceneSet, start: int, goal: int, max_steps: int, act) -> tuple[bool, int, int]:
    """One episode, as a person would write it down."""
    state, collisions = start, 0
    for step in range(max_steps):
        action = act(step)
        collisions += bool(scenes.blocked[state, action])
        state = int(scenes.successor[state, action])
        if state == goal:
            return True, step + 1, collisions
    return False, max_steps, collisions


def test_the_guide_walks_shortest_paths(rooms: SceneSet, guide: TensorDictModuleBase):
    table = evaluate(guide, rooms, "all", episodes_per_goal=3, history=1)
    assert len(table) == 3 * rooms.num_states
    assert bool(table.success.all())
    assert torch.equal(table.length, table.shortest)
    assert int(table.collisions.sum()) == 0
    assert table.scene.bincount().tolist() == [48, 72]
    assert table.scene_names == ("hall", "attic")


def test_columns_agree_with_the_scene(rooms: SceneSet, guide: TensorDictModuleBase):
    goals = torch.tensor([3, 20, 30])
    table = evaluate(guide, rooms, goals, trained=torch.tensor([20]), episodes_per_goal=4)
    assert table.goal.tolist() == [3] * 4 + [4] * 4 + [14] * 4
    assert table.trained.tolist() == [False] * 4 + [True] * 4 + [False] * 4
    for row in table.rows():
        scene = rooms.scenes[rooms.names.index(row["scene"])]
        assert row["shortest"] == int(scene.distance[row["start"], row["goal"]]) > 0
        assert (row["remaining"] == 0) == row["success"]


@pytest.mark.parametrize("action", [0, 1, 3])
def test_walks_and_collisions_against_plain_python(rooms: SceneSet, policies, action: int):
    start, goal = episode_starts(rooms, torch.arange(rooms.num_states), 2)
    found = walk(policies["turner"](action), rooms, start, goal, max_steps=7, history=2, batch_size=9)
    for i, (s, g) in enumerate(zip(start.tolist(), goal.tolist(), strict=True)):
        expected = walk_in_python(rooms, s, g, 7, lambda _: action)
        assert tuple(column[i].item() for column in found[:3]) == expected


def test_a_memory_starts_empty_in_every_episode(rooms: SceneSet, policies):
    # With a batch of 5 rows, episodes take over the rows of those that have ended.
    start, goal = episode_starts(rooms, torch.arange(rooms.num_states), 1)
    found = walk(policies["counter"](), rooms, start, goal, max_steps=11, history=1, batch_size=5)
    for i, (s, g) in enumerate(zip(start.tolist(), goal.tolist(), strict=True)):
        expected = walk_in_python(rooms, s, g, 11, lambda step: 0 if step % 3 == 2 else 1)
        assert tuple(column[i].item() for column in found[:3]) == expected


def test_agrees_with_the_environment(rooms: SceneSet, policies):
    start, goal = episode_starts(rooms, torch.arange(rooms.num_states), 1)
    policy = policies["turner"](0)
    success, length, collisions, last = walk(policy, rooms, start, goal, max_steps=6, history=4)
    env = TargetNavEnv(rooms, goals=goal, batch_size=[len(goal)], max_steps=6)
    rollout = env.rollout(
        6, policy, auto_reset=False, tensordict=env.set_state(start, goal), break_when_all_done=True
    )
    done = rollout["next", "done"].squeeze(-1)
    end = done.to(torch.int64).argmax(-1)
    assert torch.equal(rollout["next", "terminated"].squeeze(-1)[torch.arange(len(goal)), end], success)
    assert torch.equal(end + 1, length)
    assert torch.equal(rollout["next", "state_id"][torch.arange(len(goal)), end, -1], last)
    before_the_end = torch.arange(rollout.shape[1]) <= end.unsqueeze(-1)
    assert torch.equal((rollout["next", "collided"].squeeze(-1) & before_the_end).sum(-1), collisions)


def test_finished_episodes_cost_nothing(rooms: SceneSet, policies):
    dice = policies["dice"]()
    start, goal = episode_starts(rooms, torch.arange(rooms.num_states), 3)
    _, length, _, _ = walk(dice, rooms, start, goal, max_steps=60, history=4, batch_size=32)
    assert dice.rows == int(length.sum())


def test_random_steps_succeed_as_often_as_computed(rooms: SceneSet, policies):
    hall = SceneSet(rooms.scenes[:1])
    exact = random_walk(hall.scenes[0], torch.arange(16), 25).mean().item()
    found = evaluate(policies["dice"](), hall, "all", episodes_per_goal=400, max_steps=25)
    deviation = (exact * (1 - exact) / len(found)) ** 0.5
    assert abs(found.success.double().mean().item() - exact) < 4 * deviation


def test_same_seed_same_table_and_nobody_notices(rooms: SceneSet):
    agent = make_agent("vusfa", scenes=rooms, hidden_size=8, embedding_size=8, history=2)
    actor = agent.get_policy_operator()
    agent.fusion.eval()
    before = torch.get_rng_state()
    first, again, other = (
        evaluate(actor, rooms, [3, 20], episodes_per_goal=5, max_steps=20, history=2, seed=seed)
        for seed in (1, 1, 2)
    )
    assert first.equal(again)
    assert not first.equal(other)
    assert torch.equal(torch.get_rng_state(), before)
    assert agent.training
    assert not agent.fusion.training


def test_greedy_or_sampled_is_the_policys_exploration_mode(rooms: SceneSet, policies):
    seen = []

    class Witness(policies["turner"]):
        def forward(self, tensordict):
            seen.append(exploration_type())
            return super().forward(tensordict)

    for sample in (True, False):
        evaluate(Witness(1), rooms, [3], episodes_per_goal=1, max_steps=1, sample=sample)
    assert seen == [ExplorationType.RANDOM, ExplorationType.DETERMINISTIC]


def test_recurrent_agents_walk(rooms: SceneSet):
    agent = make_agent("usfa", scenes=rooms, hidden_size=8, embedding_size=8, memory="lstm")
    table = evaluate(
        agent.get_policy_operator(), rooms, [3], episodes_per_goal=9, max_steps=30, history=1, batch_size=4
    )
    assert len(table) == 9


def test_progress_counts_up_to_all(rooms: SceneSet, policies):
    told = []
    evaluate(
        policies["dice"](),
        rooms,
        [1, 2],
        episodes_per_goal=3,
        progress=lambda done, total: told.append((done, total)),
    )
    assert [total for _, total in told] == [6] * len(told)
    assert [done for done, _ in told] == sorted(done for done, _ in told)
    assert told[-1] == (6, 6)


def test_starts_can_reach_the_goal(island: SceneSet):
    start, goal = episode_starts(island, torch.tensor([0, 1, 2, 3, 4]), 50, generator=torch.Generator())
    assert goal.unique().tolist() == [0, 1, 2, 3]  # nothing leads to state 4
    assert bool((island.distance(start, goal) > 0).all())
    assert {s for s, g in zip(start.tolist(), goal.tolist(), strict=True) if g == 0} == {1, 2, 4}


def test_unreachable_pairs_can_count_as_failures(island: SceneSet, policies):
    start, goal = episode_starts(island, torch.arange(5), 50, unreachable="fail")
    assert goal.unique().tolist() == [0, 1, 2, 3, 4]
    assert bool((start != goal).all())
    table = evaluate(
        policies["guide"](island),
        island,
        torch.arange(5),
        episodes_per_goal=50,
        max_steps=9,
        unreachable="fail",
    )
    assert torch.equal(table.success, table.shortest > 0)
    assert bool((table.length[~table.success] == 9).all())


def test_a_world_of_unreachable_goals_is_refused(island: SceneSet, policies):
    with pytest.raises(GoalError, match="none of the 1 goals can be reached"):
        evaluate(policies["turner"](0), island, [4])


@pytest.mark.parametrize(
    ("setting", "value", "words"),
    [
        ("episodes_per_goal", 0, "episodes_per_goal is 0"),
        ("max_steps", 0, "max_steps is 0"),
        ("batch_size", 0, "batch_size is 0"),
        ("history", 0, "history is 0"),
        ("seed", -1, "seed is -1; give a whole number of 0 or more"),
        ("episodes_per_goal", 10**12, "episodes_per_goal is 1000000000000 for 1 goals; give at most"),
        ("episodes", (torch.tensor([3]), torch.tensor([10**6])), "goal 1000000 is out of range"),
        ("episodes", (torch.tensor([-1]), torch.tensor([3])), "start -1 is out of range"),
        (
            "episodes",
            (torch.tensor([3, 4]), torch.tensor([5])),
            r"int64 \[2\] and torch.int64 \[1\]; give starts",
        ),
        (
            "episodes",
            (torch.tensor([3.0]), torch.tensor([5])),
            r"torch.float32 \[1\] and .*; give starts and goals",
        ),
        ("episodes", (torch.tensor([3]), torch.tensor([20])), "start 3 and goal 20 are in different scenes"),
        ("unreachable", "drop", "unreachable is 'drop'"),
    ],
)
def test_bad_settings(rooms: SceneSet, policies, setting: str, value, words: str):
    with pytest.raises((ConfigError, GoalError), match=words):
        evaluate(policies["turner"](0), rooms, [3], **{setting: value})


def test_what_is_no_policy(rooms: SceneSet):
    agent = make_agent("gvf", scenes=rooms, hidden_size=8, embedding_size=8)
    with pytest.raises(
        ConfigError, match=r"policy is 'Agent'; give a policy, such as InferencePolicy\(agent\)"
    ):
        evaluate(agent, rooms, [3])


def test_fewer_frames_than_the_agent_reads(rooms: SceneSet):
    """With constant weights a single frame stood for four."""
    agent = make_agent("gvf", scenes=rooms, history=4, hidden_size=8, embedding_size=8)
    for policy in (InferencePolicy(agent), agent.get_policy_operator()):
        with pytest.raises(ConfigError, match="state_id has 1 frames a row and the agent reads 4"):
            evaluate(policy, rooms, [3], history=1)
