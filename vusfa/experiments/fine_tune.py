"""Training on from a trained agent, towards other goals."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

from torch import Tensor

from vusfa.evaluation import evaluate
from vusfa.evaluation.exact import expected_walks
from vusfa.evaluation.metrics import length_ratio
from vusfa.evaluation.tabulated import TabulatedPolicy
from vusfa.modules import ActingPolicy, sees_one_frame
from vusfa.scenes import SceneSet
from vusfa.training.setup import Training, make_training

__all__ = ["fine_tune", "fine_tuning_settings"]


def fine_tuning_settings(config: Mapping[str, Any], goals: Tensor, frames: int, seed: int) -> dict[str, Any]:
    """A training's settings, with other goals, from their start and for so many frames.

    Schedules that ended with the training end with this one.

    Args:
        config: plain, of a checkpoint.
        goals: (G,) global ids.
        frames: in all.
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
        state: a checkpoint's content, whose weights and multiplier are taken over; None trains from scratch.
        settings: see :func:`fine_tuning_settings`.
        scenes: the world.
        every: frames between two evaluations.
        episodes_per_goal: of an evaluation, from the same starts each time, for agents that see more than
            one frame; what one-frame agents do is computed, not sampled. Actions are drawn. An episode that
            does not arrive counts with all the actions that it was allowed.

    Returns:
        the curve: ``frames``, and at each ``length`` (actions), ``success`` and ``length_ratio``.
    """
    training = make_training(settings, scenes=scenes)
    session = training.session
    if state is not None:
        session.adopt(state)
    curve: dict[str, list[float]] = {key: [] for key in ("frames", "length", "success", "length_ratio")}

    def look() -> None:
        seen = _expected(training) if sees_one_frame(session.agent) else _walked(training, episodes_per_goal)
        for key, value in zip(curve, (float(session.frames), *seen), strict=True):
            curve[key].append(value)

    look()
    with session.collecting(training.make_collector) as batches:
        while session.frames < settings["total_frames"]:
            before = session.frames
            batch, terms = training.update(batches)
            session.count(batch, terms, 0.0)
            ended = session.frames >= settings["total_frames"]
            if ended or before // every < session.frames // every:
                look()
    return curve


def _expected(training: Training) -> tuple[float, float, float]:
    """Length, success and length over shortest path of an agent that sees one frame: computed."""
    session, steps = training.session, training.settings["env"]["max_steps"]
    policy = TabulatedPolicy(session.agent, session.scenes, session.goals)
    walks = expected_walks(policy.probabilities, session.scenes, session.goals, steps)
    return walks.length.mean().item(), walks.success.mean().item(), walks.length_ratio


def _walked(training: Training, episodes_per_goal: int) -> tuple[float, float, float]:
    """The same of any other: of episodes that are walked."""
    session = training.session
    table = evaluate(
        training.actor if session.agent.memory is not None else ActingPolicy(session.agent),
        session.scenes,
        session.goals,
        episodes_per_goal=episodes_per_goal,
        max_steps=training.settings["env"]["max_steps"],
        history=session.agent.config["history"],
        seed=0,
        observe=training.observation,
    )
    success, length = table.success, table.length
    mean_length, mean_success = length.double().mean().item(), success.double().mean().item()
    return mean_length, mean_success, length_ratio(success, length, table.shortest)
