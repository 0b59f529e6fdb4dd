"""The computation that ``vusfa export`` writes: a backbone and an agent as functions of plain tensors."""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn
from torchrl.modules import LSTMModule

from vusfa.deploy.navigator import Navigator
from vusfa.modules import SceneLinear
from vusfa.modules.frames import FeatureFrames, PictureFrames
from vusfa.modules.trunk import remember
from vusfa.sources.backbones import Backbone

__all__ = ["Graph"]


class _PickedLinear(nn.Module):
    """A SceneLinear whose weights are looked up row by row, without a size that depends on the data."""

    def __init__(self, layer: SceneLinear) -> None:
        super().__init__()
        self.weight, self.bias = layer.weight, layer.bias

    def forward(self, x: Tensor, scene_id: Tensor) -> Tensor:
        return torch.bmm(self.weight[scene_id], x.unsqueeze(-1)).squeeze(-1) + self.bias[scene_id]


class _Pooled(nn.Module):
    """A backbone with its normalization: features (B, F) of pictures (B, S, S, 3) uint8."""

    mean: Tensor
    std: Tensor

    def __init__(self, backbone: Backbone) -> None:
        super().__init__()
        assert isinstance(backbone.network, nn.Module)
        self.network = copy.deepcopy(backbone.network).to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
        self.register_buffer("mean", torch.tensor(backbone.preprocessing.mean))
        self.register_buffer("std", torch.tensor(backbone.preprocessing.std))

    def forward(self, picture: Tensor) -> Tensor:
        images = (picture.to(torch.float32) / 255 - self.mean) / self.std
        features = self.network(images.permute(0, 3, 1, 2))
        return features.mean((2, 3)) if features.ndim == 4 else features


class _Convolved(nn.Module):
    """An agent's own convolutions: features (B, F) of pictures (B, h, w, 3) uint8.

    Pictures are averaged down as :func:`~vusfa.modules.frames.shrink_pictures` does it, by sums over windows
    of rows and of columns, which float32 holds exactly: ONNX has no average of windows that overlap.
    """

    rows: Tensor
    columns: Tensor

    def __init__(self, frames: PictureFrames, height: int, width: int) -> None:
        super().__init__()
        self.convolutions = copy.deepcopy(frames.convolutions)
        self.register_buffer("rows", _windows(height, frames.picture_size[0]))
        self.register_buffer("columns", _windows(width, frames.picture_size[1]))

    def forward(self, picture: Tensor) -> Tensor:
        sums = self.rows @ picture.permute(0, 3, 1, 2).to(torch.float32) @ self.columns.T
        small = sums / self.rows.sum(1)[:, None] / self.columns.sum(1)
        return self.convolutions(small.round() / 127.5 - 1)


def _windows(size: int, number: int) -> Tensor:
    """The windows that ``size`` pixels are averaged over, (number, size) float32 of zeros and ones."""
    place, window = torch.arange(size), torch.arange(number)[:, None]
    first, end = window * size // number, -(-(window + 1) * size // number)
    return ((place >= first) & (place < end)).to(torch.float32)


class Graph(nn.Module):
    """The exported computation; inputs and outputs are those of :mod:`vusfa.deploy.export`.

    Args:
        navigator: with its agent and its backbone, which are copied.
        height, width: of the pictures, pixels.
    """

    def __init__(self, navigator: Navigator, height: int, width: int) -> None:
        super().__init__()
        agent = copy.deepcopy(navigator.agent)
        frames = agent.encoder.frames
        if isinstance(frames, PictureFrames):
            self.look: nn.Module = _Convolved(frames, height, width)
            agent.encoder.frames = FeatureFrames(torch.zeros(1, 1, frames.size), lookup=False)
        else:
            assert navigator.backbone is not None
            self.look = _Pooled(navigator.backbone)
        self.places = navigator.places
        for parent in list(agent.modules()):
            for name, child in list(parent.named_children()):
                if isinstance(child, SceneLinear) and child.num_scenes > 1:
                    setattr(parent, name, _PickedLinear(child))
        self.agent = agent  # whose steps hold the layers

    def forward(
        self,
        picture: Tensor,
        goal: Tensor,
        room: Tensor,
        started: Tensor | None = None,
        history: Tensor | None = None,
        recurrent_state_h: Tensor | None = None,
        recurrent_state_c: Tensor | None = None,
    ) -> tuple[Tensor, ...]:
        """Outputs of inputs, both in the order of :mod:`vusfa.deploy.export`."""
        features = self.look(picture)
        frames, remembered = features.unsqueeze(1), []
        if started is not None:
            remembered.append(torch.ones_like(started))
        if started is not None and history is not None:  # the first picture fills the history
            frames = torch.cat([torch.where(started[:, None, None], history, frames), frames], 1)
            remembered.append(frames[:, 1:])
        trunk, *heads = self.agent.actor_steps()
        values = dict(zip(trunk.out_keys, trunk.module(frames, goal), strict=True)) | {"scene_id": room}
        for step in heads:
            if isinstance(step, LSTMModule):
                assert started is not None
                rows = values[step.in_keys[0]]
                written = remember(step.lstm, rows, recurrent_state_h, recurrent_state_c, ~started)
                remembered += written[1:]
            else:
                written = step.module(*(values[key] for key in step.in_keys))
            values |= zip(step.out_keys, written if isinstance(written, tuple) else (written,), strict=True)
        similarity = self.places.similarity(features, goal)
        probabilities = values["logits"].softmax(-1)
        return features, probabilities, similarity, self.places.by_room(features), *remembered
