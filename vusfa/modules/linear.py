"""Affine layers with one weight per scene, and with one weight per frame of a history.

Both start as ``torch.nn.Linear`` and the released code do, uniform in +-1/sqrt(fan_in).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from vusfa.modules.precision import for_autocast, full_precision, padded_linear
from vusfa.modules.rows import RowScenes, SceneBlocks, SortedByScene, count_scenes, unknown_scene
from vusfa.modules.unique import shapes_may_vary

__all__ = ["HistoryLinear", "SceneHead", "SceneLinear"]

#: At most this many outputs per row are computed for nothing before rows are sorted by scene instead.
_DENSE_OUTPUTS = 64
#: On an accelerator sorting means waiting for it, so a few scenes are all computed there.
_DENSE_SCENES = 8


class SceneLinear(nn.Module):
    """Affine layer with weights for each scene: row i meets those of scene ``scene_id[i]``.

    Batches that mix scenes are sorted by scene, so that each scene costs one matrix product; small outputs
    (the logits) are computed for all scenes and picked. With one scene it is a plain ``linear``.

    All scenes' weights are one parameter, where the released code has a variable per scene: an optimizer that
    clips by parameter sees them together.

    Attributes:
        weight: (num_scenes, out_features, in_features).
        bias: (num_scenes, out_features).
        slots: (n,) int64, where the weights of each of n scenes are, while the layer holds those of some
            (:class:`vusfa.training.active_heads.ActiveHeads`); None while it holds all, in order.

    >>> layer = SceneLinear(3, 8, 5)
    >>> x, scene_id = torch.randn(4, 8), torch.tensor([2, 0, 2, 1])
    >>> y = layer(x, scene_id)
    >>> y.shape
    torch.Size([4, 5])
    >>> torch.allclose(y[0], x[0] @ layer.weight[2].T + layer.bias[2], atol=1e-6)
    True
    """

    def __init__(self, num_scenes: int, in_features: int, out_features: int) -> None:
        super().__init__()
        self.num_scenes = num_scenes
        self.in_features = in_features
        self.out_features = out_features
        self.slots: Tensor | None = None
        self.weight = nn.Parameter(torch.empty(num_scenes, out_features, in_features))
        self.bias = nn.Parameter(torch.empty(num_scenes, out_features))
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Draw weights and biases anew."""
        _uniform_(self.weight, self.bias, fan_in=self.in_features)

    def forward(self, x: Tensor, scene_id: RowScenes) -> Tensor:
        """Map (\\*B, in) with scene indices (\\*B,) int64 to (\\*B, out); or rows (R, in) sorted by scene,
        with their :class:`SortedByScene`, or blocks (n, m, in) with their :class:`SceneBlocks`."""
        # in one piece, not each scene's slice
        weight, bias = for_autocast(self.weight), for_autocast(self.bias)
        if self.num_scenes == 1:
            return padded_linear(x, weight.squeeze(0), bias.squeeze(0))
        if isinstance(scene_id, SceneBlocks):
            return torch.baddbmm(bias.unsqueeze(1), x, weight.transpose(1, 2))
        if isinstance(scene_id, SortedByScene):
            if self.num_scenes * self.out_features <= _DENSE_OUTPUTS:
                return self._all_scenes(x, scene_id.scene, weight, bias)
            parts = self._products(x, scene_id.counts, weight.unbind(0), bias.unbind(0))
            return parts[0] if len(parts) == 1 else torch.cat(parts)
        rows, scene = x.reshape(-1, self.in_features), scene_id.reshape(-1)
        if self.slots is not None:
            scene = self.slots[scene]
        if (
            self.num_scenes * self.out_features <= _DENSE_OUTPUTS
            or (rows.is_cuda and self.num_scenes <= _DENSE_SCENES)
            or not shapes_may_vary(scene)
        ):
            result = self._all_scenes(rows, scene, weight, bias)
        else:
            result = self._by_scene(rows, scene, weight, bias)
        return result.reshape(*x.shape[:-1], self.out_features)

    def _all_scenes(self, rows: Tensor, scene: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        every = padded_linear(rows, weight.flatten(0, 1), bias.flatten())
        every = every.view(-1, self.num_scenes, self.out_features)
        try:
            return every.gather(1, scene.view(-1, 1, 1).expand(-1, 1, self.out_features)).squeeze(1)
        except RuntimeError:
            if shapes_may_vary(scene) and len(scene) and int(scene.max()) >= self.num_scenes:
                raise unknown_scene(scene, self.num_scenes) from None
            raise

    def _by_scene(self, rows: Tensor, scene: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        counts = count_scenes(scene, self.num_scenes)
        # unbound, not indexed: the gradients of slices are then stacked, not added up in full size
        weights, biases = weight.unbind(0), bias.unbind(0)
        if max(counts) == len(rows):
            only = counts.index(len(rows))
            return padded_linear(rows, weights[only], biases[only])
        if bool((scene[1:] >= scene[:-1]).all()):  # as a batch sorted by scene has it: nothing to move
            return torch.cat(self._products(rows, counts, weights, biases))
        order = scene.argsort(stable=True)
        parts = self._products(functional.embedding(order, rows), counts, weights, biases)
        back = torch.empty_like(order)
        back[order] = torch.arange(len(order), device=order.device)
        return functional.embedding(back, torch.cat(parts))

    @staticmethod
    def _products(
        rows: Tensor, counts: list[int], weights: tuple[Tensor, ...], biases: tuple[Tensor, ...]
    ) -> list[Tensor]:
        parts = zip(rows.split(counts), weights, biases, strict=True)
        return [padded_linear(part, weight, bias) for part, weight, bias in parts if len(part)]

    def extra_repr(self) -> str:
        """What ``print`` shows of the layer."""
        return f"scenes={self.num_scenes}, in_features={self.in_features}, out_features={self.out_features}"


class SceneHead(nn.Module):
    """Base of heads: a :class:`SceneLinear` on the hidden state, its outputs in full precision."""

    def __init__(self, num_scenes: int, hidden_size: int, out_features: int) -> None:
        super().__init__()
        self.linear = SceneLinear(num_scenes, hidden_size, out_features)

    def forward(self, hidden: Tensor, scene_id: RowScenes) -> Tensor:
        """(\\*B, hidden_size) with scene indices (\\*B,) to (\\*B, out)."""
        return full_precision(self.linear(hidden, scene_id), self.linear.weight)


class HistoryLinear(nn.Module):
    """Affine layer over the last H frames, with one weight per frame: ``sum_h W_h f_h + b``.

    It is ``Linear(H * F, out)`` on concatenated frames. In this form a frame of many histories is multiplied
    once (:meth:`project`), and histories are sums of looked-up products (:meth:`gather`).

    Attributes:
        weight: (history, out_features, in_features); ``weight[h]`` belongs to frame h, oldest first.
        bias: (out_features,).

    >>> layer = HistoryLinear(4, 6, 5)
    >>> frames = torch.randn(10, 6)                                   # ten different frames
    >>> history = torch.tensor([[3, 3, 3, 4], [3, 3, 4, 9]])          # two histories of four
    >>> torch.allclose(layer(frames[history]), layer.gather(layer.project(frames), history), atol=1e-6)
    True
    """

    def __init__(self, history: int, in_features: int, out_features: int) -> None:
        super().__init__()
        self.history = history
        self.in_features = in_features
        self.out_features = out_features
        self.weight = nn.Parameter(torch.empty(history, out_features, in_features))
        self.bias = nn.Parameter(torch.empty(out_features))
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Draw weights and biases anew."""
        _uniform_(self.weight, self.bias, fan_in=self.history * self.in_features)

    def forward(self, frames: Tensor) -> Tensor:
        """Map histories (\\*B, H, F), oldest frame first, to (\\*B, out)."""
        # a batched product would transpose the weights' gradient, which takes longer than itself
        biases = (self.bias, *[None] * (self.history - 1))
        slots = zip(frames.unbind(-2), self.weight.unbind(0), biases, strict=True)
        return torch.stack([functional.linear(frame, weight, bias) for frame, weight, bias in slots]).sum(0)

    def repeated(self, frame: Tensor) -> Tensor:
        """Map one frame (\\*B, F) that fills all H places to (\\*B, out)."""
        return functional.linear(frame, self.weight.sum(0), self.bias)

    def project(self, frames: Tensor) -> Tensor:
        """Products (D, H, out) of frames (D, F) with the weights of all places, without the bias."""
        return functional.linear(frames, self.weight.flatten(0, 1)).view(-1, self.history, self.out_features)

    def gather(self, projected: Tensor, index: Tensor) -> Tensor:
        """Outputs (\\*B, out) of histories.

        Args:
            projected: (D, H, out) from :meth:`project`.
            index: (\\*B, H) int64 rows of ``projected``, oldest frame first.
        """
        places = index * self.history + torch.arange(self.history, device=index.device)
        # one kernel looks up and sums, five to ten times faster than two
        table = projected.flatten(0, 1)
        if not torch.is_grad_enabled():
            table = table.detach()  # else what a gradient would need is kept all the same
        sums = functional.embedding_bag(places.view(-1, self.history), table, mode="sum")
        return (sums + self.bias.to(sums.dtype)).view(*index.shape[:-1], -1)

    def extra_repr(self) -> str:
        """What ``print`` shows of the layer."""
        return f"history={self.history}, in_features={self.in_features}, out_features={self.out_features}"


def _uniform_(*tensors: Tensor, fan_in: int) -> None:
    bound = 1 / math.sqrt(fan_in)
    for tensor in tensors:
        nn.init.uniform_(tensor, -bound, bound)
