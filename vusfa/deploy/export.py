"""A navigator as one ONNX file, which needs neither torch nor this package to run.

| input | type | shape | content |
|---|---|---|---|
| ``picture`` | uint8 | (B, S, S, 3) | the camera's picture, resized to the backbone's square |
| ``goal`` | float32 | (B, F) | ``features`` of the goal's picture, from a first call |
| ``room`` | int64 | (B,) | index of the room, in the order of the metadata's ``scenes`` |
| ``history`` | float32 | (B, H - 1, F) | ``features`` of the pictures before, oldest first; none for H = 1 |

| output | type | shape | content |
|---|---|---|---|
| ``features`` | float32 | (B, F) | features of the picture, to pass as goal and history |
| ``probabilities`` | float32 | (B, A) | probabilities of the actions |
| ``similarity`` | float32 | (B,) | similarity of the picture with the goal's |
| ``rooms`` | float32 | (B, n) | similarity of the picture with the most similar state of each room |

B, the batch, is any number. The metadata are strings: ``actions``, ``scenes`` (JSON lists), ``history``,
``size``, ``resize``, ``crops``, ``interpolation``, ``aspect`` (JSON: width and height of the rooms' pictures,
or null), ``arrived``, ``known`` (:mod:`vusfa.deploy.places`), ``backbone``, ``backbone_sha256``, ``model``,
``normalization`` and ``vusfa`` (the version). ``examples/deploy/run_onnx.py`` runs such a file.
"""

from __future__ import annotations

import copy
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
from vusfa.deploy.navigator import Navigator
from vusfa.deploy.pictures import as_picture
from vusfa.errors import ConfigError
from vusfa.files import check_folder, replacing
from vusfa.modules import InferencePolicy, SceneLinear
from vusfa.sources.crops import cut

__all__ = ["export_onnx", "largest_difference"]


class _PickedLinear(nn.Module):
    """A SceneLinear whose weights are looked up row by row, without a size that depends on the data."""

    def __init__(self, layer: SceneLinear) -> None:
        super().__init__()
        self.weight, self.bias = layer.weight, layer.bias

    def forward(self, x: Tensor, scene_id: Tensor) -> Tensor:
        return torch.bmm(self.weight[scene_id], x.unsqueeze(-1)).squeeze(-1) + self.bias[scene_id]


class _Graph(nn.Module):
    """The exported computation."""

    mean: Tensor
    std: Tensor

    def __init__(self, navigator: Navigator) -> None:
        super().__init__()
        assert navigator.backbone is not None
        assert isinstance(navigator.backbone.network, nn.Module)
        self.network = copy.deepcopy(navigator.backbone.network).to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
        preprocessing = navigator.backbone.preprocessing
        self.register_buffer("mean", torch.tensor(preprocessing.mean))
        self.register_buffer("std", torch.tensor(preprocessing.std))
        self.places = navigator.places
        agent = copy.deepcopy(navigator.agent)
        for parent in list(agent.modules()):
            for name, child in list(parent.named_children()):
                if isinstance(child, SceneLinear) and child.num_scenes > 1:
                    setattr(parent, name, _PickedLinear(child))
        self.policy = InferencePolicy(agent)

    def forward(
        self, picture: Tensor, goal: Tensor, room: Tensor, history: Tensor | None = None
    ) -> tuple[Tensor, ...]:
        images = (picture.to(torch.float32) / 255 - self.mean) / self.std
        features = self.network(images.permute(0, 3, 1, 2))
        features = features.mean((2, 3)) if features.ndim == 4 else features
        frames = features.unsqueeze(1)
        frames = frames if history is None else torch.cat([history, frames], 1)
        probabilities = self.policy.logits(frames, goal, room).softmax(-1)
        return features, probabilities, self.places.similarity(features, goal), self.places.by_room(features)


