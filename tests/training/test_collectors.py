"""Collectors: the same goals however the rows are shared out; workers that learn what the agent learns."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.collectors import BaseCollector

from vusfa.errors import ConfigError, GoalError
from vusfa.modules import Agent, make_agent
from vusfa.scenes import Scene, SceneSet
from vusfa.training import check_goals_dealt, make_collector, make_env
from vusfa.training.collectors import opened, rows_per_worker

GOALS = torch.tensor([3, 9, 12])


@pytest.fixture
def rooms(make_scene: Callable[..., Scene]) -> SceneSet:
    return SceneSet([make_scene("hall")])


def untrained(rooms: SceneSet) -> Agent:
    torch.manual_seed(0)
    return make_agent("usfa", scenes=rooms, hidden_size=8, embedding_size=8, history=1)


@pytest.fixture
def agent(rooms: SceneSet) -> Agent:
    return untrained(rooms)


def open_collector(kind: str, rooms: SceneSet, agent: Agent, **settings) -> BaseCollector:
    env = partial(make_env, rooms, agent.make_env_transforms(), goals=GOALS, history=1, max_steps=9)
    wanted = {"num_envs": 6, "rollout": 4, "num_workers": 2, "seed": 5, **settings}
    return make_collector(kind, env, agent.get_policy_operator(), **wanted)


@contextmanager
def batches_of(make: Callable[[], BaseCollector]) -> Iterator[Iterator[TensorDictBase]]:
    with opened(make) as collector:
        yield iter(collector)


class Kept:
    """Makes a collector and keeps hold of it, as an exception's traceback would."""

    def __init__(self, *arguments, **settings) -> None:
        self.make = partial(open_collector, *arguments, **settings)

    def __call__(self) -> BaseCollector:
        self.collector = self.make()
        return self.collector


def prefer(agent: Agent, action: int) -> None:
    """Make the agent always do the same."""
    with torch.no_grad():
        for name, param in agent.policy.named_parameters():
            param.zero_()
            if "bias" in name:
                param.view(-1)[action] = 100.0


def test_single(rooms: SceneSet, agent: Agent):
    with batches_of(lambda: open_collector("single", rooms, agent)) as batches:
        batch = next(batches)
        assert batch.shape == (6, 4)
        assert batch["goal_id"][:, 0].tolist() == [3, 9, 12, 3, 9, 12]
        prefer(agent, 2)
        assert next(batches)["action"].unique().tolist() == [2]


@pytest.mark.usefixtures("fast_workers")
def test_workers_in_step(rooms: SceneSet):
    threads = torch.get_num_threads()
    torch.set_num_threads(3)
    walked = []
    for _ in range(2):
        agent = untrained(rooms)
        make = Kept("multi_sync", rooms, agent, num_envs=4)
        with batches_of(make) as batches:
            batch = next(batches).clone()
            assert batch.shape == (4, 4)
            assert batch["goal_id"][:, 0].tolist() == [3, 9, 12, 3]  # two rows of either worker
            walked.append(batch.select("state_id", "action", "action_log_prob"))
            prefer(agent, 2)
            next(batches)  # under way when the weights changed, or not
            assert next(batches)["action"].unique().tolist() == [2]
        assert not any(process.is_alive() for process in make.collector.procs if not process._closed)
        # or the interpreter would hang on its way out
        assert make.collector._weight_sync_schemes["policy"]._instruction_queues == {}
    assert bool((walked[0] == walked[1]).all())
    assert torch.get_num_threads() == 3
    torch.set_num_threads(threads)


@pytest.mark.usefixtures("fast_workers")
def test_workers_at_their_own_pace(rooms: SceneSet, agent: Agent):
    def take(batches, count: int) -> list[TensorDictBase]:
        return [next(batches) for _ in range(count)]

    make = Kept("multi_async", rooms, agent, num_envs=6)
    with batches_of(make) as batches:
        first = take(batches, 6)
        assert {batch.shape for batch in first} == {(3, 4)}
        assert all(batch["goal_id"][:, 0].tolist() == [3, 9, 12] for batch in first)
        for process in make.collector.procs:
            os.kill(process.pid, signal.SIGINT)  # Ctrl-C reaches them too; it is not theirs to act on
        prefer(agent, 2)
        take(batches, 6)
        assert {int(a) for batch in take(batches, 2) for a in batch["action"].unique()} == {2}


def test_rows_are_shared_out_evenly():
    assert [rows_per_worker(kind, 6, 3) for kind in ("single", "multi_sync", "multi_async")] == [6, 2, 2]
    with pytest.raises(ConfigError, match=r"collector\.kind is 'multi'"):
        rows_per_worker("multi", 6, 3)
    with pytest.raises(ConfigError, match=r"num_envs=7 cannot be shared out among collector\.num_workers=3"):
        rows_per_worker("multi_sync", 7, 3)
    with pytest.raises(ConfigError, match="both must be 1 or more"):
        rows_per_worker("single", 0, 1)
    for num_envs, rollout in ((10**13, 1), (2, 10**12), (10**5, 10**5)):
        with pytest.raises(
            ConfigError, match=r"collector\.rollout \d+; a batch has at most 268,435,456 frames"
        ):
            rows_per_worker("single", num_envs, 1, rollout)


def test_bad_settings_show_before_a_process_starts(rooms: SceneSet, agent: Agent):
    with pytest.raises(ConfigError, match=r"collector\.rollout is 0"):
        open_collector("multi_sync", rooms, agent, rollout=0)
    make = partial(make_env, rooms, goals=[99])
    with pytest.raises(GoalError, match="goal 99 is out of range"):
        make_collector("multi_async", make, agent.get_policy_operator(), num_envs=2, rollout=2, num_workers=2)


def test_fixed_goals_need_an_environment_each():
    check_goals_dealt(5, 5, "fixed")
    check_goals_dealt(5, 2, "episode")
    with pytest.raises(ConfigError, match=r"some of the 5 goals without an environment"):
        check_goals_dealt(5, 4, "fixed")
