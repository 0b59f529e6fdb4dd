"""From the two embeddings to the hidden state that every head reads."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from vusfa.modules.linear import SceneLinear
from vusfa.modules.precision import autocast_copy, for_autocast, padded_linear
from vusfa.modules.rows import RowScenes
from vusfa.modules.siamese import SiameseEncoder, joined
from vusfa.modules.unique import Rows, gather

__all__ = ["CachedTrunk", "Fusion", "SceneLayer", "SiameseTrunk", "remember"]


class Fusion(nn.Module):
    """Dense layer with ReLU on the concatenated embeddings of state and goal, shared by all scenes.

    >>> import torch
    >>> Fusion(16, 32)(torch.randn(5, 16), torch.randn(5, 16)).shape
    torch.Size([5, 32])
    """

    def __init__(self, embedding_size: int, hidden_size: int) -> None:
        super().__init__()
        self.linear = nn.Linear(2 * embedding_size, hidden_size)

    def forward(self, state_embedding: Tensor, goal_embedding: Tensor) -> Tensor:
        """(\\*B, E) twice to (\\*B, hidden_size)."""
        return functional.relu(self.state_part(state_embedding) + self.goal_part(goal_embedding))

    def state_part(self, embedding: Tensor) -> Tensor:
        """The state's summand (\\*B, hidden_size), from its embedding (\\*B, E), without the bias."""
        return functional.linear(embedding, self.linear.weight[:, : embedding.shape[-1]])

    def goal_part(self, embedding: Tensor) -> Tensor:
        """The goal's summand (\\*B, hidden_size), from its embedding (\\*B, E), with the bias."""
        weight = self.linear.weight[:, -embedding.shape[-1] :]
        return functional.linear(embedding, weight, self.linear.bias)


class SiameseTrunk(nn.Module):
    """Encoder and fusion as one module: only the sum of the fusion's two parts is computed row by row.

    >>> import torch
    >>> from vusfa.modules.frames import FeatureFrames
    >>> trunk = SiameseTrunk(SiameseEncoder(FeatureFrames(torch.rand(12, 1, 8)), 4, 16, 6), Fusion(6, 32))
    >>> state, goal, fused = trunk(torch.zeros(3, 4, dtype=torch.int64), torch.arange(3))
    >>> torch.allclose(fused, trunk.fusion(state, goal), atol=1e-6)
    True
    """

    def __init__(self, encoder: SiameseEncoder, fusion: Fusion) -> None:
        super().__init__()
        self.encoder = encoder
        self.fusion = fusion

    def forward(self, state: Tensor, goal: Tensor) -> tuple[Tensor, ...]:
        """What :meth:`SiameseEncoder.forward` returns, and last the fused (\\*B, hidden)."""
        try:
            return self._written(state, goal)
        except (IndexError, RuntimeError):
            self.encoder.check_ids(state, goal)
            raise

    def _written(self, state: Tensor, goal: Tensor) -> tuple[Tensor, ...]:
        encoder, batch = self.encoder, self.encoder.batch_shape(state)
        states, goals = encoder.first_layer(state, goal)
        of_state, of_goal = encoder.encode_state(states.values), encoder.encode_goal(goals.values)
        embeddings = Rows(of_state.embedding, states.inverse), Rows(of_goal.embedding, goals.inverse)
        fused = functional.relu(self._sum(*embeddings, state, goal)).view(*batch, -1)
        return *joined(of_state.gather(states.inverse, batch), of_goal.gather(goals.inverse, batch)), fused

    def fused(self, state: Tensor, goal: Tensor) -> Tensor:
        """The fused (\\*B, hidden) alone."""
        try:
            return self._fused(state, goal)
        except (IndexError, RuntimeError):
            self.encoder.check_ids(state, goal)
            raise

    def cached(
        self, goals: Tensor | None = None, rows: int | None = None, states: Tensor | None = None
    ) -> Any:
        """An object with :meth:`fused` for constant weights; arguments of :class:`CachedTrunk`."""
        return CachedTrunk(self, goals, rows, states)

    def _fused(self, state: Tensor, goal: Tensor) -> Tensor:
        states, goals = self.encoder.first_layer(state, goal)
        of_state = Rows(self.encoder.embed_state(states.values), states.inverse)
        of_goal = Rows(self.encoder.embed_goal(goals.values), goals.inverse)
        summed = self._sum(of_state, of_goal, state, goal)
        return functional.relu(summed).view(*self.encoder.batch_shape(state), -1)

    def _sum(self, of_state: Rows, of_goal: Rows, state: Tensor, goal: Tensor) -> Tensor:
        """The fusion before its ReLU, (R, hidden), of embeddings; ``state``, ``goal``: of :meth:`forward`."""
        state_part = gather(self.fusion.state_part(of_state.values), of_state.inverse)
        return state_part + gather(self.fusion.goal_part(of_goal.values), of_goal.inverse)


