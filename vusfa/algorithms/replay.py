"""Replay buffer with goals named in hindsight.

TorchRL's :class:`~torchrl.data.HERReplayBuffer` keeps one episode after the other and names goals of the same
episode. Here an episode is spread over many batches, half of the goals are any states that the agent has seen
in the scene, and the steps to a goal are recorded, too: the sampler is ours, storage and buffer TorchRL's.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from vusfa.algorithms.hindsight_goals import HindsightSampler
from vusfa.errors import CheckpointError, ConfigError

__all__ = ["HindsightReplay", "RankedReplay", "merge_replays", "share_of_replay"]


class HindsightReplay:
    """Replay buffer of a collector's batches, read with goals named in hindsight.

    Args:
        num_states, num_envs, horizon, own_future, discount: see :class:`HindsightSampler`; environments keep
            their order from batch to batch.
        capacity: frames kept; rounded down to whole steps of all environments.
        batch_size: transitions in a sample.

    Raises:
        ConfigError: a number out of its range, or a capacity below one step of all environments.

    >>> from vusfa.envs import TargetNavEnv
    >>> from vusfa.scenes import SceneSet
    >>> scenes = SceneSet.bundled(["bathroom"])
    >>> replay = HindsightReplay(scenes.num_states, num_envs=8, capacity=1000, batch_size=5)
    >>> replay.extend(TargetNavEnv(scenes, batch_size=[8], history=1).rollout(20, break_when_any_done=False))
    >>> sorted(replay.sample().keys())
    ['action', 'goal_id', 'next', 'scene_id', 'state_id', 'steps_to_goal']
    """

    def __init__(
        self,
        num_states: int,
        num_envs: int,
        *,
        capacity: int = 1_000_000,
        batch_size: int = 8192,
        horizon: int = 30,
        own_future: float = 0.5,
        discount: float | None = None,
    ) -> None:
        if capacity < num_envs or batch_size < 1:
            raise ConfigError(
                f"hindsight: capacity is {capacity} and batch_size {batch_size}; give {num_envs} (a step of"
                " every environment) or more, and 1 or more"
            )
        self.num_envs = num_envs
        self.sampler = HindsightSampler(num_envs, num_states, horizon, own_future, discount)
        self.buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(capacity // num_envs * num_envs),
            sampler=self.sampler,
            batch_size=batch_size,
        )
        self._clock = torch.zeros(num_envs, dtype=torch.int64)

    def __len__(self) -> int:
        """Frames on record."""
        return len(self.buffer)

    def extend(self, batch: TensorDictBase) -> None:
        """Add a collector's batch (num_envs, T), the continuation of the last one; a ``ConfigError`` where it
        is of another number of environments."""
        if batch.shape[0] != self.num_envs:
            raise ConfigError(
                f"hindsight: a batch of {batch.shape[0]} environments where {self.num_envs} were announced;"
                " a collector that hands over some of its environments at a time (multi_async) cannot be used"
            )
        done = batch.get(("next", "done")).squeeze(-1).long()
        skipped = done.cumsum(1) - done
        clock = self._clock.to(done.device).unsqueeze(-1) + torch.arange(done.shape[1], device=done.device)
        steps = TensorDict(
            {
                "state_id": batch.get("state_id"),
                "scene_id": batch.get("scene_id"),
                "action": batch.get("action"),
                "clock": clock + skipped,
                "next": TensorDict({"state_id": batch.get(("next", "state_id"))}, batch.shape),
            },
            batch.shape,
        )
        self._clock = clock[:, -1] + done.sum(1) + 1
        rows = steps.transpose(0, 1).reshape(-1)
        for ids in (rows.get("state_id"), rows.get(("next", "state_id"))):
            self.sampler.see(ids[..., -1], rows.get("scene_id"))
        self.buffer.extend(rows)

    def scenes(self) -> Tensor:
        """Scenes (n,) of the transitions on record, ascending."""
        if not len(self):
            return torch.empty(0, dtype=torch.int64)
        return self.buffer[:].get("scene_id").bincount().nonzero()[:, 0].cpu()

    def sample(self) -> TensorDictBase:
        """Transitions with ``goal_id`` and ``steps_to_goal``, (batch_size,)."""
        return self.buffer.sample().exclude("index", "clock")

    def state_dict(self) -> dict[str, Any]:
        """Content, as tensors and plain data."""
        rows = self.buffer[:].to_dict() if len(self) else {}
        return {
            "rows": rows,
            "writer": self.buffer.writer.state_dict(),
            "clock": self._clock,
            "sampler": self.sampler.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` gave, into a buffer of the same size.

        Raises:
            ConfigError: it is of another number of environments, or longer than the buffer.
            ValueError: it is not what :meth:`state_dict` gave.
        """
        capacity = self.buffer.storage.max_size
        length = len(state["rows"]["clock"]) if state["rows"] else 0
        if len(state["clock"]) != self.num_envs or length > capacity:
            raise ConfigError(
                f"hindsight: saved were {length} frames of {len(state['clock'])} environments, which do not"
                f" fit {capacity} of {self.num_envs}; leave hindsight.capacity and collector.num_envs as they"
                " were"
            )
        num_states = len(self.sampler.scene_of)
        scene_of = state["sampler"]["scene_of"]
        if scene_of.shape != (num_states,) or bool(((scene_of < -1) | (scene_of >= num_states)).any()):
            raise ValueError(f"seen states {tuple(scene_of.shape)} where there are {num_states}")
        if length:
            rows = state["rows"]
            _check_rows(rows, length, scene_of)
            self.buffer.extend(TensorDict(rows, [length]))
            writer = state["writer"]
            if isinstance(writer, int):  # of version 0.1: the position alone
                writer = dict.fromkeys(self.buffer.writer.state_dict(), writer)
            self.buffer.writer.load_state_dict(writer)
        self._clock = state["clock"]
        self.sampler.load_state_dict(state["sampler"])


