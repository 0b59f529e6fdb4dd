"""A navigator as one ONNX file, which needs neither torch nor this package to run.

| input | type | shape | content |
|---|---|---|---|
| ``picture`` | uint8 | (B, h, w, 3) | the camera's picture, resized to h x w |
| ``goal`` | float32 | (B, F) | ``features`` of the goal's picture, from a first call |
| ``room`` | int64 | (B,) | index of the room, in the order of the metadata's ``scenes`` |
| ``started`` | bool | (B,) | whether the agent has seen a picture of this walk |
| ``history`` | float32 | (B, H - 1, F) | ``features`` of the pictures before, oldest first |
| ``recurrent_state_h``, ``recurrent_state_c`` | float32 | (B, L, N) | state of the LSTM |

| output | type | shape | content |
|---|---|---|---|
| ``features`` | float32 | (B, F) | features of the picture, to pass as ``goal`` |
| ``probabilities`` | float32 | (B, A) | probabilities of the actions |
| ``similarity`` | float32 | (B,) | similarity of the picture with the goal's |
| ``rooms`` | float32 | (B, n) | similarity of the picture with the most similar state of each room |
| ``next_NAME`` | as ``NAME`` | as ``NAME`` | of ``started`` and the inputs below it, for the next picture |

B, the batch, is any number. What an agent keeps from picture to picture goes in and comes out: zeros with the
goal's picture and with the first of a walk, then each ``next_NAME`` as ``NAME``. Agents of H > 1 frames have
``history``, agents with an LSTM its state, both have ``started``; others have none of these.

The metadata are strings: ``actions``, ``scenes`` (JSON lists), ``history`` (H), ``size`` (JSON: h and w),
``resize``, ``crops``, ``interpolation``, ``aspect`` (JSON: width and height of the rooms' pictures, or null),
``arrived``, ``known`` (:mod:`vusfa.deploy.places`), ``backbone`` and
``backbone_sha256`` (empty for an agent that has convolutions of its own), ``model``, ``normalization`` and
``vusfa`` (the version). ``examples/deploy/run_onnx.py`` runs such a file.
"""

from __future__ import annotations

import json
import logging
import os
import warnings
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from vusfa import __version__
from vusfa.deploy.graph import Graph
from vusfa.deploy.navigator import Navigator
from vusfa.errors import ConfigError
from vusfa.files import check_folder, replacing
from vusfa.sources.crops import Preprocessing

__all__ = ["export_onnx", "largest_difference"]


def export_onnx(navigator: Navigator, path: str | os.PathLike[str]) -> Path:
    """Write a navigator as an ONNX file, atomically.

    Args:
        navigator: its backbone, if it has one, is a torch module.
        path: the file to write, replaced if it exists.

    Raises:
        ConfigError: agent or backbone cannot be exported, packages are missing, the folder cannot be written.

    >>> from vusfa.deploy import Navigator
    >>> export_onnx(Navigator.load("run/checkpoint.pt"), "agent.onnx")  # doctest: +SKIP
    PosixPath('agent.onnx')
    """
    path = Path(path)
    check_folder(path.parent, "the ONNX file's folder")
    if path.is_dir():
        raise ConfigError(f"{path}: is a folder; give the name of a file, such as agent.onnx")
    _refuse(navigator)
    for package in ("onnx", "onnxscript"):
        _package(package)
    onnx = import_module("onnx")
    height, width = _size(navigator)
    graph, kept = Graph(navigator, height, width).eval(), _kept(navigator, 2)
    inputs = {
        "picture": torch.zeros(2, height, width, 3, dtype=torch.uint8),
        "goal": torch.zeros(2, _features(navigator)),
        "room": torch.zeros(2, dtype=torch.int64),
        **kept,
    }
    outputs = ["features", "probabilities", "similarity", "rooms", *(f"next_{name}" for name in kept)]
    batch = torch.export.Dim("batch")
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it reports missing packages
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")  # those of torch's exporter
        program: Any = torch.onnx.export(
            graph,
            kwargs=inputs,
            input_names=list(inputs),
            output_names=outputs,
            dynamic_shapes={name: {0: batch} for name in inputs},
            dynamo=True,
            verbose=False,
        )
    model = program.model_proto
    onnx.helper.set_model_props(model, _metadata(navigator))
    with replacing(path) as unfinished:
        onnx.save(model, os.fspath(unfinished))
    return path


def _size(navigator: Navigator) -> tuple[int, int]:
    """Height and width of the pictures that the graph reads."""
    if navigator.backbone is not None:
        return (navigator.backbone.preprocessing.size,) * 2
    height, width, _ = navigator.scenes.scenes[0].picture_shape  # type: ignore[misc]
    return height, width


