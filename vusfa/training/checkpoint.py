"""Checkpoints: the whole state of a training in one file, written whole or not at all.

The file holds tensors and plain data only, so that it is read with ``torch.load(weights_only=True)``: opening
a checkpoint runs no code, wherever it comes from. :class:`torchrl.checkpoint.Checkpoint` was looked at and
left: it writes a folder or archive of components, each restored by its own adapter, where here one mapping
says what differs before anything is restored. Files of version 0.1 are converted when read
(:mod:`vusfa.training.upgrade`). The entries:

=========================  ==================================================================================
``format``                 version of this layout
``frames``, ``updates``    how far the training has come; the learning rate is a function of the frames
``seconds``                time spent
``agent_config``           what :func:`vusfa.modules.make_agent` needs besides the scenes
``agent``                  the agent's ``state_dict``
``scenes``                 where they are, seen from here, their names, and the set's fingerprint
``goals``                  (G,) global ids of the goals trained on
``config``                 all settings, resolved: those that a resumed run continues with
``overrides``              the command line that made them, to be read; it is never run
``optimizer``              its state
``algorithm``              what it has learned besides the agent: multiplier, replay buffer
``collector``              environments and the frame they stand at (:mod:`vusfa.training.collectors`)
``meter``                  sums of the episodes since the last line of the log
``rng``                    random states: torch, CUDA, numpy, Python
``run_id``                 what the loggers call the run
``validation``             best score, frames and seconds of the evaluations during the training (optional)
=========================  ==================================================================================
"""

from __future__ import annotations

import copy
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from vusfa.conf.settings import flat, lazily
from vusfa.envs.scene_env import usable_device
from vusfa.errors import CheckpointError, SceneError, VusfaError
from vusfa.files import replacing
from vusfa.limits import brief, listing, one_line
from vusfa.modules import Agent, AgentConfig, make_agent
from vusfa.scenes import SceneSet
from vusfa.training.content import NO_VALIDATION, check_entries, check_like, mended, read_content
from vusfa.training.scene_files import find_given, find_sources, with_goals
from vusfa.training.upgrade import upgrade

__all__ = [
    "FORMAT",
    "check_fits",
    "check_scenes",
    "check_setting",
    "checkpoint_file",
    "differences",
    "load_agent",
    "load_checkpoint",
    "load_optimizer",
    "load_weights",
    "rebuild_agent",
    "save_checkpoint",
    "saved_agent",
]

FORMAT = 2
# entries of Agent.config that describe the scenes, not the agent
_OF_SCENES = ("scenes", "fingerprint", "num_actions")
# settings whose other wording changes nothing: scenes and goals are compared by their content
_REWORDED = ("resume", "scenes", "folder", "overwrite", "name", "env.goals")


def save_checkpoint(path: str | Path, state: Mapping[str, Any]) -> Path:
    """Write a checkpoint atomically.

    Args:
        path: where to; replaced if it exists.
        state: the entries of this module's table, ``format`` aside.

    >>> import tempfile
    >>> save_checkpoint(Path(tempfile.mkdtemp()) / "run" / "a.pt", {"frames": 5}).name
    'a.pt'
    """
    with replacing(path) as unfinished:
        try:
            with open(unfinished, "wb") as file:
                torch.save({"format": FORMAT, **state}, file)
        except RuntimeError as error:  # torch's own, after a disk that is full
            if isinstance(error.__context__, OSError):
                raise error.__context__ from error
            raise
    return Path(path)


def checkpoint_file(path: str | Path) -> Path:
    """The checkpoint itself, or that of a run's folder."""
    return Path(path, "checkpoint.pt") if os.path.isdir(path) else Path(path)


