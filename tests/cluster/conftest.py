"""A Ray cluster of two nodes on this machine."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
MEMORY = 80 * 1024**2  # of a node's object store
#: A node that is killed is missed within a second.
FAST = {
    "health_check_initial_delay_ms": 0,
    "health_check_period_ms": 300,
    "health_check_failure_threshold": 3,
}


@pytest.fixture
def two_nodes(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Any]]:
    """Starts a cluster, whose first node has so many processors and the other one; ended with the test."""
    for name, value in {
        "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep),
        "OMP_NUM_THREADS": "1",
        "RAY_USAGE_STATS_ENABLED": "0",
        "RAY_DEDUP_LOGS": "0",
    }.items():
        monkeypatch.setenv(name, value)
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    with ExitStack() as stack:

        def start(head: int = 1) -> Any:
            from ray.cluster_utils import Cluster

            first = {"num_cpus": head, "object_store_memory": MEMORY, "include_dashboard": False}
            first |= {"include_log_monitor": False, "no_monitor": True}
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", ResourceWarning)
                cluster = Cluster(initialize_head=True, head_node_args={**first, "_system_config": FAST})
                stack.callback(cluster.shutdown)
                cluster.other = cluster.add_node(num_cpus=1, object_store_memory=MEMORY)
            cluster.stack = stack  # contexts that end before the cluster
            return cluster

        yield start
