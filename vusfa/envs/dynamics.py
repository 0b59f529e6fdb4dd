"""The task as pure functions of tensors: one step of many agents at once.

A scene is a finite graph of photographed poses. An action moves the agent along an edge; where there is none,
the agent stays and collides, which is a step like any other. An episode ends at the goal, which is one pose,
heading included, or when the time is up. (Zhu et al. 2017, https://arxiv.org/abs/1609.05143, section 4; the
released code of VUSFA.)
"""

from __future__ import annotations

import math
from numbers import Real
from typing import Any, NamedTuple

import torch
from torch import Tensor

from vusfa.conf.settings import MAX_STEPS
from vusfa.errors import ActionError, ConfigError
from vusfa.limits import brief

__all__ = [
    "GOAL_REWARD",
    "HISTORY",
    "MAX_STEPS",
    "STEP_REWARD",
    "Rewards",
    "Transition",
    "check_actions",
    "push_frame",
    "rows_where",
    "stand_still",
    "start_history",
    "step",
]

# The task's defaults.
#: frames that an agent sees, the present one included
HISTORY = 4
#: reward of reaching the goal, and of any other step
GOAL_REWARD, STEP_REWARD = 1.0, -0.01


class Rewards(NamedTuple):
    """Rewards of a step, 0-dimensional float32 tensors.

    >>> Rewards.of(goal=10.0, step=-0.01, collision=-0.1).collision
    tensor(-0.1000)
    """

    goal: Tensor
    step: Tensor
    collision: Tensor | None

    @classmethod
    def of(
        cls, goal: float = GOAL_REWARD, step: float = STEP_REWARD, collision: float | None = None
    ) -> Rewards:
        """From numbers; ``collision=None``: a collision earns what any step earns."""
        given = {"goal": goal, "step": step} | ({} if collision is None else {"collision": collision})
        for name, value in given.items():
            if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value):
                raise ConfigError(f"{name}_reward is {brief(value)}; give a finite number")
        tensors = {name: torch.tensor(float(value), dtype=torch.float32) for name, value in given.items()}
        return cls(tensors["goal"], tensors["step"], tensors.get("collision"))


class Transition(NamedTuple):
    """Result of one step; shapes for a batch ``(*B,)`` of agents and a history of ``H`` frames.

    Attributes:
        state_id: (*B, H) int64, oldest first; ``[..., -1]`` is where the agent now is.
        reward: (*B, 1) float32.
        collided: (*B, 1) bool, the move was blocked and the agent stayed.
        elapsed_steps: (*B, 1) int64, steps since the episode began, this one included.
        terminated: (*B, 1) bool, the agent is at its goal.
        truncated: (*B, 1) bool, the time is up, also when the last step reached the goal.
        done: (*B, 1) bool, either of the two.
    """

    state_id: Tensor
    reward: Tensor
    collided: Tensor
    elapsed_steps: Tensor
    terminated: Tensor
    truncated: Tensor
    done: Tensor


def start_history(state: Tensor, history: int) -> Tensor:
    """History (*B, H) of an episode that begins: its first frame (*B,), repeated.

    >>> start_history(torch.tensor([7, 3]), 2)
    tensor([[7, 7],
            [3, 3]])
    """
    return state.unsqueeze(-1).repeat(*(1,) * state.ndim, history)


def push_frame(state_id: Tensor, state: Tensor) -> Tensor:
    """Forget the oldest frame of (*B, H) and append ``state`` (*B,).

    >>> push_frame(torch.tensor([5, 6, 7]), torch.tensor(9))
    tensor([6, 7, 9])
    """
    return torch.cat([state_id[..., 1:], state.unsqueeze(-1)], -1)


def check_actions(action: Tensor, num_actions: int) -> Tensor:
    """Actions of any integer type and shape as int64.

    Raises:
        ActionError: another type, or an action outside 0..A-1; indexing would take -1 for the last.

    >>> check_actions(torch.tensor([0, -1]), 4)
    Traceback (most recent call last):
    ...
    vusfa.errors.ActionError: action -1 does not exist; give whole numbers 0..3
    """
    if action.dtype != torch.int64:
        if action.dtype == torch.bool or action.is_floating_point() or action.is_complex():
            raise ActionError(
                f"actions are {action.dtype}; give whole numbers 0..{num_actions - 1}, as int64"
            )
        action = action.to(torch.int64)
    if torch.compiler.is_compiling() or not action.numel():
        return action
    low, high = (int(value) for value in action.aminmax())
    if low < 0 or high >= num_actions:
        wrong = low if low < 0 else high
        raise ActionError(f"action {wrong} does not exist; give whole numbers 0..{num_actions - 1}")
    return action


def step(
    successor: Tensor,
    blocked: Tensor,
    rewards: Rewards,
    max_steps: int,
    state_id: Tensor,
    goal_id: Tensor,
    elapsed_steps: Tensor,
    action: Tensor,
) -> Transition:
    """Move every agent by one action. Nothing is written in place or drawn at random.

    Args:
        successor: (S, A) int64, the state each action leads to; a blocked one leads back to the same state.
        blocked: (S, A) bool.
        rewards: what a step earns. The goal's reward comes before the collision's.
        max_steps: steps after which an episode is truncated.
        state_id: (*B, H) int64, oldest first.
        goal_id: (*B,) int64.
        elapsed_steps: (*B, 1) int64, steps since the episode began.
        action: (*B,) int64 in 0..A-1.

    Raises:
        ActionError: another action (an IndexError; not checked while compiling).

    >>> line = torch.tensor([[1, 0], [2, 0], [2, 1]])  # right, left
    >>> walls = torch.tensor([[False, True], [False, False], [True, False]])
    >>> at, goal, clock = torch.tensor([[0, 1]]), torch.tensor([2]), torch.tensor([[4]])
    >>> end = step(line, walls, Rewards.of(), 5, at, goal, clock, action=torch.tensor([0]))
    >>> end.state_id.tolist(), end.reward.item(), end.terminated.item(), end.truncated.item()
    ([[1, 2]], 1.0, True, True)
    """
    action = check_actions(action, successor.shape[-1])
    if action.ndim and action.shape != state_id.shape[:-1]:
        raise ActionError(f"actions are of shape {[*action.shape]}; give {[*state_id.shape[:-1]]}")
    current = state_id[..., -1]
    state = successor[current, action]
    collided = blocked[current, action].unsqueeze(-1)
    terminated = (state == goal_id).unsqueeze(-1)
    elapsed_steps = elapsed_steps + 1
    truncated = elapsed_steps >= max_steps
    otherwise = (
        rewards.step if rewards.collision is None else torch.where(collided, rewards.collision, rewards.step)
    )
    return Transition(
        state_id=push_frame(state_id, state),
        reward=torch.where(terminated, rewards.goal, otherwise),
        collided=collided,
        elapsed_steps=elapsed_steps,
        terminated=terminated,
        truncated=truncated,
        done=terminated | truncated,
    )


def rows_where(rows: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """The entry ``new`` in some rows (*B,) bool, ``old`` in the others."""
    return torch.where(rows.unsqueeze(-1) if new.ndim > rows.ndim else rows, new, old)


def stand_still(after: dict[str, Tensor], before: Any, stepping: Tensor) -> dict[str, Tensor]:
    """Undo the step of the rows that are not ``stepping`` (*B,) bool; what was not there before is 0."""
    result = {}
    for key, value in after.items():
        old = None if key == "reward" else before.get(key, None)
        result[key] = rows_where(stepping, value, torch.zeros_like(value) if old is None else old)
    return result
