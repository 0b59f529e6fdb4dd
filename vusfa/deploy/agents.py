"""Trained agents by what they are stored in: a checkpoint, a safetensors file, or a pretrained name."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from vusfa.modules import Agent
from vusfa.scenes import SceneSet
from vusfa.training import load_agent

__all__ = ["TrainedAgent", "open_agent"]


class TrainedAgent(NamedTuple):
    """An agent with the rooms that it was trained in.

    Attributes:
        agent: in evaluation mode.
        scenes: the rooms.
        goals: (G,) int64, global ids of the goals trained on.
    """

    agent: Agent
    scenes: SceneSet
    goals: Tensor


def open_agent(source: str | os.PathLike[str], scenes: SceneSet | None = None) -> TrainedAgent:
    """Load a trained agent.

    Args:
        source: a checkpoint of ``vusfa train``; a .safetensors file; or a name of ``vusfa pretrained list``.
        scenes: those that it was trained in; opened as they were then, when not given.

    Raises:
        CheckpointError: the file is missing, damaged, or of other scenes.
        SceneError: its scenes are not where they were.
    """
    agent, scenes, state = load_agent(Path(source), scenes)
    return TrainedAgent(agent, scenes, state["goals"])
