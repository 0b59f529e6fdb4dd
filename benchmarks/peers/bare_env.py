"""The task in plain PyTorch: tables, indexing, nothing around them.

What someone writes who needs no library: the same next-state table, rewards, arrival, time-out and random
starts as :class:`vusfa.envs.TargetNavEnv`, on four tensors that it owns. It keeps no shortest paths and no
collisions, because training needs neither.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from vusfa.conf.settings import MAX_STEPS
from vusfa.scenes import SceneSet

__all__ = ["After", "BareEnv", "random_frames"]


class After(NamedTuple):
    """What a step led to, before any new episode.

    Attributes:
        state: (B, H) int64, history with the state reached last.
        reward: (B,) float32.
        terminated: (B,) bool, at the goal.
        done: (B,) bool, at the goal or out of time.
    """

    state: Tensor
    reward: Tensor
    terminated: Tensor
    done: Tensor


class BareEnv:
    """Many agents, stepped by indexing; episodes that end begin anew within the step.

    Args:
        scenes: the world.
        goals: (G,) int64 global ids, scene by scene.
        num_envs: B.
        history: H.
        max_steps: steps after which an episode is cut.
        sampling: "episode" draws a scene and then one of its goals for each episode; "fixed" deals the goals
            out to the rows.
        goal_reward, step_reward: what a step earns.

    Attributes:
        state, goal, scene, clock: where the agents are, (B, H), (B,), (B,), (B,) int64.

    >>> env = BareEnv(SceneSet.bundled(["bathroom"]), torch.tensor([3, 40]), num_envs=5)
    >>> env.step(torch.zeros(5, dtype=torch.int64)).reward.shape
    torch.Size([5])
    """

    def __init__(
        self,
        scenes: SceneSet,
        goals: Tensor,
        num_envs: int,
        *,
        history: int = 4,
        max_steps: int = MAX_STEPS,
        sampling: str = "episode",
        goal_reward: float = 1.0,
        step_reward: float = -0.01,
    ) -> None:
        self.successor = scenes.successor.flatten()
        self.num_actions, self.max_steps = scenes.num_actions, max_steps
        self.goal_reward, self.step_reward = torch.tensor(goal_reward), torch.tensor(step_reward)
        self.goals, self.goal_scene = goals, scenes.scene_id[goals]
        self.scenes_of_goals, counts = self.goal_scene.unique(return_counts=True)
        self.goal_count, self.goal_first = counts, counts.cumsum(0) - counts
        self.starts, self.start_count = _starts(scenes, goals)
        self.row_goal = torch.arange(num_envs) % len(goals) if sampling == "fixed" else None
        self.rows, self.history = num_envs, history
        self.state, self.goal, self.scene = self._begin()
        self.clock = torch.zeros(num_envs, dtype=torch.int64)

    def _begin(self) -> tuple[Tensor, Tensor, Tensor]:
        if self.row_goal is None:
            scene = torch.randint(len(self.scenes_of_goals), (self.rows,))
            slot = self.goal_first[scene] + torch.randint(2**31, (self.rows,)) % self.goal_count[scene]
        else:
            slot = self.row_goal
        start = self.starts[slot, torch.randint(2**31, (self.rows,)) % self.start_count[slot]]
        return start.unsqueeze(-1).repeat(1, self.history), self.goals[slot], self.goal_scene[slot]

    def step(self, action: Tensor) -> After:
        """Move every agent by its action (B,); who is done begins a new episode in :attr:`state` and the
        rest."""
        reached = self.successor[self.state[:, -1] * self.num_actions + action]
        terminated = reached == self.goal
        clock = self.clock + 1
        done = terminated | (clock >= self.max_steps)
        state = torch.cat([self.state[:, 1:], reached.unsqueeze(-1)], -1)
        reward = torch.where(terminated, self.goal_reward, self.step_reward)
        if done.any():
            start, goal, scene = self._begin()
            self.state = torch.where(done.unsqueeze(-1), start, state)
            self.goal, self.scene = torch.where(done, goal, self.goal), torch.where(done, scene, self.scene)
            self.clock = clock.masked_fill(done, 0)
        else:
            self.state, self.clock = state, clock
        return After(state, reward, terminated, done)


def random_frames(env: BareEnv, steps: int) -> Callable[[], int]:
    """A random walk of ``steps`` steps, kept as one batch as a collector would; returns the frames walked.

    >>> random_frames(BareEnv(SceneSet.bundled(["bathroom"]), torch.tensor([3]), num_envs=2), steps=3)()
    6
    """

    def walk() -> int:
        state = torch.empty(steps, env.rows, env.history, dtype=torch.int64)
        following = torch.empty_like(state)
        goal = torch.empty(steps, env.rows, dtype=torch.int64)
        action, reward = torch.empty_like(goal), torch.empty(steps, env.rows)
        flags = torch.empty(2, steps, env.rows, dtype=torch.bool)
        for t in range(steps):
            state[t], goal[t] = env.state, env.goal
            action[t] = torch.randint(env.num_actions, (env.rows,))
            following[t], reward[t], flags[0, t], flags[1, t] = env.step(action[t])
        return steps * env.rows

    return walk


def _starts(scenes: SceneSet, goals: Tensor) -> tuple[Tensor, Tensor]:
    """For each goal the states that can reach it in more than 0 steps: (G, most) and how many, (G,)."""
    lists = []
    for goal in goals.tolist():
        first, last = scenes.offsets[scenes.scene_id[goal]], scenes.offsets[scenes.scene_id[goal] + 1]
        states = torch.arange(int(first), int(last))
        lists.append(states[scenes.distance(states, goal) > 0])
    count = torch.tensor([len(states) for states in lists])
    return torch.nn.utils.rnn.pad_sequence(lists, batch_first=True), count