def export_onnx(navigator: Navigator, path: str | os.PathLike[str]) -> Path:
    """Write a navigator as an ONNX file, atomically.

    Args:
        navigator: its agent reads features and has no memory; its backbone is a torch module.
        path: the file to write, replaced if it exists.

    Raises:
        ConfigError: the agent or backbone cannot be exported, packages are missing, or the folder cannot be
            written.

    >>> from vusfa.deploy import Navigator
    >>> export_onnx(Navigator.load("run/checkpoint.pt"), "agent.onnx")  # doctest: +SKIP
    PosixPath('agent.onnx')
    """
    path = Path(path)
    check_folder(path.parent, "the ONNX file's folder")
    if path.is_dir():
        raise ConfigError(f"{path}: is a folder; give the name of a file, such as agent.onnx")
    _refuse_unsupported(navigator)
    for package in ("onnx", "onnxscript"):
        _package(package)
    onnx = import_module("onnx")
    kept = navigator.agent.config["history"]
    size, width = navigator.backbone.preprocessing.size, navigator.scenes.feature_size  # type: ignore[union-attr]
    inputs: list[Tensor] = [
        torch.zeros(2, size, size, 3, dtype=torch.uint8),
        torch.zeros(2, width),
        torch.zeros(2, dtype=torch.int64),
    ]
    names = ["picture", "goal", "room"]
    if kept > 1:
        inputs.append(torch.zeros(2, kept - 1, width))
        names.append("history")
    batch = torch.export.Dim("batch")
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it reports missing packages
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")  # those of torch's exporter
        program: Any = torch.onnx.export(
            _Graph(navigator).eval(),
            tuple(inputs),
            input_names=names,
            output_names=["features", "probabilities", "similarity", "rooms"],
            dynamic_shapes=({0: batch},) * len(inputs),
            dynamo=True,
            verbose=False,
        )
    model = program.model_proto
    onnx.helper.set_model_props(model, _metadata(navigator))
    with replacing(path) as unfinished:
        onnx.save(model, os.fspath(unfinished))
    return path


def _refuse_unsupported(navigator: Navigator) -> None:
    agent = navigator.agent
    if agent.memory is not None:
        raise ConfigError(
            "an agent with a memory (agent.memory) cannot be exported; use Navigator or vusfa run"
        )
    if navigator.backbone is None:
        raise ConfigError(
            "an agent with convolutions of its own cannot be exported; use Navigator or vusfa run"
        )
    if not isinstance(navigator.backbone.network, nn.Module) or isinstance(
        navigator.backbone.network, torch.jit.ScriptModule
    ):
        raise ConfigError(
            f"backbone {navigator.backbone.name} is a file of a finished network, which cannot be exported;"
            " load it by name (torchvision:MODEL, timm:MODEL)"
        )


def _package(name: str) -> Any:
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        raise ConfigError(f"ONNX needs {name}: pip install 'vusfa[deploy]'") from error


def _metadata(navigator: Navigator) -> dict[str, str]:
    backbone, config = navigator.backbone, navigator.agent.config
    assert backbone is not None
    prepared, shape = backbone.preprocessing, navigator.scenes.scenes[0].picture_shape
    return {
        "actions": json.dumps(navigator.actions),
        "scenes": json.dumps(navigator.scenes.names),
        "history": str(config["history"]),
        "size": str(prepared.size),
        "resize": str(prepared.resize),
        "crops": prepared.crops,
        "interpolation": prepared.interpolation,
        "aspect": json.dumps([shape[1], shape[0]] if shape else None),
        "arrived": repr(navigator.threshold),
        "known": repr(navigator.places.known),
        "normalization": prepared.describe(),
        "backbone": backbone.name,
        "backbone_sha256": backbone.weights_sha256,
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
    assert navigator.backbone is not None
    preprocessing, width = navigator.backbone.preprocessing, navigator.scenes.feature_size
    navigator.goal(goal)
    assert navigator.scene is not None
    kept, room = navigator.agent.config["history"], navigator.scenes.scene_index(navigator.scene)
    history: list[np.ndarray] = []

    def ask(picture: Any, goal: np.ndarray) -> list[np.ndarray]:
        given = {
            "picture": cut(as_picture(picture)[0], preprocessing),
            "goal": goal,
            "room": np.array([room]),
            "history": np.stack(history, 1) if history else np.zeros((1, kept - 1, width), np.float32),
        }
        return session.run(None, {one.name: given[one.name] for one in session.get_inputs()})

    target, most = ask(goal, np.zeros((1, width), np.float32))[0], 0.0
    for picture in pictures:
        if not history and kept > 1:  # the first picture fills the history
            history = [ask(picture, target)[0]] * (kept - 1)
        features, probabilities, similarity, _ = ask(picture, target)
        history = [*history, features][1:] if kept > 1 else []
        found = navigator.act(picture)
        assert navigator.similarity is not None
        most = max(
            most,
            abs(float(probabilities[0, found.index]) - found.confidence),
            abs(float(similarity[0]) - navigator.similarity),
        )
    return most