class CachedTrunk:
    """A trunk's ``fused`` for constant weights: what depends on one frame is computed once.

    Args:
        trunk: reads ids; its weights are read now.
        goals: (G,) ids of the only states that will be goals; None for all of the world.
        rows: number of rows that will be asked for; None for many. With fewer rows than half of the
            states, a frame is computed when it is first asked for, else all frames now.
        states: (n,) ids of the only states that will be asked for; None for all of the world.

    >>> from vusfa.modules.frames import FeatureFrames
    >>> trunk = SiameseTrunk(SiameseEncoder(FeatureFrames(torch.rand(12, 1, 8)), 4, 16, 6), Fusion(6, 32))
    >>> state, goal = torch.randint(12, (3, 4)), torch.tensor([1, 7, 7])
    >>> for cached in (CachedTrunk(trunk, torch.tensor([7, 1])), CachedTrunk(trunk, rows=3)):
    ...     torch.allclose(cached.fused(state, goal), trunk.fused(state, goal), atol=1e-6)
    True
    True
    """

    @torch.no_grad()
    def __init__(
        self,
        trunk: SiameseTrunk,
        goals: Tensor | None = None,
        rows: int | None = None,
        states: Tensor | None = None,
    ) -> None:
        encoder, fusion = trunk.encoder, trunk.fusion
        features, first = encoder.frames.lookup(states), encoder.branch.first
        self.place = None if states is None else inverse_index(states, encoder.frames.num_states)
        (self.trunk,) = autocast_copy([trunk])
        self.known: Tensor | None = None  # (S, H) bool, the entries of ``frames`` that are computed
        # one frame: (S, 1, hidden), per state; more: (S, H, hidden), per frame and place
        if rows is not None and 2 * rows < len(features):
            self.features = features
            outputs = (fusion.linear if encoder.history == 1 else first).out_features
            self.frames = for_autocast(features.new_empty(0)).new_empty(
                len(features), encoder.history, outputs
            )
            self.known = torch.zeros(self.frames.shape[:2], dtype=torch.bool, device=features.device)
        elif encoder.history == 1:
            self.frames = fusion.state_part(encoder.embed_state(first(features.unsqueeze(-2)))).unsqueeze(1)
        else:
            self.frames = first.project(features)
        self.row: Tensor | None = None
        if goals is not None:
            self.row = inverse_index(goals.to(features.device), encoder.frames.num_states)
            features = encoder.frames.lookup(goals)
        goal_first = (encoder.goal_branch or encoder.branch).first.repeated(features)
        self.goals = fusion.goal_part(encoder.embed_goal(goal_first))  # (G, hidden)

    @torch.no_grad()
    def fused(self, state: Tensor, goal: Tensor) -> Tensor:
        """(R, hidden) of ids (R, H) and (R,)."""
        encoder, fusion = self.trunk.encoder, self.trunk.fusion
        encoder.check_history(state.shape[1], "state_id")
        state = state[:, -encoder.history :]
        if self.place is not None:
            state = self.place[state]
        if self.known is not None:
            self._compute(state, self.known)
        goal_part = gather(self.goals, goal if self.row is None else self.row[goal])
        if encoder.history == 1:
            state_part = gather(self.frames.squeeze(1), state.squeeze(1))
        else:
            state_part = fusion.state_part(
                encoder.embed_state(encoder.branch.first.gather(self.frames, state))
            )
        return functional.relu(state_part + goal_part)

    def _compute(self, state: Tensor, known: Tensor) -> None:
        """Frames that are asked for at a place (R, H) for the first time."""
        encoder, fusion = self.trunk.encoder, self.trunk.fusion
        for place, ids in enumerate(state.unbind(1)):
            new = ids[~known[ids, place]].unique()
            if not len(new):
                continue
            layer = encoder.branch.first
            bias = layer.bias if encoder.history == 1 else None
            part = padded_linear(functional.embedding(new, self.features), layer.weight[place], bias)
            if encoder.history == 1:
                part = fusion.state_part(encoder.embed_state(part))
            self.frames[new, place] = part
            known[new, place] = True


def inverse_index(ids: Tensor, number: int) -> Tensor:
    """Place (number,) of every id among ``ids``; -1, with which every look-up fails, for the others."""
    place = torch.full((number,), -1, dtype=torch.int64, device=ids.device)
    place[ids] = torch.arange(len(ids), device=ids.device)
    return place


class SceneLayer(nn.Module):
    """A dense layer with ReLU, one per scene.

    >>> import torch
    >>> SceneLayer(2, 32, 32)(torch.randn(5, 32), torch.tensor([0, 1, 1, 0, 1])).shape
    torch.Size([5, 32])
    """

    def __init__(self, num_scenes: int, in_features: int, hidden_size: int) -> None:
        super().__init__()
        self.linear = SceneLinear(num_scenes, in_features, hidden_size)

    def forward(self, fused: Tensor, scene_id: RowScenes) -> Tensor:
        """(\\*B, in) with scene indices (\\*B,) to (\\*B, hidden_size)."""
        return functional.relu(self.linear(fused, scene_id))


def remember(
    lstm: Any, rows: Tensor, hidden: Tensor | None, cell: Tensor | None, is_init: Tensor
) -> tuple[Tensor, ...]:
    """One step of an LSTM on rows (R, F) with its state (R, layers, size), 0 at first or for None."""
    if hidden is None or cell is None:
        out, state = lstm(rows.unsqueeze(1))
    else:
        going = ~is_init.view(-1, 1, 1)
        out, state = lstm(rows.unsqueeze(1), tuple((x * going).transpose(0, 1) for x in (hidden, cell)))
    return out.squeeze(1), *(x.transpose(0, 1) for x in state)
