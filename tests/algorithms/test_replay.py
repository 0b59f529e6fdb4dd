"""The replay buffer: a walk of which every state is known."""

from __future__ import annotations

from collections import Counter

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from vusfa.algorithms import HindsightReplay, HindsightSampler
from vusfa.algorithms.hindsight_goals import steps_ahead
from vusfa.algorithms.replay import merge_replays, share_of_replay
from vusfa.errors import ConfigError

ENVS, LONG = 3, 40


def walked(first: int, steps: int, ends: dict[int, set[int]]) -> TensorDict:
    """Row r walks r*100, r*100+1, ... one state a step, times ``first`` to ``first + steps``; episodes of row
    r end with the steps ``ends[r]``."""
    time = torch.arange(first, first + steps).expand(ENVS, -1)
    state = time + 100 * torch.arange(ENVS).unsqueeze(-1)
    done = torch.tensor([[t in ends.get(r, ()) for t in range(first, first + steps)] for r in range(ENVS)])
    return TensorDict(
        {
            "state_id": state.unsqueeze(-1),
            "scene_id": torch.arange(ENVS).unsqueeze(-1).expand(-1, steps).contiguous(),
            "action": time.contiguous() % 4,
            "goal_id": torch.zeros_like(state),
            "next": {"state_id": (state + 1).unsqueeze(-1), "done": done.unsqueeze(-1)},
        },
        [ENVS, steps],
    )


def filled(capacity: int, ends: dict[int, set[int]], **options: float) -> HindsightReplay:
    replay = HindsightReplay(400, ENVS, capacity=capacity, batch_size=4000, **options)  # type: ignore[arg-type]
    for first in range(0, LONG, 5):
        replay.extend(walked(first, 5, ends))
    return replay


@given(
    st.dictionaries(st.integers(0, ENVS - 1), st.sets(st.integers(0, LONG - 1))),
    st.sampled_from([3, 12, 30, 60, 63, 119, 120, 500]),
    st.integers(1, 12),
)
@settings(max_examples=25)
def test_goals_of_the_own_way_lie_on_it(ends: dict[int, set[int]], capacity: int, horizon: int):
    sample = filled(capacity, ends, horizon=horizon, own_future=1.0).sample()
    state, goal, steps = sample["state_id"][:, -1], sample["goal_id"], sample["steps_to_goal"]
    assert torch.equal(goal, state + steps)  # as this world is: one state a step, within one row's states
    assert int(steps.min()) >= 1
    assert int(steps.max()) <= horizon
    for s, k in set(zip(state.tolist(), steps.tolist(), strict=True)):
        row, time = divmod(s, 100)
        assert not ends.get(row, set()) & set(range(time, time + k - 1))  # no episode ends on the way
        assert time >= LONG - max(capacity // ENVS, 1)  # no older than what is kept


def test_goals_of_the_own_way_are_drawn_uniformly():
    sample = filled(500, {}, horizon=4, own_future=1.0).sample()
    inner = sample["steps_to_goal"][sample["state_id"][:, -1] % 100 < LONG - 4]
    counts = Counter(inner.tolist())
    assert sorted(counts) == [1, 2, 3, 4]
    assert max(counts.values()) < 1.2 * min(counts.values())


def test_other_goals_are_any_seen_state_of_the_scene():
    sample = filled(30, {}, own_future=0.0).sample()  # forgotten transitions' states stay known
    assert not sample["steps_to_goal"].any()
    for row in range(ENVS):
        goals = sample["goal_id"][sample["scene_id"] == row]
        assert set(goals.tolist()) == set(range(100 * row, 100 * row + LONG + 1))


def test_half_of_the_goals_are_of_each_kind():
    share = (filled(500, {}).sample()["steps_to_goal"] > 0).float().mean()
    assert share == pytest.approx(0.5, abs=0.05)


def test_rows_come_sorted_with_their_own_entries():
    sample = filled(500, {}).sample()
    state = sample["state_id"][:, -1]
    assert bool((state.diff() >= 0).all())
    assert torch.equal(sample["action"], state % 100 % 4)
    assert torch.equal(sample["next", "state_id"][:, -1], state + 1)
    assert torch.equal(sample["scene_id"], state // 100)


def test_clock_leaves_a_number_out_where_an_episode_ends():
    replay = filled(500, {1: {6}})
    clock = replay.buffer[:]["clock"].view(LONG, ENVS)
    assert clock[:, 0].tolist() == list(range(LONG))
    assert clock[:, 1].tolist() == [*range(7), *range(8, LONG + 1)]
    assert steps_ahead(replay.buffer[:]["clock"], torch.tensor([1]), ENVS, 30).tolist() == [7]


@pytest.mark.parametrize("capacity", [30, 500])
def test_a_saved_buffer_goes_on_as_the_first(capacity: int, tmp_path):
    first = filled(capacity, {0: {11}})
    torch.save(first.state_dict(), tmp_path / "replay.pt")
    second = HindsightReplay(400, ENVS, capacity=capacity, batch_size=4000)
    second.load_state_dict(torch.load(tmp_path / "replay.pt", weights_only=True))
    for replay in (first, second):
        replay.extend(walked(LONG, 5, {2: {41}}))
    samples = []
    for replay in (first, second):
        torch.manual_seed(0)
        samples.append(replay.sample())
    assert bool((samples[0] == samples[1]).all())


def test_what_does_not_fit_is_refused():
    replay = filled(500, {})
    with pytest.raises(ConfigError, match=r"leave hindsight\.capacity"):
        HindsightReplay(400, ENVS, capacity=30).load_state_dict(replay.state_dict())
    with pytest.raises(ConfigError, match="2 environments where 3 were announced"):
        replay.extend(walked(0, 5, {})[:2])
    with pytest.raises(ConfigError, match="capacity is 2"):
        HindsightReplay(400, ENVS, capacity=2)
    with pytest.raises(ConfigError, match="own_future 2"):
        HindsightSampler(ENVS, 400, own_future=2)


@pytest.mark.parametrize("capacity", [60, 500])
def test_merged_buffers_are_that_of_all_environments_and_its_shares_are_they(capacity: int):
    """Three buffers of one environment each, and one of three; filled once over, and half."""
    whole = HindsightReplay(400, ENVS, capacity=capacity // ENVS * ENVS)
    parts = [HindsightReplay(400, 1, capacity=capacity // ENVS) for _ in range(ENVS)]
    for first in range(0, LONG, 5):
        batch = walked(first, 5, {1: {7, 20}})
        whole.extend(batch)
        for row, part in enumerate(parts):
            part.extend(batch[row : row + 1])
    states = [part.state_dict() for part in parts]
    merged = merge_replays(states)
    torch.testing.assert_close(merged, whole.state_dict(), rtol=0, atol=0)
    for rank, state in enumerate(states):
        share = share_of_replay(merged, rank, ENVS)
        share["sampler"] = state["sampler"]  # seen states are those of all
        torch.testing.assert_close(share, state, rtol=0, atol=0)
        again = HindsightReplay(400, 1, capacity=capacity // ENVS)
        again.load_state_dict(share)
    assert merge_replays([HindsightReplay(9, 2).state_dict()] * 2)["rows"] == {}
