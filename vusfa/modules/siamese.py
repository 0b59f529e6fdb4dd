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

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from vusfa.errors import ConfigError
from vusfa.modules.frames import FeatureFrames, PictureFrames
from vusfa.modules.linear import HistoryLinear, SceneLinear

__all__ = ["Branch", "Head", "NormalisedEncoder", "SiameseEncoder", "frozen"]

#: What follows the encoder row by row: codes (D, out) to one or several tensors of D rows.
Head = Callable[[Tensor], Any]


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

    def finish(self, first: Tensor, extra: nn.Module | None = None) -> Tensor:
        """What follows the first layer's sums (\\*B, hidden_size): ReLU, ``extra`` with ReLU, last layer."""
        code = functional.relu(first)
        if extra is not None:
            code = functional.relu(extra(code))
        return code if self.last is None else self.last(code)


class SiameseEncoder(nn.Module):
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
        self._frozen: tuple[Tensor, Tensor] | None = None
        self._frozen_heads: dict[Head | None, tuple[Any, Any]] = {}
        self.frames = frames
        self.branch = Branch(history, frames.size, hidden_size, out_features)
        self.goal_branch = None if shared else Branch(history, frames.size, hidden_size, out_features)
        self.state_layer = nn.Linear(hidden_size, hidden_size) if state_layer else None

    def forward(self, state: Tensor, goal: Tensor, head: Head | None = None) -> tuple[Any, Any]:
        """Codes of state and goal, (\\*B, out) each, float32; with a ``head``, what that makes of them."""
        if self.by_id:
            return self.from_ids(state, goal, head)
        codes = self.from_observations(state, goal)
        return _finish(codes[0], head), _finish(codes[1], head)

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

    def from_ids(self, state_id: Tensor, goal_id: Tensor, head: Head | None = None) -> tuple[Any, Any]:
        """Codes of states by id: each distinct state of the batch is encoded once.

        Args:
            state_id: (\\*B, H) int64, oldest first. Of a longer history the last H frames are read.
            goal_id: (\\*B,) int64.
            head: runs on distinct codes where they are fewer than the rows.

        Returns:
            codes of state and goal, (\\*B, out) each, float32; or what ``head`` makes of them.

        Raises:
            ConfigError: fewer than H frames.
        """
        self._check_history(state_id.shape[-1], "state_id")
        states, goals = state_id[..., -self.history :].reshape(-1, self.history), goal_id.reshape(-1)
        if self._frozen is not None and not torch.is_grad_enabled():
            state, goal = self._from_frozen(states, goals, head)
        else:
            state, goal = self._from_distinct(states, goals, head)
        shape = goal_id.shape
        return _map(state, lambda rows: rows.view(*shape, -1)), _map(goal, lambda rows: rows.view(*shape, -1))

    def _from_distinct(self, states: Tensor, goals: Tensor, head: Head | None) -> tuple[Any, Any]:
        features, state_row, goal_row = self._distinct_features(states, goals)
        goal_row, goal_index = torch.unique(goal_row, return_inverse=True)
        first = self.branch.first
        if self.history == 1:
            each = first(features.unsqueeze(-2))
            distinct = _finish(self.branch.finish(each, self.state_layer), head)
            state = _lookup(distinct, state_row.squeeze(-1))
            goal_first = functional.embedding(goal_row, each)
        elif len(features) <= len(states):
            projected = first.project(features)
            code = self.branch.finish(first.gather(projected, state_row), self.state_layer)
            state = _finish(code, head)
            goal_first = first.gather(projected, goal_row.unsqueeze(-1).expand(-1, self.history))
        else:
            # Fewer rows than distinct frames: every frame with every place's weight would be the longer way.
            histories = functional.embedding(state_row, features)
            state = _finish(self.branch.finish(first(histories), self.state_layer), head)
            goal_first = first.repeated(functional.embedding(goal_row, features))
        goal_branch = self.branch
        if self.goal_branch is not None:
            goal_branch = self.goal_branch
            goal_first = goal_branch.first.repeated(functional.embedding(goal_row, features))
        return state, _lookup(_finish(goal_branch.finish(goal_first), head), goal_index)

    def _distinct_features(self, states: Tensor, goals: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Features (D, F) of the batch's distinct states, and each id's row in them: (R, H) and (R,).

        All states of the world when the batch has at least as many rows: then the id is the row.
        """
        if len(goals) >= self.frames.num_states:
            return self.frames.lookup(None), states, goals
        distinct, row = torch.unique(torch.cat([states.flatten(), goals]), return_inverse=True)
        return self.frames.lookup(distinct), row[: states.numel()].view_as(states), row[states.numel() :]

    def _from_frozen(self, states: Tensor, goals: Tensor, head: Head | None) -> tuple[Any, Any]:
        assert self._frozen is not None
        state_part, goal_codes = self._frozen
        one = self.history == 1
        if head not in self._frozen_heads:
            self._frozen_heads[head] = _finish(state_part, head) if one else None, _finish(goal_codes, head)
        state_table, goal_table = self._frozen_heads[head]
        goal = _lookup(goal_table, goals)
        if one:
            return _lookup(state_table, states.squeeze(-1)), goal
        code = self.branch.finish(self.branch.first.gather(state_part, states), self.state_layer)
        return _finish(code, head), goal

    @torch.no_grad()
    def freeze(self) -> None:
        """Encodes all states of the world now; calls without gradients look them up until :meth:`thaw`.

        For evaluation, where the weights stand still. Changing them meanwhile changes nothing that is
        looked up.
        """
        if not self.by_id:
            return
        features, first = self.frames.lookup(None), self.branch.first
        if self.history == 1:
            state_part = self.branch.finish(first(features.unsqueeze(-2)), self.state_layer)
        else:
            state_part = first.project(features)
        goal_branch = self.goal_branch or self.branch
        self._frozen = (state_part, goal_branch.finish(goal_branch.first.repeated(features)))

    def thaw(self) -> None:
        """Encodes with the weights as they are again."""
        self._frozen = None
        self._frozen_heads = {}

    def _check_history(self, frames: int, key: str) -> None:
        if frames < self.history:
            raise ConfigError(
                f"{key} has {frames} frames a row and the agent reads {self.history};"
                f" give the environment history={self.history}, or the agent history={frames}"
            )


class NormalisedEncoder(nn.Module):
    """An encoder whose two embeddings are brought to mean 0 and deviation 1 over their E dimensions.

    phi is then of one size whatever the weights do. Without it, phi, psi and V = psi . omega can drive each
    other up without bound; with a bottleneck, pi and psi go on reading full-sized means while the KL term
    presses the means that omega's sample is made of towards 0. What else the encoder returns (the Gaussians'
    means and scales) passes as it is.

    Args:
        encoder: returns the two embeddings first, (\\*B, E) each.

    >>> def encoder(state, goal, head):
    ...     return head(2 * state), head(goal - 5.0)
    >>> state, goal = NormalisedEncoder(encoder)(torch.tensor([[-1.0, 1.0]]), torch.tensor([[3.0, 1.0]]))
    >>> state.round(decimals=3), goal.round(decimals=3)
    (tensor([[-1.,  1.]]), tensor([[ 1., -1.]]))
    """

    def __init__(self, encoder: Callable[..., tuple[Tensor, ...]]) -> None:
        super().__init__()
        self.encoder = encoder

    def forward(self, state: Tensor, goal: Tensor) -> tuple[Tensor, ...]:
        """The encoder's outputs, the first two normalised."""
        return self.encoder(state, goal, _normalised)


