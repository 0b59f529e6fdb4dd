"""Comparison of two pictures part by part, for features that keep where things are (maps)."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from vusfa.errors import ConfigError
from vusfa.modules.precision import autocast_copy
from vusfa.modules.siamese import SiameseEncoder
from vusfa.modules.trunk import Fusion, SiameseTrunk, inverse_index
from vusfa.modules.unique import Rows, gather, shapes_may_vary, unique_rows
from vusfa.scenes import SceneSet
from vusfa.scenes.feature_grid import feature_grid

__all__ = ["CachedCorrelation", "CorrelationTrunk", "PartCorrelation", "make_correlation"]


class PartCorrelation(nn.Module):
    r"""Scores of every part of the state's picture against every part of the goal's, and a layer on them.

    .. math::
        c_h(i, j) = \frac{q_h(x_i) \cdot k_h(y_j)}{\sqrt{D}}, \qquad out = W c + b

    x_i and y_j are the features of part i of one picture and of part j of the other, each after a shared
    layer with GELU and a learned position; q_h and k_h are linear. As in the correlation layer of FlowNet
    (Fischer et al. 2015, https://arxiv.org/abs/1504.06852), nothing is averaged by the scores: the next layer
    reads which part looks like which one.

    Args:
        feature_size: F = T C features of a picture, channel by channel, as ``vusfa scenes encode grid=3x4``
            writes them.
        parts: T.
        out_features: size of the output.
        heads: number of scores per pair of parts.
        head_size: D.
        width: size of the shared layer.

    Raises:
        ValueError: T does not divide F.

    >>> correlation = PartCorrelation(12 * 8, parts=12, out_features=32, heads=2, head_size=4, width=16)
    >>> states, goals = torch.rand(5, 96), torch.rand(5, 96)
    >>> correlation(correlation.queries(states), correlation.keys(goals)).shape
    torch.Size([5, 32])
    """

    def __init__(
        self,
        feature_size: int,
        parts: int,
        out_features: int,
        *,
        heads: int = 8,
        head_size: int = 32,
        width: int = 128,
    ) -> None:
        super().__init__()
        if feature_size % parts:
            raise ValueError(f"{feature_size} features are not those of {parts} parts of a picture")
        self.parts, self.heads = parts, heads
        self.part = nn.Linear(feature_size // parts, width)
        self.position = nn.Parameter(0.02 * torch.randn(parts, width))
        self.query = nn.Linear(width, heads * head_size, bias=False)
        self.key = nn.Linear(width, heads * head_size, bias=False)
        self.linear = nn.Linear(heads * parts * parts, out_features)

    def queries(self, features: Tensor) -> Tensor:
        """q (D, heads, T, head_size) of states' features (D, F)."""
        return self._split(self.query(self._parts(features)))

    def keys(self, features: Tensor) -> Tensor:
        """k (D, heads, T, head_size) of goals' features (D, F)."""
        return self._split(self.key(self._parts(features)))

    def forward(self, queries: Tensor, keys: Tensor) -> Tensor:
        """What the layer makes of the scores (R, heads, T, T) of rows, (R, out_features)."""
        scores = queries @ keys.mT / math.sqrt(queries.shape[-1])
        return self.linear(scores.flatten(1))

    def _parts(self, features: Tensor) -> Tensor:
        parts = features.reshape(len(features), -1, self.parts).mT
        return functional.gelu(self.part(parts) + self.position)

    def _split(self, parts: Tensor) -> Tensor:
        return parts.reshape(len(parts), self.parts, self.heads, -1).transpose(1, 2)


def make_correlation(scenes: SceneSet, out_features: int) -> PartCorrelation:
    """The correlation of features of scenes.

    Raises:
        ConfigError: the features are of whole pictures.
    """
    rows, columns = feature_grid(scenes)
    if rows * columns == 1:
        raise ConfigError(
            "agent.fusion=correlation compares parts of pictures, and the scenes' features are of whole"
            " pictures; encode them with 'vusfa scenes encode SCENE.h5 MAP.h5 --layer _blocks.14 --grid 3x4'"
        )
    return PartCorrelation(scenes.feature_size, rows * columns, out_features)


class CorrelationTrunk(SiameseTrunk):
    """A trunk whose fusion reads the embeddings of state and goal and the correlation of their pictures.

    The fusion is ReLU(W_s phi_s + W_g phi_g + b + correlation). Of a history the newest frame is compared.

    Args:
        encoder: reads precomputed features.
        fusion: of the embeddings.
        correlation: with as many outputs as the fusion.

    >>> from vusfa.modules.frames import FeatureFrames
    >>> encoder = SiameseEncoder(FeatureFrames(torch.rand(12, 1, 8)), 1, 16, 6)
    >>> trunk = CorrelationTrunk(encoder, Fusion(6, 32), PartCorrelation(8, parts=4, out_features=32))
    >>> state, goal, fused = trunk(torch.tensor([[3], [5]]), torch.arange(2))
    >>> fused.shape, torch.allclose(fused, trunk.fused(torch.tensor([[3], [5]]), torch.arange(2)))
    (torch.Size([2, 32]), True)
    """

    def __init__(self, encoder: SiameseEncoder, fusion: Fusion, correlation: PartCorrelation) -> None:
        super().__init__(encoder, fusion)
        self.correlation = correlation

    def cached(
        self, goals: Tensor | None = None, rows: int | None = None, states: Tensor | None = None
    ) -> Any:
        """An object with :meth:`fused` for constant weights; arguments of :class:`CachedCorrelation`."""
        return CachedCorrelation(self, goals, rows, states)

    def _sum(self, of_state: Rows, of_goal: Rows, state: Tensor, goal: Tensor) -> Tensor:
        """With the correlation of the pictures."""
        summed = super()._sum(of_state, of_goal, state, goal)
        states, goals = self._pictures(state, goal)
        queries = gather(self.correlation.queries(states.values), states.inverse)
        keys = gather(self.correlation.keys(goals.values), goals.inverse)
        return summed + self.correlation(queries, keys)

    def _pictures(self, state: Tensor, goal: Tensor) -> tuple[Rows, Rows]:
        """Features of the rows' newest frames and of their goals."""
        frames = self.encoder.frames
        if not self.encoder.by_id:
            goal = goal[..., -1, :] if goal.dim() == state.dim() else goal
            pictures = frames.encode(state[..., -1, :]), frames.encode(goal)
            return tuple(Rows(each.reshape(-1, each.shape[-1])) for each in pictures)  # type: ignore[return-value]
        columns = state[..., -1].reshape(-1), goal.reshape(-1)
        if not (self.encoder.deduplicate and shapes_may_vary(state)):
            return tuple(Rows(frames.lookup(ids)) for ids in columns)  # type: ignore[return-value]
        distinct = [unique_rows(ids) for ids in columns]
        return tuple(Rows(frames.lookup(each.columns[0]), each.inverse) for each in distinct)  # type: ignore[return-value]


class CachedCorrelation:
    """The ``fused`` of a :class:`CorrelationTrunk` for constant weights: what depends on one picture is
    computed once for all goals, and for all states where at least as many rows will be asked for.

    Args:
        trunk: reads ids; its weights are read now.
        goals: (G,) ids of the only states that will be goals; None for all of the world.
        rows: number of rows that will be asked for; None for many.
        states: (n,) ids of the only states that will be asked for; None for all of the world.

    >>> from vusfa.modules.frames import FeatureFrames
    >>> encoder = SiameseEncoder(FeatureFrames(torch.rand(12, 1, 8)), 2, 16, 6)
    >>> trunk = CorrelationTrunk(encoder, Fusion(6, 32), PartCorrelation(8, parts=4, out_features=32))
    >>> state, goal = torch.randint(12, (3, 2)), torch.tensor([1, 7, 7])
    >>> for cached in (trunk.cached(torch.tensor([7, 1])), trunk.cached(rows=3)):
    ...     torch.allclose(cached.fused(state, goal), trunk.fused(state, goal), atol=1e-6)
    True
    True
    """

    @torch.no_grad()
    def __init__(
        self,
        trunk: CorrelationTrunk,
        goals: Tensor | None = None,
        rows: int | None = None,
        states: Tensor | None = None,
    ) -> None:
        (self.trunk,) = autocast_copy([trunk])
        encoder, number = trunk.encoder, trunk.encoder.frames.num_states
        self.goal_row = None if goals is None else inverse_index(goals, number)
        features = encoder.frames.lookup(goals)
        first = (encoder.goal_branch or encoder.branch).first.repeated(features)
        self.goal_part = trunk.fusion.goal_part(encoder.embed_goal(first))
        self.keys = trunk.correlation.keys(features)
        self.queries, self.state_part, self.state_row = None, None, None
        if rows is None or rows >= (number if states is None else len(states)):
            self.state_row = None if states is None else inverse_index(states, number)
            features = encoder.frames.lookup(states)
            self.queries = trunk.correlation.queries(features)
            if encoder.history == 1:
                first = encoder.branch.first(features.unsqueeze(-2))
                self.state_part = trunk.fusion.state_part(encoder.embed_state(first))

    @torch.no_grad()
    def fused(self, state: Tensor, goal: Tensor) -> Tensor:
        """(R, hidden) of ids (R, H) and (R,)."""
        trunk, encoder = self.trunk, self.trunk.encoder
        encoder.check_history(state.shape[1], "state_id")
        goal_row = goal if self.goal_row is None else self.goal_row[goal]
        newest = state[:, -1] if self.state_row is None else self.state_row[state[:, -1]]
        if self.state_part is not None:
            state_part = gather(self.state_part, newest)
        else:
            first = encoder.branch.first(encoder.frames.lookup(state[:, -encoder.history :]))
            state_part = trunk.fusion.state_part(encoder.embed_state(first))
        if self.queries is not None:
            queries = gather(self.queries, newest)
        else:
            queries = trunk.correlation.queries(encoder.frames.lookup(newest))
        compared = trunk.correlation(queries, gather(self.keys, goal_row))
        return functional.relu(state_part + gather(self.goal_part, goal_row) + compared)
