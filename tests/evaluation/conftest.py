"""Policies whose walks can be foretold."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from vusfa.scenes import Scene, SceneSet


class Guide(TensorDictModuleBase):
    """Walks the shortest path, the lowest action first."""

    in_keys: ClassVar = ["state_id", "goal_id"]
    out_keys: ClassVar = ["action"]

    def __init__(self, scenes: SceneSet) -> None:
        super().__init__()
        self.scenes = scenes

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        reached = self.scenes.successor[tensordict["state_id"][..., -1]]
        left = self.scenes.distance(reached, tensordict["goal_id"].unsqueeze(-1))
        left = torch.where(left < 0, 10**6, left)
        return tensordict.set("action", left.argmin(-1))


class Turner(TensorDictModuleBase):
    """Does the same thing all the time."""

    in_keys: ClassVar = ["state_id"]
    out_keys: ClassVar = ["action"]

    def __init__(self, action: int) -> None:
        super().__init__()
        self.action = action

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set("action", torch.full_like(tensordict["goal_id"], self.action))


class Dice(TensorDictModuleBase):
    """Walks at random; counts the rows that it was asked about."""

    in_keys: ClassVar = ["state_id"]
    out_keys: ClassVar = ["action"]
    rows = 0

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.rows += tensordict.numel()
        return tensordict.set("action", torch.randint(4, tensordict.shape))


class Counter(TensorDictModuleBase):
    """Has a memory: forward on every third step of its own counting, else it turns right."""

    in_keys: ClassVar = ["state_id", "count", "is_init"]
    out_keys: ClassVar = ["action", ("next", "count")]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        count = tensordict.get("count", torch.zeros(*tensordict.shape, 1, dtype=torch.int64))
        assert torch.equal(tensordict["is_init"], count == 0)
        tensordict["action"] = torch.where(count.squeeze(-1) % 3 == 2, 0, 1)
        tensordict["next", "count"] = count + 1
        return tensordict


@pytest.fixture
def rooms(make_scene: Callable[..., Scene]) -> SceneSet:
    """Two rooms, 16 and 24 states."""
    return SceneSet([make_scene("hall"), make_scene("attic", width=3)])


@pytest.fixture
def island(make_scene: Callable[..., Scene]) -> SceneSet:
    """A corridor of 4 states (the last a trap that one enters and never leaves) and a state that none
    enters."""
    graph = torch.tensor([[1, -1], [2, 0], [3, 1], [-1, -1], [0, -1]])
    return SceneSet([Scene("trap", graph, torch.rand(5, 1, 4))])


@pytest.fixture
def guide(rooms: SceneSet) -> Guide:
    return Guide(rooms)


@pytest.fixture
def policies() -> dict[str, type]:
    return {"guide": Guide, "turner": Turner, "dice": Dice, "counter": Counter}
