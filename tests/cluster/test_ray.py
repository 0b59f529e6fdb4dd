"""A Ray cluster of two nodes, one of which is killed: cells and collectors."""

from __future__ import annotations

import socket
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

import vusfa.cluster  # noqa: F401
from tests.cluster import work
from vusfa.cli.launch import compose
from vusfa.cluster.cells import Cell, run_cells
from vusfa.cluster.locks import FileLock, LockedError
from vusfa.cluster.ray_workers import check_ray_address, connected
from vusfa.errors import ConfigError, WorkerError
from vusfa.training import make_trainer

SMALL = ["agent.hidden_size=8", "agent.embedding_size=8", "agent.history=1", "env.goals=[3,9,12]"]
SMALL += ["collector.num_envs=6", "collector.rollout=4", "total_frames=1000000", "evaluation=none"]


def settings(*overrides: str) -> dict[str, Any]:
    plain: Any = OmegaConf.to_container(compose(overrides=[*SMALL, *overrides]), resolve=True)
    return plain


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def is_free(path: Path) -> bool:
    """Whether no process holds a lock: its holder has ended."""
    try:
        with FileLock(path):
            return True
    except LockedError:
        return False


def lines(log: Path, word: str) -> list[list[str]]:
    if not log.exists():
        return []
    return [line.split() for line in log.read_text().splitlines() if line.startswith(word)]


@pytest.mark.filterwarnings("ignore::ResourceWarning")  # Ray leaves files of logs to Python
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_node_is_killed_and_every_cell_is_done_once(
    two_nodes: Callable[..., Any], tmp_path: Path, scene_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Then a cluster of two collects."""
    cluster, log, gate = two_nodes(), tmp_path / "log", tmp_path / "gate"
    some = [Cell(tmp_path / name, partial(work.make, tmp_path / name, log, gate)) for name in "abcdef"]

    def kill() -> None:
        wait_until(lambda: len(lines(log, "begin")) == 2)  # one on each node
        cluster.remove_node(cluster.other, allow_graceful=False)
        wait_until(lambda: any(is_free(tmp_path / f".{name}.lock") for _, name, *_ in lines(log, "begin")))
        gate.touch()

    cluster.stack.enter_context(connected(cluster.address))
    killer = threading.Thread(target=kill)
    killer.start()
    run_cells(some, "ray", [f"address={cluster.address}"])
    killer.join()
    begun = Counter(name for _, name, *_ in lines(log, "begin"))
    assert Counter(name for _, name in lines(log, "end")) == Counter("abcdef")
    assert sorted(begun.values()) == [1, 1, 1, 1, 1, 2]
    assert len({raylet for _, _, raylet, _ in lines(log, "begin")}) == 2
    assert {threads for *_, threads in lines(log, "begin")} == {"1"}
    printed = [line for line in capsys.readouterr().out.splitlines() if line.startswith("made")]
    assert sorted(printed) == [f"made {name}" for name in "abcdef"]

    other = cluster.add_node(num_cpus=1, object_store_memory=80 * 1024**2)
    fixed = ["env.goal_sampling=fixed", f"scenes=[{scene_file}]"]
    trainer = make_trainer(settings(*fixed, "collector=ray", f"collector.address={cluster.address}"))
    with trainer.collecting() as batches:
        trainer.update(batches)
        sent = {name: value.detach().clone() for name, value in trainer.acting.named_parameters()}
        batch, terms = trainer.update(batches)
        assert batch.shape == (6, 4)
        assert batch["goal_id"][:, 0].tolist() == [3, 9, 12, 3, 9, 12]  # as in one process
        assert all(bool(value.isfinite().all()) for value in terms.values())
        workers: Any = trainer._collector
        for state in workers._collector.map_fn("policy.state_dict"):
            assert all(torch.equal(state[name], sent[name]) for name in sent)
        cluster.remove_node(other, allow_graceful=False)
        with pytest.raises(WorkerError, match="a worker of the collector has ended"):
            trainer.update(batches)


@pytest.fixture
def deaf() -> Iterator[int]:
    """A port whose owner says nothing."""
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        server.listen()
        yield server.getsockname()[1]


def test_an_address_that_nobody_answers(tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    began = time.monotonic()
    with pytest.raises(ConfigError) as error:
        run_cells([Cell(tmp_path / "a", partial(work.fail, "a"))], "ray", [f"address=127.0.0.1:{port}"])
    assert str(error.value) == (
        f"no Ray cluster answers at '127.0.0.1:{port}' (Connection refused); begin one with ray start --head,"
        " or give another address"
    )
    assert time.monotonic() - began < 5
    trainer = make_trainer(settings("collector=ray", f"collector.address=127.0.0.1:{port}"))
    with pytest.raises(ConfigError, match="no Ray cluster answers"), trainer.collecting():
        pass


def test_an_address_where_something_else_answers(deaf: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vusfa.cluster.ray_workers._RAY_ANSWER", 1.0)
    with pytest.raises(ConfigError, match=r"what answers at .* is no Ray cluster"):
        check_ray_address(f"127.0.0.1:{deaf}")


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("10.0.0.1", "give HOST:PORT, such as 10.0.0.1:6379"),
        ("here:there", "give HOST:PORT"),
        ("here:99999", "give HOST:PORT"),
        (":6379", "give HOST:PORT"),
        ("ray://head:10001", "of Ray's client; give HOST:6379"),
        ("no.such.host.invalid:6379", "no Ray cluster answers at 'no.such.host.invalid:6379'"),
        ("x" * 5000, "give HOST:PORT"),
    ],
)
def test_addresses_that_are_none(address: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as error:
        check_ray_address(address)
    assert len(str(error.value)) < 300


def test_the_address_of_the_environment_is_checked_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "nowhere")
    with pytest.raises(ConfigError, match="the Ray address is 'nowhere'"), connected():
        pass


def test_without_ray_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    trainer = make_trainer(settings("collector=ray"))
    with pytest.raises(ConfigError, match=r"pip install 'vusfa\[cluster\]'"), trainer.collecting():
        pass
