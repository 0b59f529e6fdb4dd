"""Siamese encoder phi: the same weights for the agent's state and its goal.

Features go through a layer over the history (:class:`~vusfa.modules.HistoryLinear`) and a linear layer. The
result is phi or, with a bottleneck, mean and scale of a Gaussian whose mean is phi. Ids are encoded once per
distinct state and goal of a batch (:mod:`vusfa.modules.unique`): :meth:`SiameseEncoder.first_layer` computes
nine tenths of the work, a product per distinct frame, whose sums are histories; ``encode_*`` and ``embed_*``
what follows.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from vusfa.errors import ConfigError
from vusfa.modules.bottleneck import GaussianBottleneck
from vusfa.modules.frames import FeatureFrames, PictureFrames
from vusfa.modules.linear import HistoryLinear
from vusfa.modules.precision import full_precision, is_bucketed
from vusfa.modules.unique import Rows, gather, shapes_may_vary, unique_rows

__all__ = ["Branch", "Encoding", "SiameseEncoder"]


class Encoding(NamedTuple):
    """Encodings of D states, or of D goals.

    Attributes:
        embedding: phi, (D, E).
        loc, scale: (D, E), of the Gaussian, with a bottleneck.
        kl: (D, 1), its divergence from N(0, 1) in nats, with a bottleneck.
    """

    embedding: Tensor
    loc: Tensor | None = None
    scale: Tensor | None = None
    kl: Tensor | None = None

    def gather(self, index: Tensor | None, batch: torch.Size) -> Encoding:
        """Encodings of rows, (\\*batch, ...) each; a tensor that occurs twice is looked up once."""
        parts = {id(part): gather(part, index).view(*batch, -1) for part in self if part is not None}
        return Encoding(parts[id(self.embedding)], *(parts.get(id(part)) for part in self[1:]))


class Branch(nn.Module):
    """Features of H frames to a code: a layer over the history with ReLU, then a linear one (None: none)."""

    def __init__(self, history: int, in_features: int, hidden_size: int, out_features: int | None) -> None:
        super().__init__()
        self.first = HistoryLinear(history, in_features, hidden_size)
        self.last = None if out_features is None else nn.Linear(hidden_size, out_features)

    def finish(self, first: Tensor, extra: nn.Module | None = None, *, half: bool = False) -> Tensor:
        """Codes from the first layer's sums (\\*B, hidden_size): ReLU, ``extra`` with ReLU, last layer or the
        leading ``half`` of its outputs."""
        code = functional.relu(first)
        if extra is not None:
            code = functional.relu(extra(code))
        if self.last is None:
            return code
        if not half:
            return self.last(code)
        outputs = self.last.out_features // 2
        return functional.linear(code, self.last.weight[:outputs], self.last.bias[:outputs])


class SiameseEncoder(nn.Module):
    """Embedding of the state (its last H frames) and the goal (its one frame, in all H places).

    Args:
        frames: where the features of a frame come from.
        history: H.
        hidden_size: size of the first layer.
        out_features: E, size of phi; ``None`` leaves the linear second layer out.
        shared: ``False`` gives the goal weights of its own (the released USFA).
        state_layer: one more dense layer for the state alone, before the last (the released VUSFA).
        by_id: the module reads ids of states; ``False``: observations.
        bottleneck: makes a Gaussian of each code; phi is its mean.
        deduplicate: encode each distinct state and goal of a batch of ids once. ``False`` encodes row by row,
            as is done in any case while compiling, exporting or under ``torch.vmap``.
        normalize: bring phi to mean 0 and deviation 1 over its E dimensions. Without it, phi, psi and V can
            drive each other up without bound; with a bottleneck, pi and psi go on reading full-sized means
            while the KL term presses those that omega's sample is made of towards 0.

    >>> from vusfa.scenes import SceneSet
    >>> scenes = SceneSet.bundled(["bathroom"])
    >>> encoder = SiameseEncoder(FeatureFrames(scenes.features), history=4, hidden_size=32, out_features=16)
    >>> state, goal = encoder(torch.randint(176, (5, 4)), torch.randint(176, (5,)))
    >>> state.shape, goal.shape
    (torch.Size([5, 16]), torch.Size([5, 16]))
    """

    def __init__(
        self,
        frames: FeatureFrames | PictureFrames,
        history: int = 4,
        hidden_size: int = 512,
        out_features: int | None = 512,
        *,
        shared: bool = True,
        state_layer: bool = False,
        by_id: bool = True,
        bottleneck: GaussianBottleneck | None = None,
        normalize: bool = False,
        deduplicate: bool = True,
    ) -> None:
        super().__init__()
        self.history = history
        self.by_id = by_id
        self.normalize = normalize
        self.deduplicate = deduplicate
        self.frames = frames
        self.bottleneck = bottleneck
        if bottleneck is not None:
            assert out_features is not None, "a Gaussian's mean and scale come from a linear second layer"
            out_features = 2 * out_features
        self.branch = Branch(history, frames.size, hidden_size, out_features)
        self.goal_branch = None if shared else Branch(history, frames.size, hidden_size, out_features)
        self.state_layer = nn.Linear(hidden_size, hidden_size) if state_layer else None
        for branch in (self.branch, self.goal_branch):
            if bottleneck is not None and branch is not None and branch.last is not None:
                bottleneck.start(branch.last)

    def forward(self, state: Tensor, goal: Tensor) -> tuple[Tensor, ...]:
        """Encodings of states and goals, row by row.

        Args:
            state: ids (\\*B, H) int64, or features (\\*B, H, F) or pictures (\\*B, H, 3, h, w) uint8, oldest
                first. Of a longer history the last H frames are read.
            goal: ids (\\*B,), or one frame (\\*B, F) or (\\*B, 3, h, w), which fills all H places; or shaped
                as ``state``, for a goal that is H observations itself.

        Returns:
            phi of state and goal; with a bottleneck then mean, scale and KL of the state's Gaussian, and
            those of the goal's. All (\\*B, E), the KL (\\*B, 1).

        Raises:
            ConfigError: fewer than H frames.
        """
        states, goals = self.first_layer(state, goal)
        batch = self.batch_shape(state)
        of_state = self.encode_state(states.values).gather(states.inverse, batch)
        of_goal = self.encode_goal(goals.values).gather(goals.inverse, batch)
        return joined(of_state, of_goal)

    def check_ids(self, state: Tensor, goal: Tensor) -> None:
        """Raise a ConfigError for ids outside the world, where an operation on them has failed."""
        for name, ids in (("state_id", state), ("goal_id", goal)) if self.by_id else ():
            wrong = ids[(ids < 0) | (ids >= self.frames.num_states)]
            if len(wrong):
                raise ConfigError(
                    f"{name} holds {int(wrong[0])}, and the agent's scenes have the states"
                    f" 0..{self.frames.num_states - 1}; make the agent with the environment's scenes, or take"
                    " it there with vusfa.modules.transplant"
                )

    def batch_shape(self, state: Tensor) -> torch.Size:
        """\\*B of what :meth:`forward` reads as ``state``."""
        return state.shape[:-1] if self.by_id else state.shape[: -1 - self.frames.frame_dims]

    def encode_state(self, first: Tensor) -> Encoding:
        """Encodings of states from the first layer's sums (D, hidden_size)."""
        return self._encoding(self._full(self.branch.finish(first, self.state_layer)))

    def encode_goal(self, first: Tensor) -> Encoding:
        """Encodings of goals from the first layer's sums (D, hidden_size)."""
        return self._encoding(self._full((self.goal_branch or self.branch).finish(first)))

    def embed_state(self, first: Tensor) -> Tensor:
        """phi (D, E) alone: a Gaussian's scale is not computed."""
        half = self.bottleneck is not None
        return self._phi(self._full(self.branch.finish(first, self.state_layer, half=half)))

    def embed_goal(self, first: Tensor) -> Tensor:
        """phi (D, E) of goals alone, as :meth:`embed_state`."""
        branch = self.goal_branch or self.branch
        return self._phi(self._full(branch.finish(first, half=self.bottleneck is not None)))

    def _full(self, code: Tensor) -> Tensor:
        return full_precision(code, self.branch.first.weight)

    def _encoding(self, code: Tensor) -> Encoding:
        if self.bottleneck is None:
            return Encoding(self._phi(code))
        loc, scale, kl = self.bottleneck(code)
        return Encoding(self._phi(loc), loc, scale, kl)

    def _phi(self, code: Tensor) -> Tensor:
        return functional.layer_norm(code, code.shape[-1:]) if self.normalize else code

    def first_layer(self, state: Tensor, goal: Tensor) -> tuple[Rows, Rows]:
        """The first layer's sums of states and of goals; arguments and errors of :meth:`forward`.

        Returns:
            for states and for goals, sums (D, hidden_size) and the row of each of the R rows among them.
        """
        if not self.by_id:
            return self._observed(state, goal)
        self.check_history(state.shape[-1], "state_id")
        if not (self.deduplicate and shapes_may_vary(state)):
            lookup = self.frames.lookup
            return self._row_by_row(lookup(state[..., -self.history :]), lookup(goal))
        states, goals = state[..., -self.history :].reshape(-1, self.history), goal.reshape(-1)
        features, states, goals = self._distinct_frames(states, goals)
        unique, first = unique_rows(goals), self.branch.first
        (goals,), goal_index = unique.padded() if is_bucketed(first.bias) else unique
        if self.history == 1:
            sums = first(features.unsqueeze(-2))
            state_rows, goal_sums = Rows(sums, states.squeeze(-1)), functional.embedding(goals, sums)
        elif len(features) <= len(states):
            projected = first.project(features)
            state_rows = Rows(first.gather(projected, states))
            goal_sums = first.gather(projected, goals.unsqueeze(-1).expand(-1, self.history))
        else:
            # Fewer rows than distinct frames: every frame with every place's weight would be the longer way.
            state_rows = Rows(first(functional.embedding(states, features)))
            goal_sums = first.repeated(functional.embedding(goals, features))
        if self.goal_branch is not None:
            goal_sums = self.goal_branch.first.repeated(functional.embedding(goals, features))
        return state_rows, Rows(goal_sums, goal_index)

    def _distinct_frames(self, states: Tensor, goals: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Features (D, F) of the distinct frames, and the rows of states (R, H) and goals (R,) among them.

        With as many rows as the world has states: of all states, so that the id is the row.
        """
        if len(goals) >= self.frames.num_states and not self.frames.is_lazy:
            return self.frames.lookup(None), states, goals
        unique = unique_rows(torch.cat([states.flatten(), goals]))
        (distinct,), index = unique.padded() if is_bucketed(self.branch.first.bias) else unique
        number = states.numel()
        return self.frames.lookup(distinct), index[:number].view_as(states), index[number:]

    def _observed(self, state: Tensor, goal: Tensor) -> tuple[Rows, Rows]:
        """As :meth:`first_layer`, of observations."""
        several = goal.dim() == state.dim()
        goals = self._newest(goal, "goal_observation") if several else self.frames.encode(goal)
        return self._row_by_row(self._newest(state, "observation"), goals)

    def _row_by_row(self, states: Tensor, goals: Tensor) -> tuple[Rows, Rows]:
        """Every frame of every row, from features (\\*B, H, F), and (\\*B, F) or (\\*B, H, F)."""
        goal_first = (self.goal_branch or self.branch).first
        goal_sums = goal_first(goals) if goals.dim() == states.dim() else goal_first.repeated(goals)
        state_sums = self.branch.first(states)
        return tuple(Rows(sums.reshape(-1, sums.shape[-1])) for sums in (state_sums, goal_sums))  # type: ignore[return-value]

    def _newest(self, frames: Tensor, key: str) -> Tensor:
        """Features (\\*B, H, F) of the last H frames."""
        place = -1 - self.frames.frame_dims
        self.check_history(frames.size(place), key)
        return self.frames.encode(frames.narrow(place, frames.size(place) - self.history, self.history))

    def check_history(self, frames: int, key: str) -> None:
        """Raise a ConfigError where an observation has fewer frames than the encoder reads."""
        if frames < self.history:
            raise ConfigError(
                f"{key} has {frames} frames a row and the agent reads {self.history};"
                f" give the environment history={self.history}, or the agent history={frames}"
            )


def joined(of_state: Encoding, of_goal: Encoding) -> tuple[Tensor, ...]:
    """Both embeddings first, then what else there is of the state, then of the goal."""
    parts = (of_state.embedding, of_goal.embedding, *of_state[1:], *of_goal[1:])
    return tuple(part for part in parts if part is not None)
