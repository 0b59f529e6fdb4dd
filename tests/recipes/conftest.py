"""Recipes run small: a room of 16 states, layers of 8."""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

RECIPES = Path(__file__).parents[2] / "recipes"


@pytest.fixture
def recipe(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Any]:
    """A recipe as a module, by name."""
    monkeypatch.syspath_prepend(str(RECIPES))
    yield import_module
    for path in RECIPES.glob("*.py"):
        sys.modules.pop(path.stem, None)


@pytest.fixture
def small(scene_file: Path) -> list[str]:
    """Overrides that make a training take a second."""
    return [
        f"scenes=[{scene_file}]",
        "env.goals=[3,9,12]",
        "env.max_steps=20",
        "env.goal_sampling=fixed",
        "agent.hidden_size=8",
        "agent.embedding_size=8",
        "agent.history=2",
        "collector.num_envs=6",
        "collector.rollout=4",
        "total_frames=480",
        "log_every=48",
        "checkpoint_every=1000000",
        "evaluation=none",
    ]
