"""Fine-tuning of a trained agent towards other goals."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

from torch import Tensor

from vusfa.experiments.measure import measure_goals
from vusfa.scenes import SceneSet
from vusfa.training import make_trainer

__all__ = ["fine_tune", "fine_tuning_settings"]


def fine_tuning_settings(config: Mapping[str, Any], goals: Tensor, frames: int, seed: int) -> dict[str, Any]:
    """Settings of a fine-tuning: other goals and another length.

    Schedules that ended with the training end with the fine-tuning.

    Args:
        config: settings of a checkpoint.
        goals: (G,) global ids.
        frames: length of the fine-tuning.
        seed: of everything.
    """
    settings = copy.deepcopy(dict(config))
    ended = settings["total_frames"]
    for part in ("optim", "entropy"):
        if settings[part]["horizon"] == ended:
            settings[part]["horizon"] = frames
    settings["env"]["goals"] = goals.tolist()
    settings |= {"total_frames": frames, "seed": seed, "resume": None}
    return settings


def fine_tune(
    state: Mapping[str, Any] | None,
    settings: Mapping[str, Any],
    scenes: SceneSet,
    *,
    every: int,
    episodes_per_goal: int = 5,
) -> dict[str, list[float]]:
    """Train and evaluate at intervals.

    Args:
        state: a checkpoint, whose weights and multiplier are loaded; None trains from scratch.
        settings: see :func:`fine_tuning_settings`.
        scenes: the world.
        every: frames between two evaluations.
        episodes_per_goal: per evaluation, from the same starts each time, for agents that see more than one
            frame; one-frame agents are evaluated exactly. Actions are sampled. A failed episode counts as
            ``max_steps`` actions.

    Returns:
        the curve: ``frames``, and at each ``length`` (actions), ``success`` and ``length_ratio``.
    """
    trainer = make_trainer(settings, scenes=scenes)
    if state is not None:
        trainer.load_weights(state)
    curve: dict[str, list[float]] = {key: [] for key in ("frames", "length", "success", "length_ratio")}

    def look() -> None:
        steps = settings["env"]["max_steps"]
        walks = measure_goals(trainer, trainer.goals, episodes_per_goal=episodes_per_goal, max_steps=steps)
        seen = walks.length.mean().item(), walks.success.mean().item(), walks.length_ratio
        for key, value in zip(curve, (float(trainer.frames), *seen), strict=True):
            curve[key].append(value)

    look()
    with trainer.collecting() as batches:
        while trainer.frames < settings["total_frames"]:
            before = trainer.frames
            trainer.update(batches)
            ended = trainer.frames >= settings["total_frames"]
            if ended or before // every < trainer.frames // every:
                look()
    return curve
