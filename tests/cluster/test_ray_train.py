"""``vusfa train cluster=ray``: a node of the learners is killed; the job goes on from the last checkpoint."""

from __future__ import annotations

import csv
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from tests.cluster.conftest import MEMORY
from vusfa.cli.launch import compose
from vusfa.cli.ray_train import train_on_ray
from vusfa.cluster.ray_workers import connected
from vusfa.errors import ConfigError
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


@pytest.mark.skipif(
    not os.environ.get("VUSFA_LONG"), reason="takes half a minute and more; part of make faults"
)
@pytest.mark.filterwarnings("ignore::ResourceWarning")  # Ray leaves files of logs to Python
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.filterwarnings("ignore::DeprecationWarning:ray")
@pytest.mark.filterwarnings("ignore::FutureWarning:ray")
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
        writer = (folder / ".lock").read_text().split()[0]
        raylet = int(Path(f"/proc/{writer}/stat").read_text().rpartition(")")[2].split()[1])
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
    with open(folder / "metrics.csv", newline="") as file:
        frames = [int(float(row["frames"])) for row in csv.DictReader(file)]
    assert frames == list(range(2400, 16801, 2400))  # no line is missing and none is there twice


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