def load_checkpoint(path: str | Path, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Read a checkpoint; no code in it is run.

    Args:
        path: a file that :func:`save_checkpoint` wrote, or the folder of a run.
        device: where its tensors go.

    Raises:
        CheckpointError: there is no such file, it is damaged, or it is no checkpoint of this package.
    """
    path, device = checkpoint_file(path), usable_device(device)
    if not os.path.isfile(path):  # Path.is_file raises in a folder that may not be looked into
        raise CheckpointError(f"{path}: no such checkpoint; vusfa train writes RUN/checkpoint.pt")
    state = read_content(path, device)
    for name, kind in {"agent_config": dict, "format": int}.items():
        if not isinstance(state, dict) or type(state.get(name)) is not kind:
            raise CheckpointError(
                f"{path}: no checkpoint of vusfa ({name!r} is missing); give one of vusfa train"
            )
    if state.get("format") == 1:
        try:
            state = upgrade(state)
        except CheckpointError as error:
            raise CheckpointError(f"{path}: {error}") from error
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            raise mended(path, f"of version 0.1, but not as that wrote it ({error!r})") from error
    if state.get("format") != FORMAT:
        raise CheckpointError(
            f"{path}: checkpoint of format {brief(state.get('format'))}, this version reads 1 and"
            f" {FORMAT}; use the version that wrote it"
        )
    state.setdefault("validation", dict(NO_VALIDATION))
    check_entries(path, state)
    state["scenes"]["sources"] = find_sources(state["scenes"]["sources"], path)
    state["config"] = with_goals(state["config"], lambda source: find_given(source, path))
    return state


def check_setting(path: str | Path, name: str, saved: Any, wanted: Any) -> None:
    """Check that a checkpoint was saved with a setting's present value.

    >>> check_setting("a.pt", "agent.model", "usfa", "vusfa")
    Traceback (most recent call last):
    ...
    vusfa.errors.CheckpointError: a.pt: saved with agent.model=usfa, not vusfa; leave the setting out, or
        start a new run
    """
    if saved != wanted:
        raise CheckpointError(
            f"{path}: saved with {name}={saved}, not {wanted}; leave the setting out, or start a new run"
        )


def check_scenes(path: str | Path, saved: Mapping[str, Any], scenes: SceneSet) -> None:
    """Check that a checkpoint's scenes are these, number for number.

    Raises:
        CheckpointError: other scenes, or scenes of the same names with other content.
    """
    if list(saved["names"]) != list(scenes.names):
        raise CheckpointError(
            f"{path}: trained in {listing(saved['names'])}, not in {listing(scenes.names)};"
            " give it its own scenes"
        )
    if saved["fingerprint"] != scenes.fingerprint:
        raise CheckpointError(
            f"{path}: its scenes are called {listing(scenes.names)}, too, but their graphs or features"
            " have changed since; give it the files that it was trained on"
        )


def check_fits(
    path: str | Path, state: Mapping[str, Any], scenes: SceneSet, goals: Tensor, agent: Agent
) -> None:
    """Refuse a checkpoint of other scenes, goals, or an agent of another shape.

    Raises:
        CheckpointError: naming what differs.
    """
    check_scenes(path, state["scenes"], scenes)
    for key, value in agent.config.items():
        if key not in _OF_SCENES:
            default = getattr(AgentConfig, key, None)  # of a field that is younger than the checkpoint
            check_setting(path, f"agent.{key}", state["agent_config"].get(key, default), value)
    check_setting(path, "env.goals", state["goals"].tolist(), goals.tolist())


def differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Describe the settings that differ, one line each.

    >>> differences({"optim": {"lr": 0.1}}, {"optim": {"lr": 0.2}})
    ['optim.lr=0.2 instead of 0.1']
    """
    old, new = flat(before), flat(now)
    keys = [key for key in old.keys() | new.keys() if old.get(key) != new.get(key)]
    return [f"{key}={new.get(key)} instead of {old.get(key)}" for key in sorted(keys) if key not in _REWORDED]


def rebuild_agent(config: Mapping[str, Any], scenes: SceneSet) -> Agent:
    """An untrained agent of the shape that :attr:`vusfa.modules.Agent.config` describes.

    >>> scenes = SceneSet.bundled(["bathroom"])
    >>> agent = make_agent("gvf", scenes=scenes, hidden_size=8, embedding_size=8)
    >>> rebuild_agent(agent.config, scenes).config == agent.config
    True
    """
    return make_agent(scenes=scenes, **{k: v for k, v in config.items() if k not in _OF_SCENES})


def load_agent(
    path: str | Path, scenes: SceneSet | None = None, device: torch.device | str = "cpu"
) -> tuple[Agent, SceneSet, dict[str, Any]]:
    """The agent of a checkpoint, in evaluation mode, with its scenes.

    Args:
        path: the checkpoint.
        scenes: the scenes that it was trained in; opened as they were then, when not given.
        device: where the agent and the scenes' tables go.

    Returns:
        agent, scenes and the checkpoint's content.

    Raises:
        CheckpointError: the file is damaged, or of other scenes.
        SceneError: its scenes are not where they were.
    """
    state = load_checkpoint(path, device)
    if scenes is None:
        try:
            scenes = SceneSet.open(state["scenes"]["sources"], lazy=lazily(state["config"]))
        except SceneError as error:
            raise SceneError(
                f"{error}; if the scenes of {path} have moved, put them beside it or give them as scenes"
            ) from error
    scenes = scenes.to(device)
    return saved_agent(path, state, scenes), scenes, state


def saved_agent(path: str | Path, state: Mapping[str, Any], scenes: SceneSet) -> Agent:
    """The agent of a checkpoint's content, in evaluation mode; errors of :func:`load_agent`."""
    check_scenes(path, state["scenes"], scenes)
    goals = state["goals"]
    if not bool(((goals >= 0) & (goals < scenes.num_states)).all()):
        raise mended(path, f"its entry 'goals' names states beyond the {scenes.num_states} of its scenes")
    try:
        agent = rebuild_agent(state["agent_config"], scenes).to(scenes.device)
    except VusfaError as error:
        raise CheckpointError(f"{path}: {error}") from error
    except (TypeError, ValueError, KeyError, AttributeError, IndexError, RuntimeError) as error:
        raise mended(path, f"no agent can be made of its entry 'agent_config' ({one_line(error)})") from error
    load_weights(agent, state, path)
    return agent.eval()


def load_weights(agent: Agent, state: Mapping[str, Any], path: str | Path) -> None:
    """Put a checkpoint's weights into an agent; those of another model raise a CheckpointError."""
    try:
        check_like(path, "agent", state["agent"], agent.state_dict())
    except CheckpointError as error:
        raise CheckpointError(f"{error} (it was read as a {agent.config['model']} agent)") from error
    agent.load_state_dict(state["agent"])


def load_optimizer(optimizer: torch.optim.Optimizer, state: Mapping[str, Any], path: str | Path) -> None:
    """Load the optimizer's moments; its learning rate and options stay as they are.

    Raises:
        CheckpointError: it is another optimizer's, or not of these parameters' shapes.
    """
    saved, settings = state["optimizer"], [dict(group) for group in optimizer.param_groups]
    groups = saved["param_groups"]
    if len(groups) != len(settings) or not all(isinstance(group, dict) for group in groups):
        raise mended(path, f"its entry 'optimizer.param_groups' has not {len(settings)} groups")
    if groups[0].keys() != settings[0].keys():
        raise CheckpointError(
            f"{path}: its optimizer is not a {type(optimizer).__name__}; leave the setting out,"
            " or start a new run"
        )
    expected = _stepped(optimizer)
    for index, group in enumerate(expected["param_groups"]):
        if groups[index]["params"] != group["params"]:
            raise mended(path, f"its entry 'optimizer.param_groups.{index}.params' is of other parameters")
    for index, moments in saved["state"].items():  # a parameter without a gradient has none
        if index not in expected["state"]:
            raise mended(path, f"its entry 'optimizer.state.{brief(index)}' is of no parameter")
        check_like(path, f"optimizer.state.{index}", moments, expected["state"][index])
    optimizer.load_state_dict(saved)
    for group, numbers in zip(optimizer.param_groups, settings, strict=True):
        group.update({key: value for key, value in numbers.items() if key != "params"})


def _stepped(optimizer: torch.optim.Optimizer) -> dict[str, Any]:
    """State of a copy of an optimizer after a step: the shapes that a saved one must have. A fused optimizer
    reads past the end of a shorter tensor."""
    probe = copy.deepcopy(optimizer)
    for group in probe.param_groups:
        for param in group["params"]:
            param.grad = torch.zeros_like(param)
    probe.step()
    return probe.state_dict()
