"""``vusfa train cluster=ray``: a node of the learners is killed; the job goes on from the last checkpoint."""

from __future__ import annotations

import csv
import os
import signal
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from tests.cluster.conftest import MEMORY
from vusfa.cli import ray_train
from vusfa.cli.launch import compose
from vusfa.cli.ray_train import _check_free, _learn, train_on_ray
from vusfa.cluster.locks import FileLock
from vusfa.cluster.ray_workers import connected
from vusfa.errors import ConfigError
from vusfa.experiments.training import train
from vusfa.training import load_checkpoint

SMALL = [
    "cluster=ray",
    "agent.hidden_size=8",
    "agent.embedding_size=8",
    "agent.history=1",
    "env.goals=[3,9,12]",
]
SMALL += ["collector.num_envs=6", "collector.rollout=4", "evaluation=none", "autocast=false"]


def settings(*overrides: str) -> dict[str, Any]:
    plain: Any = OmegaConf.to_container(compose(overrides=[*SMALL, *overrides]), resolve=True)
    return plain


LONG = pytest.mark.skipif(
    not os.environ.get("VUSFA_LONG"), reason="takes half a minute and more; part of make faults"
)


def _of_ray(test: Callable[..., None]) -> Callable[..., None]:
    """A test with Ray, which leaves files of logs to Python, and warns."""
    for ignored in (
        "ignore::ResourceWarning",
        "ignore::pytest.PytestUnraisableExceptionWarning",
        "ignore::DeprecationWarning:ray",
        "ignore::FutureWarning:ray",
    ):
        test = pytest.mark.filterwarnings(ignored)(test)
    return test


def logged_frames(folder: Path) -> list[int]:
    with open(folder / "metrics.csv", newline="") as file:
        return [int(float(row["frames"])) for row in csv.DictReader(file)]


@LONG
@_of_ray
def test_two_workers_make_the_updates_of_two_ranks_and_a_killed_one_is_replaced(
    two_nodes: Callable[..., Any], tmp_path: Path, scene_file: Path
) -> None:
    """Numbers of two ranks, evaluations included; then a run of which a worker is killed."""
    cluster, given = two_nodes(), [f"scenes=[{scene_file}]", "evaluation=trained", "evaluation.interval=48"]
    given += ["evaluation.max_steps=30", "evaluation.episodes_per_goal=100", "log_every=24"]
    where = [f"cluster.address={cluster.address}", "cluster.workers=2"]
    cluster.stack.enter_context(connected(cluster.address))
    assert train_on_ray(settings(*given, *where, "total_frames=144", f"folder={tmp_path / 'ray'}")) == 0
    of_two_ranks(settings(*given, "total_frames=144", f"folder={tmp_path / 'ranks'}"))
    found, expected = (load_checkpoint(tmp_path / name) for name in ("ray", "ranks"))
    for part in ("frames", "updates", "agent", "algorithm", "collector"):
        torch.testing.assert_close(found[part], expected[part], rtol=0, atol=0)
    assert len(found["ranks"]) == 2
    for name in ("evaluation.csv", "evaluation_episodes.csv", "validation.csv"):
        assert (tmp_path / "ray" / name).read_bytes() == (tmp_path / "ranks" / name).read_bytes(), name

    folder, at = tmp_path / "killed", []

    def kill() -> None:
        """A worker of the job that does not write."""
        deadline = time.monotonic() + 90
        while not (folder / "checkpoint.pt").exists() and time.monotonic() < deadline:
            time.sleep(0.05)
        writer = int((folder / ".lock").read_text().split()[0])
        found = workers(cluster)
        others = [process for process in found if process != writer]
        assert writer in found
        assert len(others) == 1
        os.kill(others[0], signal.SIGKILL)
        at.append(load_checkpoint(folder / "checkpoint.pt")["frames"])

    killer = threading.Thread(target=kill)
    killer.start()
    long = ["total_frames=16800", "log_every=2400", "checkpoint_every=240", "evaluation=none"]
    assert train_on_ray(settings(*given[:1], *where, *long, f"folder={folder}")) == 0
    killer.join()
    assert 0 < at[0] < 16800
    assert load_checkpoint(folder / "checkpoint.pt")["frames"] == 16800
    assert logged_frames(folder) == list(range(2400, 16801, 2400))


def parent(process: int) -> int:
    return int(Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[1])


