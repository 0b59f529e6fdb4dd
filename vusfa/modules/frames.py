"""Features of one frame: ``lookup(ids)`` by the state's id, ``encode(observation)`` of what a camera saw."""

from __future__ import annotations

import warnings
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from vusfa.errors import ConfigError
from vusfa.limits import brief
from vusfa.modules.precision import for_autocast
from vusfa.scenes import SceneSet
from vusfa.scenes.features import LazyFeatures, SceneRows

__all__ = ["FeatureFrames", "PictureFrames", "shrink_pictures"]


class _Frames(nn.Module):
    """Base: a table of all states, or rows that are read when they are asked for."""

    table: Tensor
    _rows: SceneRows | None

    @property
    def num_states(self) -> int:
        """S, or 0 without a table."""
        return len(self.table) if self._rows is None else self._rows.num_states

    @property
    def is_lazy(self) -> bool:
        """Whether rows are read when they are asked for."""
        return self._rows is not None

    def _all(self, ids: Tensor | None) -> Tensor:
        return torch.arange(self.num_states, device=self.table.device) if ids is None else ids


class FeatureFrames(_Frames):
    """Precomputed features of frames: a table of all states that stays out of the ``state_dict``.

    The table holds crop 0, in evaluation mode always; :meth:`show` puts other crops in its place for
    training, and :attr:`dropout` hides some of what is looked up.

    Args:
        features: (S, C, F) float32 of all states, as in ``SceneSet.features``. Of a lazily opened set the
            rows that are asked for are read, normalized and kept (:class:`~vusfa.scenes.features.SceneRows`).
        lookup: keep the table; ``False`` for an agent that is handed features.
        normalize: bring every feature to mean 0 and deviation 1 over the S states. The 2 F numbers are
            part of the ``state_dict``, because the weights behind them mean nothing with others. They are
            those of crop 0. A feature that is the same in all states stays near 0, with a warning that names
            it.

    Attributes:
        dropout: probability in 256ths with which a feature that is looked up in training mode is 0, its mean
            with ``normalize``; the others grow by 1 / (1 - dropout). Each look-up draws anew.

    Raises:
        ConfigError: ``normalize``, and no feature changes at all.

    >>> frames = FeatureFrames(torch.rand(12, 1, 8), normalize=True)
    >>> frames.lookup(torch.tensor([[3, 5]])).shape, len(frames.state_dict())
    (torch.Size([1, 2, 8]), 2)
    """

    frame_dims = 1
    mean: Tensor
    deviation: Tensor
    _converted: Tensor | None
    _shown: Tensor | None = None
    dropout: float = 0.0

    def __init__(self, features: Tensor | LazyFeatures, lookup: bool = True, normalize: bool = False) -> None:
        super().__init__()
        self.size = features.shape[-1]
        self.normalize = normalize
        self._features, self._rows = None, None
        if isinstance(features, LazyFeatures):
            table = torch.empty(0, self.size)
            self._features, self._rows = features, SceneRows(features.offsets) if lookup else None
        else:
            table = features[:, 0].to(torch.get_default_dtype()).contiguous()
        self.register_buffer("table", table if lookup else table[:0].clone(), persistent=False)
        self.register_buffer("_converted", None, persistent=False)  # as autocast would
        if normalize:
            if self._features is None:
                mean, spread, largest = table.mean(0), table.std(0, correction=0), table.abs().amax(0)
            else:
                mean, spread, largest = (column.to(table) for column in self._features.summary[1:])
            self.register_buffer("mean", mean)
            self.register_buffer("deviation", _deviation(spread, largest, len(features)))
            # Kept as the encoder wants it, and brought up to date when other numbers are loaded.
            self.table = (self.table - self.mean) / self.deviation
            self._register_load_state_dict_pre_hook(self._renormalize)

    def lookup(self, ids: Tensor | None) -> Tensor:
        """Features (\\*B, F) of states (\\*B,) int64; of all S states in order for ``None``.

        Under autocast the table is converted once, because it is constant.
        """
        found = self._found(ids)
        if not (self.dropout and self.training):
            return found
        # a byte per feature, eight to a draw: a number per feature takes five times as long
        number, hidden = found.numel(), round(256 * self.dropout)
        draws = torch.randint(-(2**63), 2**63 - 1, (-(-number // 8),), device=found.device)
        kept = draws.view(torch.uint8)[:number].view(found.shape) >= hidden
        return (found * kept).mul_(256 / (256 - hidden))

    def _found(self, ids: Tensor | None) -> Tensor:
        if self._rows is not None:
            return for_autocast(self._rows(self._all(ids), self._read))
        table, device = self.table, self.table.device.type
        if self._shown is not None and self.training:
            table = self._shown
        if torch.is_autocast_enabled(device):
            if self._converted is None or self._converted.dtype != torch.get_autocast_dtype(device):
                self._converted = for_autocast(table)
            table = self._converted
        return table if ids is None else table[ids]

    def _read(self, scene: int) -> Tensor:
        """Features (N, F) of a scene as the encoder wants them."""
        assert self._features is not None
        return self.encode(self._features.of_scene(scene)[:, 0].to(self.table.device))

    def show(self, features: Tensor | None) -> None:
        """Look up other features in training mode; evaluation mode looks up crop 0.

        Args:
            features: (S, F) of all states, as the scenes have them, such as a crop of each drawn at random;
                None: crop 0 again.

        >>> frames = FeatureFrames(torch.zeros(3, 2, 8))
        >>> frames.show(torch.ones(3, 8))
        >>> frames.lookup(torch.tensor(1)).sum(), frames.eval().lookup(torch.tensor(1)).sum()
        (tensor(8.), tensor(0.))
        """
        self._shown = None if features is None else self.encode(features.to(self.table.device))
        self._converted = None

    def train(self, mode: bool = True) -> FeatureFrames:
        """Switch between training and evaluation; what autocast converted is converted anew."""
        if mode != self.training:
            self._converted = None
        return super().train(mode)

    def _apply(self, fn: Any, recurse: bool = True) -> Any:
        """As every move of a module: what autocast converted is converted anew, what was read is read anew,
        and crop 0 is shown."""
        self._converted = self._shown = None
        if self._rows is not None:
            self._rows.clear()
        return super()._apply(fn, recurse)

    def encode(self, observation: Tensor) -> Tensor:
        """Features (\\*B, F) as the encoder wants them, of features (\\*B, F) as the scene has them."""
        observation = observation.to(self.table.dtype)
        return (observation - self.mean) / self.deviation if self.normalize else observation

    @torch.no_grad()
    def _renormalize(self, state: dict[str, Any], prefix: str, *_: Any) -> None:
        """Before other means and deviations come in: the table by them."""
        mean, deviation = (state.get(prefix + name) for name in ("mean", "deviation"))
        if mean is None or deviation is None or mean.shape != self.mean.shape:
            return  # load_state_dict says what is wrong
        mean, deviation = mean.to(self.table), deviation.to(self.table)
        if not (torch.equal(mean, self.mean) and torch.equal(deviation, self.deviation)):
            self.table.copy_((self.table * self.deviation + self.mean - mean) / deviation)
            self._converted = self._shown = None
            if self._rows is not None:
                self._rows.clear()


class PictureFrames(_Frames):
    """Features learned from pictures by three convolutions, the paper's variant "from scratch".

    Pictures are shrunk to ``picture_size``. Convolutions of 32 filters 8 x 8 by 4, 64 of 4 x 4 by 2 and 64 of
    3 x 3 by 1, each with a ReLU, turn 60 x 80 pixels into 4 x 6 x 64 = 1536 features.

    Args:
        pictures: (S, H, W, 3) uint8 of all states for an agent that looks them up, else ``None``. Of a
            lazily opened ``SceneSet``, given in their place, pictures are read when they are asked for.
        picture_size: height and width that the convolutions see, pixels.

    Raises:
        ConfigError: pictures smaller than the convolutions need (36 x 36).

    >>> frames = PictureFrames(torch.randint(0, 256, (5, 150, 200, 3), dtype=torch.uint8), (60, 80))
    >>> frames.lookup(torch.tensor([4, 0])).shape
    torch.Size([2, 1536])
    """

    frame_dims = 3

    def __init__(self, pictures: Tensor | SceneSet | None, picture_size: tuple[int, int] = (60, 80)) -> None:
        super().__init__()
        self.picture_size = (int(picture_size[0]), int(picture_size[1]))
        if min(self.picture_size) < 36:
            raise ConfigError(
                f"picture_size is {self.picture_size}; the convolutions need at least 36 x 36 pixels"
            )
        self._scenes, self._rows = None, None
        if isinstance(pictures, SceneSet):
            self._scenes, self._rows = pictures.scenes, SceneRows(pictures.offsets)
        if not isinstance(pictures, Tensor):
            pictures = torch.empty(0, *self.picture_size, 3, dtype=torch.uint8)
        table = shrink_pictures(pictures.movedim(-1, -3), self.picture_size).contiguous()
        self.register_buffer("table", table, persistent=False)
        self.convolutions = nn.Sequential(
            nn.Conv2d(3, 32, 8, stride=4),
            nn.ReLU(),
            nn.Conv2d(32, 64, 4, stride=2),
            nn.ReLU(),
            nn.Conv2d(64, 64, 3, stride=1),
            nn.ReLU(),
            nn.Flatten(),
        )
        height, width = (((side - 8) // 4 + 1 - 4) // 2 + 1 - 2 for side in self.picture_size)
        self.size = 64 * height * width

    def _read(self, scene: int) -> Tensor:
        """Pictures (N, 3, H, W) of a scene in the size that the convolutions see."""
        assert self._scenes is not None
        room = self._scenes[scene]
        return shrink_pictures(room.pictures(range(room.num_states)).movedim(-1, -3), self.picture_size)

    def lookup(self, ids: Tensor | None) -> Tensor:
        """Features (\\*B, F) of states (\\*B,) int64; of all S states in order for ``None``."""
        if self._rows is not None:
            return self.encode(self._rows(self._all(ids), self._read))
        return self.encode(self.table if ids is None else self.table[ids])

    def encode(self, observation: Tensor) -> Tensor:
        """Features (\\*B, F) of pictures (\\*B, 3, H, W) uint8."""
        batch = observation.shape[:-3]
        small = shrink_pictures(observation.reshape(-1, *observation.shape[-3:]), self.picture_size)
        # Centred, so that a dark picture and a light one start equally far from nothing.
        pixels = small.to(next(self.convolutions.parameters()).dtype)
        return self.convolutions(pixels / 127.5 - 1).view(*batch, self.size)


def _deviation(deviation: Tensor, largest: Tensor, num_states: int) -> Tensor:
    """What each feature (F,) is divided by: its deviation over the states, and no less than 1e-3 or, of
    features of small scale, a hundredth of the usual deviation; ``largest`` is its largest absolute value."""
    constant = deviation <= 1e-6 * largest  # but for rounding
    if constant.all():
        raise ConfigError(
            f"none of the {len(constant)} features changes over {num_states} states; encode the scenes again"
        )
    floor = deviation[~constant].median().mul(0.01).clamp(max=1e-3)
    if constant.any():
        columns = brief(constant.nonzero()[:, 0].tolist())
        warnings.warn(
            f"{int(constant.sum())} of {len(constant)} features are the same in all states and say nothing:"
            f" columns {columns}",
            stacklevel=2,
        )
    # a constant one is divided by the largest, to stay small in other scenes, too
    return deviation.clamp(min=floor).where(~constant, deviation.max())


def shrink_pictures(pictures: Tensor, size: tuple[int, int]) -> Tensor:
    """Average pictures (n, 3, H, W) uint8 down to (n, 3, *size) uint8.

    >>> shrink_pictures(torch.full((1, 3, 4, 4), 7, dtype=torch.uint8), (2, 2)).unique()
    tensor([7], dtype=torch.uint8)
    """
    if tuple(pictures.shape[-2:]) == tuple(size):
        return pictures
    parts = [
        functional.interpolate(part.to(torch.float32), size=size, mode="area").round().to(torch.uint8)
        for part in pictures.split(64)
    ]
    return torch.cat(parts)


def picture_table(scenes: SceneSet) -> Tensor | SceneSet:
    """All pictures (S, H, W, 3) uint8 of a set, or a lazily opened set itself; a SceneError where there are
    none of one size."""
    return scenes if scenes.is_lazy else scenes.pictures(torch.arange(scenes.num_states))
