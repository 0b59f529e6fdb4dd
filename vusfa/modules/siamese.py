"""The siamese encoder: one set of weights for what the agent sees and for what it looks for.

phi(s) and phi(g) come from the same layers, so that they lie in one space. Batches of a few thousand steps
visit a few hundred different states; :meth:`SiameseEncoder.from_ids` encodes each DISTINCT state of the
batch once:

- the first layer, which holds nine tenths of the work, is a sum of one product a frame
  (:class:`~vusfa.modules.linear.HistoryLinear`): frames are multiplied once and histories are sums of the
  results;
- with a history of one frame all layers run on distinct states and rows are looked up at the very end;
- goals are always encoded once each.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from vusfa.modules.frames import FeatureFrames, PictureFrames
from vusfa.modules.linear import HistoryLinear

__all__ = ["Branch", "SiameseEncoder"]


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
        self.frames = frames
        self.branch = Branch(history, frames.size, hidden_size, out_features)
        self.goal_branch = None if shared else Branch(history, frames.size, hidden_size, out_features)
        self.state_layer = nn.Linear(hidden_size, hidden_size) if state_layer else None

    def forward(self, state: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """Codes of state and goal, (\\*B, out) each, float32."""
        codes = self.from_ids(state, goal) if self.by_id else self.from_observations(state, goal)
        # Under autocast the layers give half precision; embeddings are compared, summed and squared
        # further on.
        return codes[0].float(), codes[1].float()

    def from_observations(self, observation: Tensor, goal_observation: Tensor) -> tuple[Tensor, Tensor]:
        """Codes of observations: every frame of every row is encoded.

        Args:
            observation: features (\\*B, H, F) or pictures (\\*B, H, 3, h, w) uint8, oldest first. Of a
                longer history the last H frames are read.
            goal_observation: (\\*B, F) or (\\*B, 3, h, w).

        Returns:
            codes of state and goal, (\\*B, out) each.
        """
        frame_dims = (
            goal_observation.dim() - 1
            if goal_observation.dtype != torch.uint8
            else goal_observation.dim() - 3
        )
        history = observation.movedim(frame_dims, 0)[-self.history :].movedim(0, frame_dims)
        state_first = self.branch.first(self.frames.encode(history))
        goal_branch = self.goal_branch or self.branch
        goal_first = goal_branch.first.repeated(self.frames.encode(goal_observation))
        return self.branch.finish(state_first, self.state_layer), goal_branch.finish(goal_first)

    def from_ids(self, state_id: Tensor, goal_id: Tensor) -> tuple[Tensor, Tensor]:
        """Codes of states by id: each distinct state of the batch is encoded once.

        Args:
            state_id: (\\*B, H) int64, oldest first. Of a longer history the last H frames are read.
            goal_id: (\\*B,) int64.

        Returns:
            codes of state and goal, (\\*B, out) each.
        """
        batch = goal_id.shape
        states, goals = state_id[..., -self.history :].reshape(-1, self.history), goal_id.reshape(-1)
        features, state_row, goal_row = self._distinct_features(states, goals)
        # From here on a goal is a row of its own in `distinct_goal`, wherever it turns up in the batch.
        distinct_goal, goal_index = torch.unique(goal_row, return_inverse=True)
        if self.history == 1:
            first = self.branch.first(features.unsqueeze(-2))
            state_code = self.branch.finish(first, self.state_layer)[state_row.squeeze(-1)]
            goal_first = first[distinct_goal] if self.goal_branch is None else None
        elif len(features) <= len(states):
            projected = self.branch.first.project(features)
            state_code = self.branch.finish(self.branch.first.gather(projected, state_row), self.state_layer)
            goal_first = self.branch.first.gather(
                projected, distinct_goal.unsqueeze(-1).expand(-1, self.history)
            )
        else:
            # Fewer rows than distinct frames: multiplying every frame with every place's weight would be
            # the longer way.
            state_code = self.branch.finish(self.branch.first(features[state_row]), self.state_layer)
            goal_first = None
        goal_branch = self.goal_branch or self.branch
        if goal_first is None or self.goal_branch is not None:
            goal_first = goal_branch.first.repeated(features[distinct_goal])
        goal_code = goal_branch.finish(goal_first)[goal_index]
        return state_code.view(*batch, -1), goal_code.view(*batch, -1)

    def _distinct_features(self, states: Tensor, goals: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Features (D, F) of the batch's distinct states, and each id's row in them: (R, H) and (R,).

        All states of the world when the batch has at least as many rows: then the id is the row.
        """
        if len(goals) >= self.frames.num_states:
            return self.frames.lookup(None), states, goals
        distinct, row = torch.unique(torch.cat([states.flatten(), goals]), return_inverse=True)
        return self.frames.lookup(distinct), row[: states.numel()].view_as(states), row[states.numel() :]
