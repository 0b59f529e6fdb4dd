"""The same agent, handed features instead of ids: 1280 floats a frame travel where ours sends one integer."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager

from benchmarks.trainer import Running, running
from vusfa.scenes import SceneSet

__all__ = ["feature_fed"]


def feature_fed(
    overrides: Sequence[str] = (), scenes: SceneSet | None = None
) -> AbstractContextManager[Running]:
    """The recipe's training with ``agent.observation=features``, its own way to be fed so."""
    return running([*overrides, "agent.observation=features"], scenes)
