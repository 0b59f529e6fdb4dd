"""Benchmarks are scripts beside the package: their folder's parent is put where imports look."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from vusfa.cli.launch import compose  # noqa: F401  (Hydra is needed: say so here, not in each test)

sys.path.insert(0, str(Path(__file__).parents[2]))


@pytest.fixture
def tiny() -> Callable[..., list[str]]:
    """Overrides of the recipe that make an update take milliseconds."""

    def made(*more: str) -> list[str]:
        sizes = ["agent.hidden_size=8", "agent.embedding_size=8"]
        counts = ["collector.num_envs=6", "collector.rollout=4", "env.max_steps=9"]
        return ["scenes=[bathroom,bedroom]", *sizes, *counts, *more]

    return made
