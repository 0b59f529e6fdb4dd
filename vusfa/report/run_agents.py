"""The agents of a report's runs: from checkpoints, and those that come with the package."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

from torch import Tensor

from vusfa.deploy.agents import PRETRAINED, load_pretrained, pretrained_names, read_agent
from vusfa.deploy.cards import card_head
from vusfa.evaluation import evaluate
from vusfa.modules import Agent, InferencePolicy, TabularPolicy
from vusfa.report.curve import read_metrics
from vusfa.report.runs import LoggedRun
from vusfa.scenes import Scene, SceneSet
from vusfa.training.checkpoint import load_checkpoint, saved_agent

__all__ = ["SavedAgent", "open_agent_of", "pretrained_of", "pretrained_run"]

_EPISODES = 2  # per goal


class SavedAgent(NamedTuple):
    """An agent with what a page shows of it.

    Attributes:
        agent: in evaluation mode.
        scenes: those of its training.
        goals: (G,) global ids of its trained goals.
        frames: length of its training.
        gamma: its discount; None if unknown.
    """

    agent: Agent
    scenes: SceneSet
    goals: Tensor
    frames: int | None
    gamma: float | None


def open_agent_of(run: LoggedRun, opened: Mapping[str, Scene]) -> SavedAgent:
    """The agent of a run's checkpoint, or of a safetensors file.

    Args:
        run: one with a checkpoint.
        opened: the scenes by name, see :func:`~vusfa.report.run_scenes.open_scenes`.

    Raises:
        CheckpointError: it cannot be read.
    """
    assert run.checkpoint is not None
    frames = None if math.isnan(run.frames) else int(run.frames)
    if run.checkpoint.suffix == ".safetensors":
        world = SceneSet([opened[name] for name in run.scenes])
        found = read_agent(run.checkpoint, world)
        return SavedAgent(found.agent, found.scenes, found.goals, frames, _gamma(run.settings))
    state = load_checkpoint(run.checkpoint)
    scenes = SceneSet([opened[name] for name in state["scenes"]["names"]])
    agent = saved_agent(run.checkpoint, state, scenes)
    return SavedAgent(agent, scenes, state["goals"], state["frames"], _gamma(state.get("config", {})))


def pretrained_run(name: str, label: str = "") -> LoggedRun:
    """An agent of the package as a run: evaluated now, with every state as a goal.

    Args:
        name: of ``vusfa pretrained list``.
        label: "NAME (pretrained)" by default.

    Raises:
        ConfigError: there is no agent of this name, or safetensors is missing.
    """
    agent, scenes, goals, card = load_pretrained(name)
    facts = card_head(card)["vusfa"]
    policy = TabularPolicy(agent, scenes) if agent.is_tabular else InferencePolicy(agent)
    asked: dict[str, Any] = {"episodes_per_goal": _EPISODES, "history": agent.config["history"]}
    episodes = evaluate(policy, scenes, trained=goals, **asked)
    log = PRETRAINED / f"{name}.csv"
    config = {"model": facts["model"], "history": agent.config["history"]}
    return LoggedRun(
        label or f"{name} (pretrained)",
        facts["seed"],
        PRETRAINED / name,
        {"agent": config, "scenes": list(scenes.names)},
        read_metrics(log) if log.is_file() else {},
        episodes,
        checkpoint=PRETRAINED / f"{name}.safetensors",
        facts={"frames": facts["frames"], "seconds": facts["training_s"]},
        fingerprint=facts["scenes_fingerprint"],
    )


def pretrained_of(run: LoggedRun) -> LoggedRun:
    """A run of results with the package's own agent, where that is of the very same training.

    Frames and seconds identify a training: no two took the same time to a tenth of a second.
    """
    if run.checkpoint is not None:
        return run
    for name in pretrained_names():
        facts = card_head((PRETRAINED / f"{name}.md").read_text(encoding="utf-8"))["vusfa"]
        here = {"frames": facts["frames"], "seconds": facts["training_s"]}
        if facts["seed"] == run.seed and here == dict(run.facts):
            log = PRETRAINED / f"{name}.csv"
            curves = run.curves or (read_metrics(log) if log.is_file() else {})
            return replace(run, checkpoint=PRETRAINED / f"{name}.safetensors", curves=curves)
    return run


def _gamma(settings: Mapping[str, Any]) -> float | None:
    objective = settings.get("objective")
    found = objective.get("gamma") if isinstance(objective, Mapping) else None
    return float(found) if isinstance(found, int | float) else None
