"""Loading of trained agents from a checkpoint, a safetensors file, or by a pretrained name.

A safetensors file holds the agent's ``state_dict`` as float16 and, as text in its header, what
:func:`vusfa.modules.make_agent` needs, the names and the fingerprint of its scenes, and its trained goals.
Opening one runs no code.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from vusfa import __version__
from vusfa.errors import CheckpointError, ConfigError, near
from vusfa.files import replacing
from vusfa.limits import MAX_JSON_BYTES, brief
from vusfa.modules import Agent
from vusfa.scenes import SceneSet
from vusfa.training import load_agent
from vusfa.training.checkpoint import saved_agent
from vusfa.training.content import check_sizes
from vusfa.training.scene_files import find_sources, opened_from, scene_sources

__all__ = [
    "PRETRAINED",
    "TrainedAgent",
    "check_name",
    "load_pretrained",
    "open_agent",
    "pretrained_names",
    "read_agent",
    "rounded",
    "save_agent",
]

#: Where the package keeps its pretrained agents, NAME.safetensors with its model card NAME.md.
PRETRAINED = Path(__file__).parent / "pretrained"
_HEADER = {"agent_config": dict, "scenes": dict, "goals": list}
#: Exceptions that a damaged header raises.
_DAMAGED = (ValueError, TypeError, RuntimeError, OverflowError)
_SCENES = {"sources": list, "names": list, "fingerprint": str}


class TrainedAgent(NamedTuple):
    """An agent with the rooms that it was trained in.

    Attributes:
        agent: in evaluation mode.
        scenes: the rooms.
        goals: (G,) int64, global ids of the trained goals.
        card: its model card, Markdown with a YAML head; empty without one.
    """

    agent: Agent
    scenes: SceneSet
    goals: Tensor
    card: str = ""


def pretrained_names() -> list[str]:
    """Names that :func:`load_pretrained` takes."""
    return sorted(path.stem for path in PRETRAINED.glob("*.safetensors"))


def check_name(name: str) -> str:
    """Check the name of a pretrained agent and return it.

    Raises:
        ConfigError: there is no agent of this name.

    >>> check_name("vusfe")
    Traceback (most recent call last):
    ...
    vusfa.errors.ConfigError: no pretrained agent is called 'vusfe'; did you mean 'vusfa'?
    """
    names = pretrained_names()
    if name not in names:
        raise ConfigError(f"no pretrained agent is called {brief(name)}; {near(name, names)}")
    return name


def load_pretrained(name: str, scenes: SceneSet | None = None) -> TrainedAgent:
    """Load an agent that comes with the package; nothing is downloaded.

    Args:
        name: one of :func:`pretrained_names`, such as ``"vusfa"``.
        scenes: the bundled rooms, if they are open already.

    Raises:
        ConfigError: there is no agent of this name, or safetensors is missing.

    >>> agent, rooms, goals, card = load_pretrained("vusfa")
    >>> agent.config["model"], rooms.num_scenes, len(goals), card.splitlines()[0]
    ('vusfa', 4, 20, '---')
    """
    found = read_agent(PRETRAINED / f"{check_name(name)}.safetensors", scenes)
    return found._replace(card=(PRETRAINED / f"{name}.md").read_text(encoding="utf-8"))


def open_agent(source: str | os.PathLike[str], scenes: SceneSet | None = None) -> TrainedAgent:
    """Load a trained agent.

    Args:
        source: a checkpoint of ``vusfa train``; a .safetensors file; or a name of ``vusfa pretrained list``.
            A file of that name comes first.
        scenes: those that it was trained in; opened as they were then, when not given.

    Raises:
        CheckpointError: the file is missing, damaged, or of other scenes.
        SceneError: its scenes are not where they were.
        ConfigError: the source is a safetensors file, and the package safetensors is missing.

    >>> open_agent("gvf").agent.config["model"]
    'gvf'
    """
    path, names = Path(source), pretrained_names()
    if not path.is_file() and str(source) in names:
        return load_pretrained(str(source), scenes)
    if not path.exists() and not path.suffix and path.name == str(source):
        raise CheckpointError(
            f"{source}: there is no such file or folder, and no pretrained agent of this name;"
            f" {near(str(source), names)}"
        )
    if path.suffix == ".safetensors":
        return read_agent(path, scenes)
    agent, scenes, state = load_agent(path, scenes)
    return TrainedAgent(agent, scenes, state["goals"])


def rounded(weights: Mapping[str, Tensor], noise: float = 0.01) -> dict[str, Tensor]:
    """Round weights to float16, matrices to multiples of a power of two: compressed files shrink by a third.

    Args:
        weights: float32 by name.
        noise: largest ratio of the root mean squares of rounding error and matrix.

    >>> found = rounded({"weight": torch.randn(64, 64)})["weight"]
    >>> found.dtype, len(found.unique()) < 500
    (torch.float16, True)
    """
    return {
        name: _rounded(value, noise) if value.ndim > 1 else value.half() for name, value in weights.items()
    }


def _rounded(value: Tensor, noise: float) -> Tensor:
    size = value.square().mean().sqrt().item()
    if size == 0:
        return value.half()
    step = 2.0 ** math.floor(math.log2(noise * math.sqrt(12) * size))  # rounding errors are uniform
    return ((value / step).round() * step).half()


def save_agent(path: str | os.PathLike[str], agent: Agent, scenes: SceneSet, goals: Tensor) -> Path:
    """Write an agent as a safetensors file, atomically; :func:`rounded` rounds its weights.

    Args:
        path: the file. It names bundled rooms, and has paths of others relative to itself.
        agent, scenes, goals: as :class:`TrainedAgent` has them.

    Raises:
        ConfigError: safetensors is missing.
    """
    header = {
        "vusfa": __version__,
        "agent_config": agent.config,
        "scenes": {
            "sources": scene_sources(opened_from(scenes), Path(path).parent),
            "names": list(scenes.names),
            "fingerprint": scenes.fingerprint,
        },
        "goals": goals.tolist(),
    }
    weights = {name: value.contiguous() for name, value in rounded(agent.state_dict()).items()}
    with replacing(Path(path)) as unfinished:
        _safetensors().save_file(
            weights, unfinished, {"format": "pt", "vusfa": json.dumps(header, sort_keys=True)}
        )
    return Path(path)


def read_agent(path: str | os.PathLike[str], scenes: SceneSet | None = None) -> TrainedAgent:
    """Read a file of :func:`save_agent`, with weights as float32.

    Raises:
        CheckpointError: the file is missing, damaged, no agent of this package, or of other scenes.
        SceneError: its scenes are not where they were.
        ConfigError: safetensors is missing.
    """
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(f"{path}: no such file; vusfa pretrained list names the agents of the package")
    library = import_module("safetensors") if _safetensors() else None
    try:
        with library.safe_open(path, framework="pt") as file:  # type: ignore[union-attr]
            text = (file.metadata() or {})["vusfa"]
            if len(text) > MAX_JSON_BYTES:
                raise ValueError(f"its header has more than {MAX_JSON_BYTES} bytes")
            header = json.loads(text)
            weights = {name: file.get_tensor(name).float() for name in file.keys()}
        _check_header(header)
        if not all(bool(value.isfinite().all()) for value in weights.values()):
            raise ValueError("its weights hold NaN or infinity")
        goals = torch.tensor(header["goals"], dtype=torch.int64)
    except (library.SafetensorError, OSError, LookupError, *_DAMAGED) as error:  # type: ignore[union-attr]
        raise CheckpointError(
            f"{path}: no agent of vusfa ({brief(str(error))}); give a file of vusfa pretrained or push_to_hub"
        ) from error
    check_sizes(path, header["agent_config"], weights)
    if scenes is None:
        scenes = SceneSet.open(find_sources(header["scenes"]["sources"], path))
    agent = saved_agent(path, {**header, "agent": weights, "goals": goals}, scenes)
    return TrainedAgent(agent, scenes, goals)


def _check_header(header: Any) -> None:
    for name, kinds, group in (("", _HEADER, header), ("scenes.", _SCENES, header["scenes"])):
        for key, kind in kinds.items():
            if not isinstance(group[key], kind):
                raise TypeError(f"its entry '{name}{key}' is {brief(group[key])}")
    if not all(isinstance(goal, int) for goal in header["goals"]):
        raise TypeError(f"its entry 'goals' is {brief(header['goals'])}")
    if not all(isinstance(item, str) for key in ("sources", "names") for item in header["scenes"][key]):
        raise TypeError(f"its entry 'scenes' is {brief(header['scenes'])}")


def _safetensors() -> Any:
    try:
        return import_module("safetensors.torch")
    except ModuleNotFoundError as error:
        raise ConfigError("pretrained agents need safetensors: pip install 'vusfa[deploy]'") from error