def workers(cluster: Any) -> list[int]:
    """Processes of the workers of a Ray Train job on a cluster."""
    nodes = (cluster.head_node, cluster.other)
    raylets = {node.all_processes["raylet"][0].process.pid for node in nodes}
    found = []
    for place in Path("/proc").iterdir():
        with suppress(OSError):
            if place.name.isdecimal() and b"RayTrainWorker" in (place / "cmdline").read_bytes():
                found.append(int(place.name))
    return [process for process in found if parent(process) in raylets]


def of_two_ranks(chosen: dict[str, Any]) -> None:
    """A training of two ranks, processes of this machine."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    names = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    begun = []
    for rank in ("0", "1"):
        process = torch.multiprocessing.get_context("spawn").Process(
            target=_be_rank, args=(chosen, {**names, "RANK": rank})
        )
        process.start()
        begun.append(process)
    for process in begun:
        process.join()
        assert process.exitcode == 0


def _be_rank(chosen: dict[str, Any], environ: dict[str, str]) -> None:
    os.environ.update(environ)
    train(chosen)


@LONG
@_of_ray
def test_a_job_whose_node_is_killed_goes_on_from_the_last_checkpoint(
    two_nodes: Callable[..., Any], tmp_path: Path, scene_file: Path
) -> None:
    cluster, folder, at = two_nodes(head=0), tmp_path / "run", []
    nodes = [cluster.other, cluster.add_node(num_cpus=1, object_store_memory=MEMORY)]

    def kill() -> None:
        """The node of the rank that writes the folder."""
        deadline = time.monotonic() + 90
        while not (folder / "checkpoint.pt").exists() and time.monotonic() < deadline:
            time.sleep(0.05)
        raylet = parent(int((folder / ".lock").read_text().split()[0]))
        (node,) = (each for each in nodes if each.all_processes["raylet"][0].process.pid == raylet)
        cluster.remove_node(node, allow_graceful=False)
        at.append(load_checkpoint(folder / "checkpoint.pt")["frames"])

    cluster.stack.enter_context(connected(cluster.address))
    killer = threading.Thread(target=kill)
    killer.start()
    chosen = settings(
        f"scenes=[{scene_file}]",
        f"folder={folder}",
        f"cluster.address={cluster.address}",
        "cluster.workers=1",
        "total_frames=16800",
        "log_every=2400",
        "checkpoint_every=240",
    )
    assert train_on_ray(chosen) == 0
    killer.join()
    assert 0 < at[0] < 16800
    assert load_checkpoint(folder / "checkpoint.pt")["frames"] == 16800
    assert logged_frames(folder) == list(
        range(2400, 16801, 2400)
    )  # no line is missing and none is there twice


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("cluster.kind=rai", "cluster.kind is 'rai'; it must be ray or null"),
        ("cluster.workers=4", "collector.num_envs=6 is not a multiple of the 4 ranks"),
        ("cluster.workers=0", "cluster.workers is 0; it must be 1 or more"),
        ("cluster.min_workers=3", "cluster.min_workers is 3; it must be 1 to cluster.workers"),
        ("cluster.max_failures=-1", "cluster.max_failures is -1; it must be 0 or more"),
        ("cluster.address=nowhere", "the Ray address is 'nowhere'"),
    ],
)
def test_what_a_job_refuses(tmp_path: Path, override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        train_on_ray(settings(f"folder={tmp_path / 'run'}", override))
    assert not (tmp_path / "run").exists()


def test_a_folder_that_another_run_writes_to_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    _check_free(folder)  # there is none yet
    folder.mkdir()
    _check_free(folder)
    with (
        FileLock(folder / ".lock"),
        pytest.raises(ConfigError, match=f"where process {os.getpid()} is writing a run"),
    ):
        _check_free(folder)
    assert not list(folder.iterdir())


def test_only_a_restarted_worker_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From a checkpoint that is not the one of before; an old run that was replaced is not looked for."""
    resumed: list[str | None] = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(ray_train, "train", lambda settings, *_: resumed.append(settings["resume"]))
    path = tmp_path / "checkpoint.pt"
    begun = {"settings": {"folder": str(tmp_path), "resume": None}, "cwd": str(tmp_path)}
    begun |= {"overrides": [], "draw": None}
    _learn({**begun, "checkpoint": None})
    _learn({**begun, "checkpoint": 5})
    path.write_bytes(b"new")
    _learn({**begun, "checkpoint": 5})
    _learn({**begun, "checkpoint": path.stat().st_mtime_ns})
    assert resumed == [None, None, str(path), None]
