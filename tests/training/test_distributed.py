"""What ranks share out, and what they refuse; tests/faults/test_ranks.py runs them as processes."""

from __future__ import annotations

import socket
import threading
import time
from typing import Any

import pytest
import torch

from vusfa.algorithms.experience import merge_graphs
from vusfa.errors import ConfigError, RankError
from vusfa.objectives.returns import _normalize, _normalize_together
from vusfa.training import StopOnSignal, rendezvous
from vusfa.training.ranks import Ranks, check_ranks, merged, settings_of_rank, share
from vusfa.training.rendezvous import joined


def settings(name: str = "usf", **changes: Any) -> dict[str, Any]:
    collector = {"kind": "single", "num_envs": 12, "rollout": 5, "timeout": 60.0}
    return {
        "collector": {**collector, **changes.pop("collector", {})},
        "algorithm": {"name": name, "batch_size": 24, "num_goals": 4},
        "hindsight": {"batch_size": 24, "capacity": 1000, **changes.pop("hindsight", {})},
        "optim": {"kind": "adam", **changes.pop("optim", {})},
        "device": "cpu",
    }


@pytest.mark.parametrize(
    ("size", "given", "words"),
    [
        (2, {"collector": {"kind": "multi_async"}}, "collector.kind=multi_async has processes of its own"),
        (2, {"collector": {"kind": "hogwild"}}, "collector.kind=hogwild has processes of its own"),
        (5, {}, "collector.num_envs=12 is not a multiple of the 5 ranks; give a multiple of 5"),
        (13, {}, "collector.num_envs=12 is fewer than the 13 ranks"),
        (
            2,
            {"name": "hindsight", "hindsight": {"batch_size": 9}},
            "hindsight.batch_size=9 is",
        ),
        (3, {"name": "replay_search"}, "algorithm.num_goals=4 is not a multiple of the 3"),
        (2, {"optim": {"kind": "a3c_rmsprop"}}, "optim.kind=a3c_rmsprop makes an update per environment"),
    ],
)
def test_what_ranks_cannot_share_is_refused_before_they_look_for_each_other(
    size: int, given: dict[str, Any], words: str
):
    chosen = settings(**given)
    with pytest.raises(ConfigError, match=words):
        check_ranks(chosen, size)
    named = {"WORLD_SIZE": str(size), "MASTER_ADDR": "nowhere.invalid", "MASTER_PORT": "1"}
    with pytest.raises(ConfigError, match=words), joined(chosen, {**named, "RANK": "0"}):
        pass
    with pytest.raises(RankError, match=words) as other, joined(chosen, {**named, "RANK": "1"}):
        pass
    assert other.value.is_quiet


def test_replay_is_shared_out_where_it_is_used():
    assert settings_of_rank(settings(), 2)["hindsight"]["batch_size"] == 24
    assert settings_of_rank(settings("hindsight"), 2)["hindsight"] == {"batch_size": 12, "capacity": 500}
    found = settings_of_rank(settings("replay_search"), 4)
    assert (found["algorithm"]["num_goals"], found["collector"]["num_envs"]) == (1, 3)


