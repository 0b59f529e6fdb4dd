"""What part of a world a policy is tabulated for, and whether that pays."""

from __future__ import annotations

import torch
from torch import Tensor

from vusfa.scenes import SceneSet

__all__ = ["PAIRS_PER_ROW", "states_around", "table_pays"]

#: A table is made where it has at most this many pairs of state and goal per row that will be asked for.
PAIRS_PER_ROW = 3


def states_around(scenes: SceneSet, goals: Tensor) -> Tensor | None:
    """Ids (n,) of the states of the scenes of goals, ascending; None where they are half of all or more, and
    their features are in memory.

    >>> states_around(SceneSet.bundled(), torch.tensor([3, 9])).shape
    torch.Size([176])
    """
    scene = scenes.scene_id[goals.to(scenes.device)].unique()
    first, end = scenes.offsets[scene].tolist(), scenes.offsets[scene + 1].tolist()
    states = [torch.arange(*pair, device=scenes.device) for pair in zip(first, end, strict=True)]
    few = scenes.is_lazy or 2 * sum(map(len, states)) < scenes.num_states
    return torch.cat(states) if few else None


def table_pays(scenes: SceneSet, goals: Tensor | None, rows: int | None) -> bool:
    """Whether a table costs less than its look-ups save; a pair costs little in a large product."""
    if rows is None:
        return True
    scene = scenes.scene_id if goals is None else scenes.scene_id[goals.to(scenes.device).unique()]
    return int(scenes.offsets.diff()[scene].sum()) <= PAIRS_PER_ROW * rows