class RankedReplay:
    """Base of algorithms with a :class:`HindsightReplay`, whose states ranks share out and join."""

    def merge_states(self, states: Sequence[dict[str, Any]]) -> dict[str, Any]:
        """With the replay buffer that one process would have."""
        if None in states:
            raise CheckpointError("the replay buffers of other ranks are gone")
        return {**states[0], "replay": merge_replays([state["replay"] for state in states])}

    def share_of_state(self, state: dict[str, Any], rank: int, size: int) -> dict[str, Any]:
        """With the transitions of the rank's environments."""
        replay = state.get("replay")
        return {**state, "replay": share_of_replay(replay, rank, size)} if replay else state


def merge_replays(states: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The ``state_dict`` of one buffer for all environments, from those of equal parts of them, in order."""
    first, num_envs, rows = states[0], len(states[0]["clock"]), {}
    if first["rows"]:
        parts = [TensorDict(state["rows"], [len(state["rows"]["clock"])]) for state in states]
        rows = _numbered(torch.cat([part.view(-1, num_envs) for part in parts], 1))
    seen = torch.stack([state["sampler"]["scene_of"] for state in states]).amax(0)
    return {
        "rows": rows,
        "writer": {name: number * len(states) for name, number in first["writer"].items()},
        "clock": torch.cat([state["clock"] for state in states]),
        "sampler": {"scene_of": seen},
    }


def share_of_replay(state: dict[str, Any], rank: int, size: int) -> dict[str, Any]:
    """The share of a ``state_dict`` that :func:`merge_replays` would have had in that place."""
    num_envs, rows = len(state["clock"]), state["rows"]
    if rows:
        rows = _numbered(TensorDict(rows, [len(rows["clock"])]).view(-1, num_envs).chunk(size, 1)[rank])
    return {
        **state,
        "rows": rows,
        "writer": {name: number // size for name, number in state["writer"].items()},
        "clock": state["clock"].chunk(size)[rank].clone(),
    }


def _numbered(steps: Any) -> dict[str, Any]:
    """Rows of a buffer, from steps (T, B) of environments."""
    rows = steps.reshape(-1).to_dict()
    rows["index"] = torch.arange(len(rows["clock"])).view_as(rows["index"])
    return rows


def _check_rows(rows: dict[str, Any], length: int, scene_of: Tensor) -> None:
    """Refuse rows that would be read out of bounds."""
    num_states = len(scene_of)
    shapes = {"scene_id": (length,), "action": (length,), "clock": (length,)}
    states = rows["state_id"], rows["next"]["state_id"]
    wrong = [name for name, shape in shapes.items() if rows[name].shape != shape or rows[name].min() < 0]
    if wrong or any(ids.ndim != 2 or len(ids) != length for ids in states):
        raise ValueError(f"rows of other shapes: {', '.join(wrong) or 'state_id'}")
    if any(bool((ids < 0).any() or (ids >= num_states).any()) for ids in states):
        raise ValueError(f"rows of states that are not among {num_states}")
    if bool((rows["scene_id"] > scene_of.max()).any()):
        raise ValueError("rows of scenes in which no state was seen")