@pytest.mark.parametrize("environ", [{}, {"RANK": "0", "WORLD_SIZE": "1"}, {"WORLD_SIZE": "8"}])
def test_a_process_alone_is_alone(environ: dict[str, str]):
    with joined(settings(), {**environ, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "1"}) as ranks:
        assert type(ranks) is Ranks
        assert ranks.is_first


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("RANK", "one"),
        ("WORLD_SIZE", "2.0"),
        ("MASTER_PORT", "http"),
        ("LOCAL_RANK", "-1"),
        ("RANK", "2"),
        ("MASTER_PORT", "0"),
    ],
)
def test_variables_that_are_no_numbers_of_ranks(name: str, text: str):
    environ = {"RANK": "0", "WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "1", name: text}
    with (
        pytest.raises(ConfigError, match=f"the environment's {name} is '?{text}"),
        joined(settings(), environ),
    ):
        pass


@pytest.mark.parametrize(
    ("host", "reason"), [("nowhere.invalid", "(Name|name|address)"), ("127.0.0.1", "Connection refused")]
)
def test_an_address_that_does_not_answer_is_an_error_soon(
    host: str, reason: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(rendezvous, "REACH", 0.3)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    environ = {"RANK": "1", "WORLD_SIZE": "2", "MASTER_ADDR": host, "MASTER_PORT": str(port)}
    began = time.monotonic()
    with (
        pytest.raises(RankError, match=f"rank 1 of 2 does not find the others at {host}:{port} .*{reason}"),
        joined(settings(collector={"timeout": 0.6}), environ),
    ):
        pass
    assert time.monotonic() - began < 10.0


def part(first: int, episodes: float) -> dict[str, Any]:
    carrier = {"goal_id": torch.arange(first, first + 2), "next": {"x": torch.full((2, 1), first)}}
    collector = {"env": {"_": first}, "generator": first, "batch_size": [2], "carrier": carrier}
    meter = {"episodes": {"frames": torch.tensor(episodes)}, "terms": {"count": 1}}
    return {"algorithm": {"beta": first}, "collector": collector, "meter": meter, "rng": {"torch": first}}


def test_a_checkpoint_has_the_rows_of_all_ranks_and_each_gets_its_own_back():
    parts = [part(0, 5.0), part(10, 7.0), part(20, 0.0)]
    whole = merged(parts, 3, lambda states: states[0])
    assert whole["collector"]["batch_size"] == [6]
    assert whole["collector"]["carrier"]["goal_id"].tolist() == [0, 1, 10, 11, 20, 21]
    assert whole["meter"]["episodes"]["frames"] == 12.0
    for rank, expected in enumerate(parts):
        found = share(whole, rank, 3, lambda state, rank, size: state)
        torch.testing.assert_close(found["collector"], expected["collector"])
        assert found["rng"] == expected["rng"]
        assert found["meter"]["episodes"]["frames"] == (12.0 if rank == 0 else 0.0)
    second = share(whole, 1, 2, lambda state, rank, size: state)  # another number: draws begin anew
    assert second["collector"]["carrier"]["next"]["x"].flatten().tolist() == [10, 20, 20]
    assert (second["rng"], second["collector"]["generator"]) == (None, None)


def test_where_a_rank_is_gone_new_episodes_begin():
    seen: list[Any] = []
    whole = merged([part(0, 5.0)], 2, lambda states: seen.extend(states) or states[0])
    assert whole["collector"] == {}
    assert seen == [{"beta": 0}, None]
    assert share(whole, 1, 2, lambda state, rank, size: state)["rng"] is None


def test_graphs_join():
    one = {"successor": torch.tensor([[1, -1], [-1, -1]]), "scene_of": torch.tensor([0, 0])}
    two = {"successor": torch.tensor([[-1, 0], [-1, -1]]), "scene_of": torch.tensor([0, -1])}
    joint = merge_graphs([one, two])
    assert joint["successor"].tolist() == [[1, 0], [-1, -1]]
    assert joint["scene_of"].tolist() == [0, 0]


def test_advantages_are_normalized_over_all_ranks():
    batches = [torch.randn(4, 5, 1), 3 + 2 * torch.randn(4, 5, 1)]
    calls: list[list[torch.Tensor]] = [[], []]

    def statistic(rank: int, means: list[torch.Tensor]) -> Any:
        return lambda value: (calls[rank].append(value), means[len(calls[rank]) - 1])[1]

    whole = torch.cat(batches)
    means = [whole.mean(), (whole - whole.mean()).square().mean()]
    found = [_normalize_together(each, 1e-4, statistic(rank, means)) for rank, each in enumerate(batches)]
    torch.testing.assert_close(torch.cat(found), _normalize(whole, None, 1e-4, 0))
    for index, mean in enumerate(means):  # what the ranks average is what all have
        torch.testing.assert_close((calls[0][index] + calls[1][index]) / 2, mean)


def test_signals_are_left_alone_outside_the_main_thread():
    found = []

    def run() -> None:
        with StopOnSignal() as stop:
            found.append(stop.exit_code)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert found == [0]
