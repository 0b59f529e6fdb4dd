"""The siamese encoder: one set of weights for what the agent sees and for what it looks for.

phi(s) and phi(g) come from the same layers, so that they lie in one space. Batches of a few thousand steps
visit a few hundred different states; :meth:`SiameseEncoder.from_ids` encodes each DISTINCT state of the
batch once:

- the first layer, which holds nine tenths of the work, is a sum of one product a frame
  (:class:`~vusfa.modules.linear.HistoryLinear`): frames are multiplied once and histories are sums of the
  results;
- with a history of one frame all layers run on distinct states and rows are looked up at the very end;
- goals are always encoded once each;
- what is made of a code alone (a Gaussian, a normalised embedding) is made of distinct codes, too: the
  caller hands it over as a ``head``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from vusfa.errors import ConfigError
from vusfa.modules.frames import FeatureFrames, PictureFrames
from vusfa.modules.freezing import Freezable, for_autocast
from vusfa.modules.linear import HistoryLinear
from vusfa.modules.rows import is_steady, steady_number

__all__ = ["Branch", "Head", "Heads", "SiameseEncoder", "as_it_is", "interleaved", "num_parts"]

#: What follows the encoder row by row: codes (D, out) to one or several tensors of D rows. One for states and
#: one for goals; hashable, and equal where they do the same. A head may have a method ``alone``: of a part's
#: index, the head that makes this part, and nothing else, of the leading half of a code; None where that half
#: does not tell.
Head = Callable[[Tensor], Any]
Heads = tuple[Any, Any]


class Branch(nn.Module):
    """Frame features to embedding: a layer over the history, then dense layers.

    Args:
        history: frames H.
        in_features: F, features a frame.
        hidden_size: outputs of the first layer, which ends in a ReLU.
        out_features: outputs of the linear last layer; ``None`` for no second layer.
    """

    def __init__(self, history: int, in_features: int, hidden_size: int, out_features: int | None) -> None:
        super().__init__()
        self.first = HistoryLinear(history, in_features, hidden_size)
        self.last = None if out_features is None else nn.Linear(hidden_size, out_features)
        self._frozen: tuple[Tensor, Tensor] | None = None

    def finish(self, first: Tensor, extra: nn.Module | None = None, *, half: bool = False) -> Tensor:
        """What follows the first layer's sums (\\*B, hidden_size): ReLU, ``extra`` with ReLU, last layer; of
        that all outputs, or the leading half."""
        code = functional.relu(first)
        if extra is not None:
            code = functional.relu(extra(code))
        if self.last is None:
            return code
        if not half:
            return self.last(code)
        if self._frozen is not None and not torch.is_grad_enabled():
            return functional.linear(code, *self._frozen)
        return functional.linear(code, *self._half(self.last))

    @staticmethod
    def _half(last: nn.Linear) -> tuple[Tensor, Tensor]:
        outputs = last.out_features // 2
        return last.weight[:outputs], last.bias[:outputs]

    def freeze(self) -> None:
        """Converts half the last layer for autocast now, for calls without gradients until :meth:`thaw`:
        autocast would convert a part of a weight at every call."""
        if self.last is not None:
            weight, bias = self._half(self.last)
            self._frozen = for_autocast(weight.detach()), for_autocast(bias.detach())

    def thaw(self) -> None:
        """Uses the weights as they are again."""
        self._frozen = None


class SiameseEncoder(Freezable):
    """Embeds the state (its last H frames) and the goal (its one frame, in all H places).

    Args:
        frames: where the features of a frame come from.
        history: H.
        hidden_size: size of the first layer.
        out_features: size of the code; ``None`` leaves the linear second layer out, the code is the first
            layer's.
        shared: ``False`` gives the goal a branch of its own (the released USFA; not siamese any more).
        state_layer: one more dense layer for the state alone, before the last (the released VUSFA).
        by_id: calling the module means :meth:`from_ids`; ``False``: :meth:`from_observations`.

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
    ) -> None:
        super().__init__()
        self.history = history
        self.by_id = by_id
        self._frozen: tuple[Tensor, Tensor, Tensor | None] | None = None
        self._frozen_heads: dict[Heads, tuple[Any, Any]] = {}
        self.frames = frames
        self.branch = Branch(history, frames.size, hidden_size, out_features)
        self.goal_branch = None if shared else Branch(history, frames.size, hidden_size, out_features)
        self.state_layer = nn.Linear(hidden_size, hidden_size) if state_layer else None

    def forward(self, state: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """Codes of state and goal, (\\*B, out) each, float32."""
        return self.both(state, goal, (as_it_is, as_it_is))

    def both(self, state: Tensor, goal: Tensor, heads: Heads, part: int | None = None) -> tuple[Any, Any]:
        """What the two heads make of the codes of state and goal, (\\*B, ...) each; of tuples that they
        return, one part alone if it is named."""
        if self.by_id:
            return self.from_ids(state, goal, heads, part)
        codes = self.from_observations(state, goal)
        return _part(heads[0](codes[0].float()), part), _part(heads[1](codes[1].float()), part)

    def from_observations(self, observation: Tensor, goal_observation: Tensor) -> tuple[Tensor, Tensor]:
        """Codes of observations: every frame of every row is encoded.

        Args:
            observation: features (\\*B, H, F) or pictures (\\*B, H, 3, h, w) uint8, oldest first. Of a longer
                history the last H frames are read.
            goal_observation: (\\*B, F) or (\\*B, 3, h, w), one frame that fills all H places; or shaped as
                ``observation``, for a goal that is H frames itself.

        Returns:
            codes of state and goal, (\\*B, out) each.

        Raises:
            ConfigError: fewer than H frames.
        """
        state = self.branch.finish(self._first(self.branch, observation, "observation"), self.state_layer)
        branch = self.goal_branch or self.branch
        if goal_observation.dim() == observation.dim():
            return state, branch.finish(self._first(branch, goal_observation, "goal_observation"))
        return state, branch.finish(branch.first.repeated(self.frames.encode(goal_observation)))

    def _first(self, branch: Branch, frames: Tensor, key: str) -> Tensor:
        place = -1 - self.frames.frame_dims
        self._check_history(frames.size(place), key)
        history = frames.narrow(place, frames.size(place) - self.history, self.history)
        return branch.first(self.frames.encode(history))

    def from_ids(
        self, state_id: Tensor, goal_id: Tensor, heads: Heads | None = None, part: int | None = None
    ) -> tuple[Any, Any]:
        """Codes of states by id: each distinct state of the batch is encoded once.

        Args:
            state_id: (\\*B, H) int64, oldest first. Of a longer history the last H frames are read.
            goal_id: (\\*B,) int64.
            heads: of state and goal; they run on distinct codes where those are fewer than the rows.
            part: index of the one tensor that is wanted of those that the heads return; None for all.

        Returns:
            codes of state and goal, (\\*B, out) each, float32; or what the heads make of them.

        Raises:
            ConfigError: fewer than H frames.
        """
        self._check_history(state_id.shape[-1], "state_id")
        states, goals = state_id[..., -self.history :].reshape(-1, self.history), goal_id.reshape(-1)
        heads = heads or (as_it_is, as_it_is)
        if self._frozen is not None and (self._frozen[0].requires_grad or not torch.is_grad_enabled()):
            state, goal = self._from_frozen(states, goals, heads, part)
        else:
            state, goal = self._from_distinct(states, goals, heads, part)
        shape = goal_id.shape
        return _map(state, lambda rows: rows.view(*shape, -1)), _map(goal, lambda rows: rows.view(*shape, -1))

    def _from_distinct(
        self, states: Tensor, goals: Tensor, heads: Heads, part: int | None
    ) -> tuple[Any, Any]:
        features, state_row, goal_row = self._distinct_features(states, goals)
        goal_row, goal_index = torch.unique(goal_row, return_inverse=True)
        goal_row = self._steadily(goal_row)
        first = self.branch.first
        if self.history == 1:
            each = first(features.unsqueeze(-2))
            distinct = heads[0](self.branch.finish(each, self.state_layer).float())
            state = _lookup(_part(distinct, part), state_row.squeeze(-1))
            goal_first = functional.embedding(goal_row, each)
        elif len(features) <= len(states):
            projected = first.project(features)
            state = self._of_rows(first.gather(projected, state_row), heads[0], part)
            goal_first = first.gather(projected, goal_row.unsqueeze(-1).expand(-1, self.history))
        else:
            # Fewer rows than distinct frames: every frame with every place's weight would be the longer way.
            histories = functional.embedding(state_row, features)
            state = self._of_rows(first(histories), heads[0], part)
            goal_first = first.repeated(functional.embedding(goal_row, features))
        goal_branch = self.branch
        if self.goal_branch is not None:
            goal_branch = self.goal_branch
            goal_first = goal_branch.first.repeated(functional.embedding(goal_row, features))
        of_goal = heads[1](goal_branch.finish(goal_first).float())
        return state, _lookup(_part(of_goal, part), goal_index)

    def _distinct_features(self, states: Tensor, goals: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Features (D, F) of the batch's distinct states, and each id's row in them: (R, H) and (R,).

        All states of the world when the batch has at least as many rows: then the id is the row.
        """
        if len(goals) >= self.frames.num_states:
            return self.frames.lookup(None), states, goals
        distinct, row = torch.unique(torch.cat([states.flatten(), goals]), return_inverse=True)
        return (
            self.frames.lookup(self._steadily(distinct)),
            row[: states.numel()].view_as(states),
            row[states.numel() :],
        )

    def _steadily(self, distinct: Tensor) -> Tensor:
        """More of them, which nobody reads, so that their number is one of a few."""
        if is_steady(self.branch.first.bias):
            return distinct
        return functional.pad(distinct, (0, steady_number(len(distinct)) - len(distinct)))

    def _from_frozen(self, states: Tensor, goals: Tensor, heads: Heads, part: int | None) -> tuple[Any, Any]:
        assert self._frozen is not None
        state_part, goal_codes, goal_row = self._frozen
        one = self.history == 1
        if heads not in self._frozen_heads:
            # with gradients wherever the codes have them: collecting comes first, and has none
            with torch.set_grad_enabled(goal_codes.requires_grad):
                tables = heads[0](state_part) if one else None, heads[1](goal_codes)
            self._frozen_heads[heads] = tables
        state_table, goal_table = self._frozen_heads[heads]
        goal = _lookup(_part(goal_table, part), goals if goal_row is None else goal_row[goals])
        if one:
            return _lookup(_part(state_table, part), states.squeeze(-1)), goal
        return self._of_rows(self.branch.first.gather(state_part, states), heads[0], part), goal

    def _of_rows(self, sums: Tensor, head: Head, part: int | None) -> Any:
        """What the head makes of the codes of states, from the first layer's sums, row by row.

        Where the one part that is wanted reads the leading half of the code, the other half is not computed.
        """
        alone = head.alone(part) if part is not None and hasattr(head, "alone") else None
        if alone is not None:
            return alone(self.branch.finish(sums, self.state_layer, half=True).float())
        return _part(head(self.branch.finish(sums, self.state_layer).float()), part)

    def freeze(self, grad: bool = False, goals: Tensor | None = None) -> None:
        """Encodes all states of the world now; calls until :meth:`thaw` look them up."""
        if not self.by_id:
            return
        with torch.set_grad_enabled(grad):
            features, first = self.frames.lookup(None), self.branch.first
            if self.history == 1:
                state_part = self.branch.finish(first(features.unsqueeze(-2)), self.state_layer).float()
            else:
                state_part = first.project(features)
            goal_branch, row = self.goal_branch or self.branch, None
            if goals is not None:
                # -1 where a state is no goal: looking it up fails, and does not mistake it for another one
                row = torch.full((len(features),), -1, dtype=torch.int64, device=features.device)
                row[goals] = torch.arange(len(goals), device=features.device)
                features = features[goals]
            goal_codes = goal_branch.finish(goal_branch.first.repeated(features)).float()
        self._frozen = state_part, goal_codes, row
        self.branch.freeze()

    def thaw(self) -> None:
        """Encodes with the weights as they are again."""
        self._frozen = None
        self.branch.thaw()
        self._frozen_heads = {}

    def _check_history(self, frames: int, key: str) -> None:
        if frames < self.history:
            raise ConfigError(
                f"{key} has {frames} frames a row and the agent reads {self.history};"
                f" give the environment history={self.history}, or the agent history={frames}"
            )


def interleaved(of_state: Any, of_goal: Any) -> tuple[Tensor, ...]:
    """``(e_s, a_s, b_s), (e_g, a_g, b_g)`` to ``e_s, e_g, a_s, b_s, a_g, b_g``: embeddings first.

    >>> interleaved((1, 2, 3), (4, 5, 6))
    (1, 4, 2, 3, 5, 6)
    """
    if not isinstance(of_state, tuple):
        return of_state, of_goal
    return of_state[0], of_goal[0], *of_state[1:], *of_goal[1:]


def num_parts(head: Head) -> int:
    """How many tensors a head returns.

    >>> num_parts(as_it_is)
    1
    """
    return getattr(head, "parts", 1)


def as_it_is(code: Tensor) -> Tensor:
    """The head of whoever wants the codes themselves."""
    return code


def _map(parts: Any, function: Callable[[Tensor], Tensor]) -> Any:
    """``function`` of a tensor, or of each of several; of the same tensor once."""
    if isinstance(parts, Tensor):
        return function(parts)
    done: dict[int, Tensor] = {}
    return tuple(
        done[id(part)] if id(part) in done else done.setdefault(id(part), function(part)) for part in parts
    )


def _part(made: Any, part: int | None) -> Any:
    return made if part is None else made[part]


def _lookup(table: Any, index: Tensor) -> Any:
    return _map(table, lambda part: functional.embedding(index, part))
