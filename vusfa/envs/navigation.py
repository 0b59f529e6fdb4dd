"""The task as a TorchRL environment: many agents, several scenes, one tensor operation each.

The environment keeps no state of its own: each agent's place, goal and number of steps are in the tensordict.
So a rollout can be resumed anywhere, and a step is a pure function (:mod:`vusfa.envs.dynamics`). Data are
integers: 4 of them stand for 4 x 2048 features.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from vusfa.envs import dynamics
from vusfa.envs.goals import GoalSpec, as_ids, check_ids, resolve_goals
from vusfa.envs.rotation import Rotation, SceneRotation
from vusfa.envs.scene_env import SceneEnv, check_counts, usable_device
from vusfa.envs.starts import DRAW_LIMIT, GoalTable, draw_goals, draw_starts, paths_from
from vusfa.envs.world import RotatingWorld, make_world
from vusfa.errors import ConfigError, GoalError
from vusfa.scenes import SceneSet
from vusfa.torchrl_private import unchecked_tensordict

__all__ = ["TargetNavEnv"]


class TargetNavEnv(SceneEnv):
    """Target-driven visual navigation: walk to the pose from which a picture was taken.

    Args:
        scenes: the world.
        goals: which states are goals, see :mod:`vusfa.envs.goals`.
        batch_size: any shape; ``[]`` is a single agent.
        history: frames that ``state_id`` reaches back, this one included; at reset the first is repeated.
        max_steps: steps after which an episode is truncated.
        goal_sampling: "fixed" deals the goals out to the rows, row i (in row-major order) gets goal
            ``(first_goal + i) % G`` and keeps it, as the paper's threads do; "episode" draws one for each
            episode, uniformly over the scenes that have goals and then over the scene's goals.
        first_goal: which goal the first row gets, for workers that share one list of fixed goals.
        goal_reward, step_reward: reward of reaching the goal, and of any other step.
        collision_reward: reward of a blocked step; None for that of any step. The paper's raw values are
            ``goal_reward=10, step_reward=-0.01, collision_reward=-0.1``.
        seed: of the environment's own random generator. None takes another one each time, whatever
            ``torch.manual_seed`` says, so that workers never repeat one another.
        device: where the tables and the data are; the CPU by default.
        shortest_path: also write the key of that name. It is privileged (no agent could know it), so no
            policy is given it by default; the trainer's metrics ask for it.
        rotation: episodes begin in a few active scenes, which change; None for all scenes all the time. With
            fixed goals, a row keeps its goal for as long as the goal's scene is active.
        first_frame, frames_per_step: where the rotation stands before the first step, and by how many frames
            a step takes it on, for environments that share the work with others; their own rows by default.

    Keys of the data, at the root and under "next" (reward only there):

    =============  =========  =======  =======================================================================
    key            shape      type     meaning
    =============  =========  =======  =======================================================================
    action         (*B,)      int64    0..A-1, as in ``scenes.actions``
    state_id       (*B, H)    int64    global ids, oldest first; ``[..., -1]`` is where the agent is
    goal_id        (*B,)      int64    global id; reached when ``state_id[..., -1]`` is it, heading included
    scene_id       (*B,)      int64    index into ``scenes.scenes``
    elapsed_steps  (*B, 1)    int64    actions since the episode began
    shortest_path  (*B, 1)    int64    actions from the episode's start to its goal, constant in the episode
    collided       (*B, 1)    bool     the last move was blocked; False after a reset
    reward         (*B, 1)    float32
    terminated     (*B, 1)    bool     at the goal
    truncated      (*B, 1)    bool     max_steps have passed (also when the last of them reached the goal)
    done           (*B, 1)    bool     either of the two
    =============  =========  =======  =======================================================================

    The environment reads back the action and its state: the keys from state_id to shortest_path. Where a
    transform drops them (``ExcludeTransform``), the next step is an error; ``SelectTransform`` keeps them.

    Episodes begin uniformly over the states that can reach the goal in more than 0 steps. Every draw comes
    from the environment's own generator, whose state :meth:`state_dict` holds: restore it together with the
    tensordict and the run goes on exactly as it would have.

    ``reset`` with a ``_reset`` mask begins new episodes in the rows of the mask, whatever state the
    tensordict holds. Without one, ``reset(tensordict, set_state=True)`` resumes the episodes that the
    tensordict describes; rows whose episode is over begin a new one.

    Raises:
        GoalError: a goal that does not exist, or that no other state can reach.
        ConfigError: an argument out of range; a step without state or action.
        ActionError: an action that does not exist.

    >>> from vusfa.scenes import SceneSet
    >>> env = TargetNavEnv(SceneSet.bundled(["bathroom"]), goals=[73], batch_size=[2], seed=0)
    >>> data = env.set_state(torch.tensor([72, 72]), torch.tensor([73, 73]))
    >>> data["state_id"].tolist()
    [[72, 72, 72, 72], [72, 72, 72, 72]]
    >>> after = env.step(data.set("action", torch.tensor([1, 2])))["next"]  # RotateRight, RotateLeft
    >>> after["terminated"].tolist(), after["reward"].tolist()
    ([[True], [False]], [[1.0], [-0.009...]])
    """

    def __init__(
        self,
        scenes: SceneSet,
        goals: GoalSpec = "paper",
        batch_size: Sequence[int] = (),
        *,
        history: int = dynamics.HISTORY,
        max_steps: int = dynamics.MAX_STEPS,
        goal_sampling: str = "fixed",
        first_goal: int = 0,
        goal_reward: float = dynamics.GOAL_REWARD,
        step_reward: float = dynamics.STEP_REWARD,
        collision_reward: float | None = None,
        seed: int | None = None,
        device: torch.device | str | None = None,
        shortest_path: bool = False,
        rotation: SceneRotation | None = None,
        first_frame: int = 0,
        frames_per_step: int | None = None,
    ) -> None:
        check_counts(history=(history, 1), max_steps=(max_steps, 1), first_goal=(first_goal, 0))
        if goal_sampling not in ("fixed", "episode"):
            raise ConfigError(f"goal_sampling is {goal_sampling!r}; it is 'fixed' or 'episode'")
        super().__init__(scenes, batch_size, history, seed)
        self.max_steps = max_steps
        self.goal_sampling = goal_sampling
        self.goals = resolve_goals(self.scenes, goals)
        rewards = dynamics.Rewards.of(goal_reward, step_reward, collision_reward)
        numbers = (torch.arange(self.numel()) + first_goal).reshape(self.batch_size)
        rows = numbers if goal_sampling == "fixed" else None
        if rotation is not None:
            turns, step = Rotation(rotation, self.scenes, self.goals), frames_per_step or self.numel()
            if turns.rotates:
                self._rotating = RotatingWorld(self.scenes, turns, rewards, rows, first_frame, step)
        self._world = self._turned() or make_world(self.scenes, self.goals, rewards, rows)
        self._make_specs(shortest_path)
        if device is not None:
            self.to(usable_device(device))

    def __repr__(self) -> str:
        options = ("history", "max_steps", "goal_sampling")
        values = ", ".join(f"{name}={getattr(self, name)!r}" for name in options)
        return (
            f"{type(self).__name__}({self.scenes!r}, {len(self.goals)} goals,"
            f" batch_size={list(self.batch_size)}, {values}, device={str(self.device)!r})"
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._rotate()
        world = self._world
        state, action = (
            {key: tensordict.get(key, None) for key in keys} for keys in (self._keys, ["action"])
        )
        for key, value in {**state, **action}.items():
            if value is None:
                raise ConfigError(
                    f"step() was given no {key!r}; give it the tensordict that reset() or the last step"
                    f" returned, with all of {', '.join(self._keys)}, and an action in it"
                )
        after = dynamics.step(
            world.successor,
            world.blocked,
            world.rewards,
            self.max_steps,
            state["state_id"],
            state["goal_id"],
            state["elapsed_steps"],
            action["action"],
        )
        entries = {**state, **after._asdict()}
        stepping = tensordict.get("_step", None)
        if stepping is not None:
            entries = dynamics.stand_still(entries, tensordict, stepping.reshape(self.batch_size))
        self._show(after.state_id, state["goal_id"])
        return self._wrap(entries)

    def _reset(self, tensordict: TensorDictBase | None = None, set_state: bool = False) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if tensordict is not None and set_state and mask is None and "state_id" in tensordict:
            entries = self._resume(tensordict)
        else:
            entries = self._fresh()
        for key in ("collided", "done", "terminated", "truncated"):
            entries[key] = self._zeros(torch.bool)
        self._show(entries["state_id"], entries["goal_id"], mask)
        return self._wrap(entries)

    def _fresh(self) -> dict[str, Tensor]:
        """State of an episode that begins, for every row."""
        start, goals = self._begin()
        entries = {
            "state_id": dynamics.start_history(start, self.history),
            # copies, so that writing to the data leaves the tables alone
            "goal_id": goals.goal.clone(),
            "scene_id": goals.scene.clone(),
            "elapsed_steps": self._zeros(torch.int64),
        }
        if "shortest_path" in self._keys:
            entries["shortest_path"] = self._path(start, goals)
        return entries

    def _begin(self) -> tuple[Tensor, GoalTable]:
        """Draw an episode for every row: where it starts, and its goal."""
        world = self._world
        if world.rows is not None:
            return draw_starts(world.starts.members, world.rows, self._draw()), world.rows
        draw, scene_draw, goal_draw = self._draw(3)
        goals = draw_goals(world.starts, scene_draw, goal_draw)
        return draw_starts(world.starts.members, goals, draw), goals

    def _path(self, start: Tensor, goals: GoalTable) -> Tensor:
        if self._world.paths is not None:
            return paths_from(self._world.paths, goals, start).unsqueeze(-1)
        return self.scenes.distance(start.cpu(), goals.goal.cpu()).to(start.device).unsqueeze(-1)

    def _draw(self, *count: int) -> Tensor:
        shape = (*count, *self.batch_size)
        return torch.randint(DRAW_LIMIT, shape, generator=self._generator, device=self.device)

    def _zeros(self, dtype: torch.dtype) -> Tensor:
        return torch.zeros((*self.batch_size, 1), dtype=dtype, device=self.device)

    def _wrap(self, entries: dict[str, Tensor]) -> TensorDict:
        return unchecked_tensordict(entries, self.batch_size, self.device)

    def _renew(self, following: TensorDictBase, done: Tensor) -> dict[str, Tensor]:
        start, goals = self._begin()
        mask = done.squeeze(-1)
        entries = {
            "state_id": torch.where(done, start.unsqueeze(-1), following.get("state_id")),
            "goal_id": torch.where(mask, goals.goal, following.get("goal_id")),
            "scene_id": torch.where(mask, goals.scene, following.get("scene_id")),
            "elapsed_steps": following.get("elapsed_steps").masked_fill(done, 0),
            "collided": following.get("collided").masked_fill(done, False),
        }
        if "shortest_path" in self._keys:
            before = following.get("shortest_path")
            entries["shortest_path"] = torch.where(done, self._path(start, goals), before)
        for key in ("done", "terminated", "truncated"):
            entries[key] = torch.zeros_like(done)
        self._show(entries["state_id"], entries["goal_id"])
        return entries

    def set_state(self, state: Tensor | int, goal: Tensor | int) -> TensorDictBase:
        """Begin an episode in every row at a given state, towards a given goal.

        Any goal will do, whether or not it is among :attr:`goals`; rows that are later reset draw theirs as
        always.

        Args:
            state: global ids, of a shape that broadcasts to (*B,).
            goal: the same.

        Returns:
            the tensordict that :meth:`reset` would return.

        Raises:
            GoalError: a state or goal out of range, a goal that cannot be reached from its state, or that is
                its state.
        """
        state, goal = (
            as_ids(n, x, self.batch_size, self.device) for n, x in (("state", state), ("goal", goal))
        )
        entries = {"state_id": dynamics.start_history(state, self.history), "goal_id": goal.clone()}
        return self.reset(TensorDict(entries, batch_size=self.batch_size, device=self.device), set_state=True)

    def _resume(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """Resume the episodes that a tensordict describes. Missing entries are those of a new episode, and
        rows whose episode is over begin one."""
        state_id, goal_id = tensordict.get("state_id"), tensordict.get("goal_id", None)
        if goal_id is None:
            raise ConfigError("reset() was given a 'state_id' to resume at and no 'goal_id'; give both")
        scenes = self.scenes
        for name, ids, shape in (("state", state_id, (self.history,)), ("goal", goal_id, ())):
            check_ids(name, ids, (*self.batch_size, *shape), scenes.num_states)
        state = state_id[..., -1]
        elapsed = tensordict.get("elapsed_steps", self._zeros(torch.int64)).squeeze(-1)
        over = (elapsed > 0) & ((state == goal_id) | (elapsed >= self.max_steps))
        distance = scenes.distance(state.cpu(), goal_id.cpu())
        for wrong, what in ((distance < 0, "cannot be reached from"), (distance == 0, "is")):
            fault = wrong & ~over.cpu()
            if fault.any():
                goal, start = int(goal_id.cpu()[fault][0]), int(state.cpu()[fault][0])
                raise GoalError(f"goal {goal} {what} state {start}; choose another state or goal")
        entries = {
            "state_id": state_id.clone(),
            "goal_id": goal_id.clone(),
            "scene_id": scenes.scene_id.to(self.device)[goal_id],
            "elapsed_steps": elapsed.unsqueeze(-1).clone(),
        }
        if "shortest_path" in self._keys:
            path = distance.to(self.device).unsqueeze(-1)
            entries["shortest_path"] = tensordict.get("shortest_path", path).clone()
        if over.any():
            fresh = self._fresh()
            entries = {key: dynamics.rows_where(over, fresh[key], value) for key, value in entries.items()}
        return entries