def _normalised(embedding: Tensor) -> Tensor:
    return functional.layer_norm(embedding, embedding.shape[-1:])


def _finish(code: Tensor, head: Head | None) -> Any:
    # Under autocast the layers give half precision; embeddings are compared, summed and squared further on.
    code = code.float()
    return code if head is None else head(code)


def _map(parts: Any, function: Callable[[Tensor], Tensor]) -> Any:
    """``function`` of a tensor, or of each of several; of the same tensor once."""
    if isinstance(parts, Tensor):
        return function(parts)
    done: dict[int, Tensor] = {}
    return tuple(
        done[id(part)] if id(part) in done else done.setdefault(id(part), function(part)) for part in parts
    )


def _lookup(table: Any, index: Tensor) -> Any:
    return _map(table, lambda part: functional.embedding(index, part))


@contextmanager
def frozen(module: nn.Module) -> Iterator[None]:
    """Within it, every siamese encoder in ``module`` looks up what it encoded on the way in, and scenes'
    weights are converted for autocast once.

    The weights must not change meanwhile. Gradients are not affected: with gradients on, encoding is done
    anew. Other modules are left as they are, so any policy may be passed.

    >>> from vusfa.modules import make_agent
    >>> from vusfa.scenes import SceneSet
    >>> agent = make_agent("usfa", scenes=SceneSet.bundled(["bathroom"]))
    >>> with frozen(agent), torch.no_grad():
    ...     state, goal = agent.encoder(torch.zeros(3, 4, dtype=torch.int64), torch.arange(3))
    """
    parts = [part for part in module.modules() if isinstance(part, SiameseEncoder | SceneLinear)]
    try:
        for part in parts:
            part.freeze()
        yield
    finally:
        for part in parts:
            part.thaw()