def _features(navigator: Navigator) -> int:
    """F, features of a picture."""
    return navigator.agent.encoder.frames.size


def _kept(navigator: Navigator, batch: int) -> dict[str, Tensor]:
    """Inputs that a program keeps from picture to picture, as they are at the start."""
    agent, kept = navigator.agent, {}
    if agent.config["history"] > 1:
        kept["history"] = torch.zeros(batch, agent.config["history"] - 1, _features(navigator))
    if agent.memory is not None:
        shape = batch, agent.memory.num_layers, agent.memory.hidden_size
        kept |= {f"recurrent_state_{name}": torch.zeros(shape) for name in "hc"}  # as TorchRL names it
    return {"started": torch.zeros(batch, dtype=torch.bool), **kept} if kept else {}


def _refuse(navigator: Navigator) -> None:
    """What cannot become an ONNX file."""
    if navigator.agent.action_input is not None:
        raise ConfigError(
            "agent.previous_action is true: an ONNX file is not told the action before; walk with"
            " vusfa.deploy.Navigator, or export an agent without it"
        )
    if navigator.backbone is None:
        return
    network = navigator.backbone.network
    if not isinstance(network, nn.Module) or isinstance(network, torch.jit.ScriptModule):
        raise ConfigError(
            f"backbone {navigator.backbone.name} is a file of a finished network, which cannot be exported;"
            " load it by name (torchvision:MODEL, timm:MODEL)"
        )


def _package(name: str) -> Any:
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # onnxruntime reports its use when it is imported
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        raise ConfigError(f"ONNX needs {name}: pip install 'vusfa[deploy]'") from error


def _metadata(navigator: Navigator) -> dict[str, str]:
    backbone, config = navigator.backbone, navigator.agent.config
    shape = navigator.scenes.scenes[0].picture_shape
    height, width = _size(navigator)
    # an agent with convolutions of its own reads whole pictures, and averages them down itself
    prepared = backbone.preprocessing if backbone else Preprocessing(size=height, interpolation="bicubic")
    pictures = "x".join(map(str, config["picture_size"]))
    return {
        "actions": json.dumps(navigator.actions),
        "scenes": json.dumps(navigator.scenes.names),
        "history": str(config["history"]),
        "size": json.dumps([height, width]),
        "resize": str(prepared.resize),
        "crops": prepared.crops,
        "interpolation": prepared.interpolation,
        "aspect": json.dumps([shape[1], shape[0]] if shape else None),
        "arrived": repr(navigator.threshold),
        "known": repr(navigator.places.known),
        "normalization": prepared.describe() if backbone else f"averaged to {pictures}, x/127.5 - 1",
        "backbone": backbone.name if backbone else "",
        "backbone_sha256": backbone.weights_sha256 if backbone else "",
        "model": config["model"],
        "vusfa": __version__,
    }


def largest_difference(
    navigator: Navigator, path: str | os.PathLike[str], goal: Any, pictures: Iterable[Any]
) -> float:
    """Largest difference of probabilities and similarities between the ONNX file and PyTorch over a walk.

    Args:
        navigator: the one that was exported.
        path: the ONNX file.
        goal, pictures: as for :class:`~vusfa.deploy.Navigator`.

    Raises:
        ConfigError: onnxruntime is missing.
    """
    runtime = _package("onnxruntime")
    session = runtime.InferenceSession(os.fspath(path), providers=["CPUExecutionProvider"])
    names = [one.name for one in session.get_outputs()]
    navigator.goal(goal)
    assert navigator.scene is not None
    room = np.array([navigator.scenes.scene_index(navigator.scene)])
    kept = {name: value.numpy() for name, value in _kept(navigator, 1).items()}

    def ask(picture: Any, goal: np.ndarray) -> dict[str, np.ndarray]:
        seen = navigator.resized(picture)[None]
        found = session.run(None, {"picture": seen, "goal": goal, "room": room, **kept})
        return dict(zip(names, found, strict=True))

    target = ask(goal, np.zeros((1, _features(navigator)), np.float32))["features"]
    most = 0.0
    for picture in pictures:
        found = ask(picture, target)
        kept = {name: found[f"next_{name}"] for name in kept}
        navigator.act(picture)
        assert navigator.probabilities is not None
        assert navigator.similarity is not None
        apart = np.abs(found["probabilities"][0] - navigator.probabilities.numpy()).max()
        most = max(most, float(apart), abs(float(found["similarity"][0]) - navigator.similarity))
    return most
