"""Goals named in hindsight, for transitions in a time-major storage."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torchrl.data.replay_buffers import RandomSampler, Storage

from vusfa.errors import ConfigError

__all__ = ["HindsightSampler", "drawn_steps", "steps_ahead"]


def steps_ahead(clock: Tensor, row: Tensor, num_envs: int, horizon: int) -> Tensor:
    """Number of recorded steps from each row on to the end of its episode, itself included.

    Args:
        clock: (N,) int64, time-major: row i + num_envs is the same environment's next step. The clock counts
            steps and leaves one number out where an episode ends.
        row: (n,) int64, rows to start from.
        num_envs: environments.
        horizon: the largest number returned.

    Returns:
        (n,) int64, 1 to ``horizon``.

    >>> clock = torch.tensor([0, 0, 1, 2, 2, 3])  # two environments; the second's episode ends at once
    >>> steps_ahead(clock, torch.tensor([0, 1, 3]), num_envs=2, horizon=5)
    tensor([3, 1, 2])
    """
    ahead = torch.arange(horizon, device=clock.device)
    later = clock[(row.unsqueeze(-1) + ahead * num_envs) % len(clock)]
    on_record = later == clock[row].unsqueeze(-1) + ahead
    return on_record.long().cumprod(-1).sum(-1)


def drawn_steps(most: Tensor, discount: float | None = None) -> Tensor:
    r"""Draw a number of steps k for each row, 1 to ``most``, uniformly or geometrically.

    .. math::
        P(k) = \frac{(1 - \gamma) \gamma^{k - 1}}{1 - \gamma^{n}}, \qquad 1 \le k \le n

    Args:
        most: n, int64 of any shape, 1 or more.
        discount: gamma, in (0, 1); None: uniformly.

    >>> drawn_steps(torch.tensor([1, 1, 1]), 0.9)
    tensor([1, 1, 1])
    """
    if discount is None:  # in float32, as version 0.1 drew them
        return 1 + (torch.rand_like(most, dtype=torch.float32) * most).long()
    share = torch.rand_like(most, dtype=torch.float64)
    # the inverse of P(k <= x) = (1 - gamma^x) / (1 - gamma^n)
    below = torch.log1p(-share * (1 - discount ** most.double())) / math.log(discount)
    return torch.minimum(1 + below.long(), most)


class HindsightSampler(RandomSampler):
    """Uniform sampler of transitions, and of a goal for each: a state that the same episode reached later, or
    any state of the scene that the agent has seen.

    It adds ``goal_id``, int64, and ``steps_to_goal``, int64, 0 for a goal of the second kind. Rows are sorted
    by scene and state, with which per-scene layers are fastest.

    Args:
        num_envs: environments; the storage is time-major, see :func:`steps_ahead`.
        num_states: of all scenes; ids are below it.
        horizon: the farthest goal of the first kind, in steps.
        own_future: share of goals of the first kind.
        discount: these are drawn with weight discount^steps, in (0, 1); None: uniformly.

    >>> sampler = HindsightSampler(num_envs=1, num_states=9)
    >>> sampler.see(torch.tensor([2, 5, 7, 2]), torch.tensor([0, 0, 1, 0]))
    >>> sampler.seen.nonzero().squeeze(-1)
    tensor([2, 5, 7])
    """

    def __init__(
        self,
        num_envs: int,
        num_states: int,
        horizon: int = 30,
        own_future: float = 0.5,
        discount: float | None = None,
    ) -> None:
        if discount is not None and not 0 < discount < 1:
            raise ConfigError(f"hindsight: discount is {discount}; give a number between 0 and 1")
        if num_envs < 1 or horizon < 1 or not 0 <= own_future <= 1:
            raise ConfigError(
                f"hindsight: num_envs is {num_envs}, horizon {horizon} and own_future {own_future}; give 1 or"
                " more, 1 or more, and a number between 0 and 1"
            )
        super().__init__()
        self.num_envs, self.horizon, self.own_future = num_envs, horizon, own_future
        self.discount = discount
        self.scene_of = torch.full((num_states,), -1)
        self._tabulate()

    @property
    def seen(self) -> Tensor:
        """(S,) bool: states that the agent has been in."""
        return self.scene_of >= 0

    def see(self, state: Tensor, scene: Tensor) -> None:
        """Record seen states (ids of any shape) of these scenes."""
        self.scene_of = self.scene_of.to(state.device)
        if not self.seen[state].all():
            self.scene_of[state] = scene
            self._tabulate()

    def _tabulate(self) -> None:
        """Tabulate seen states by scene: ids, their number, and where each scene begins."""
        known = self.seen.nonzero().squeeze(-1)
        scene = self.scene_of[known]
        self._states = known[scene.argsort(stable=True)]
        self._number = torch.bincount(scene)
        self._first = self._number.cumsum(0) - self._number

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict[str, Tensor]]:
        """Rows of the storage, (batch_size,), and their goals."""
        data = storage[:]
        clock, state = data.get("clock"), data.get("state_id")[..., -1]
        row = torch.randint(len(clock), (batch_size,), device=clock.device)
        row = row[state[row].argsort()]
        steps = steps_ahead(clock, row, self.num_envs, self.horizon)
        steps = drawn_steps(steps, self.discount)
        last = (row + (steps - 1) * self.num_envs) % len(clock)
        own = data.get(("next", "state_id"))[..., -1][last]
        chosen = torch.rand_like(steps, dtype=torch.float32) < self.own_future
        goal = torch.where(chosen, own, self.any_seen(data.get("scene_id")[row]))
        return row, {"goal_id": goal, "steps_to_goal": torch.where(chosen, steps, 0)}

    def any_seen(self, scene: Tensor) -> Tensor:
        """Draw a seen state of each of these scenes (n,), uniformly."""
        draw = torch.rand_like(scene, dtype=torch.float64) * self._number[scene]
        return self._states[self._first[scene] + draw.long()]

    def state_dict(self) -> dict[str, Any]:
        """Seen states, by their scenes."""
        return {"scene_of": self.scene_of}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` gave."""
        self.scene_of = state_dict["scene_of"]
        self._tabulate()
