"""The task as a TorchRL environment: many agents, several scenes, one tensor operation each.

The environment keeps no state of its own: where each agent is, where it wants to go and how long it has been
walking stands in the tensordict. So a rollout can be taken up anywhere, and a step is a pure function
(:mod:`vusfa.envs.dynamics`). What travels is integers: 4 of them describe what would be 4 x 2048 features.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from vusfa.envs import dynamics
from vusfa.envs.goals import GoalSpec, resolve_goals
from vusfa.envs.rendering import draw_panels
from vusfa.envs.starts import DRAW_LIMIT, GoalTable, draw_goals, draw_starts, paths_from
from vusfa.envs.world import env_specs, make_world, map_tensors
from vusfa.errors import ConfigError, GoalError
from vusfa.scenes import SceneSet

__all__ = ["TargetNavEnv"]


class TargetNavEnv(EnvBase):
    """Walk to the place where a picture was taken, from pictures alone.

    Args:
        scenes: the world.
        goals: which states are goals, see :mod:`vusfa.envs.goals`. Those of several scenes may be mixed.
        batch_size: any shape; ``[]`` is a single agent.
        history: frames that ``state_id`` reaches back, this one included; at reset the first is repeated.
        max_steps: steps after which an episode is truncated.
        goal_sampling: "fixed" deals the goals out to the rows, row i (in row-major order) gets goal
            ``(first_goal + i) % G`` and keeps it, as the paper's threads do; "episode" draws one for each
            episode, uniformly over the scenes that have goals and then over the scene's goals.
        first_goal: which goal the first row gets, for workers that share one list of fixed goals.
        goal_reward: what reaching the goal earns.
        step_reward: what any other step earns.
        collision_reward: what a blocked step earns; None for the same as any step. The paper's raw values are
            ``goal_reward=10, step_reward=-0.01, collision_reward=-0.1``.
        seed: where the environment's own random generator begins. None begins somewhere else each time,
            whatever ``torch.manual_seed`` says, so that workers never repeat one another.
        device: where the tables and the data are; the CPU by default.

    Keys of the data, at the root and under "next" (reward only there):

    =============  =========  =======  =======================================================================
    key            shape      type     meaning
    =============  =========  =======  =======================================================================
    action         (*B,)      int64    0..A-1, as in ``scenes.actions``
    state_id       (*B, H)    int64    global ids, oldest first; ``[..., -1]`` is where the agent is
    goal_id        (*B,)      int64    global id; reached when ``state_id[..., -1]`` is it, heading included
    scene_id       (*B,)      int64    index into ``scenes.scenes``
    collided       (*B, 1)    bool     the last move was blocked; False after a reset
    shortest_path  (*B, 1)    int64    actions from the episode's start to its goal, constant in the episode
    step_count     (*B, 1)    int64    actions since the episode began
    reward         (*B, 1)    float32
    terminated     (*B, 1)    bool     at the goal
    truncated      (*B, 1)    bool     max_steps have passed (also when the last of them reached the goal)
    done           (*B, 1)    bool     either of the two
    =============  =========  =======  =======================================================================

    Episodes begin uniformly over the states that can reach the goal in more than 0 steps. Every draw comes
    from the environment's own generator, whose state :meth:`state_dict` holds: restore it together with the
    tensordict and the run goes on exactly as it would have.

    Raises:
        GoalError: a goal that does not exist, or that no other state can reach.
        ConfigError: an argument out of range.

    >>> from vusfa.scenes import SceneSet
    >>> env = TargetNavEnv(SceneSet.bundled(["bathroom"]), goals=[73], batch_size=[2], seed=0)
    >>> data = env.set_state(torch.tensor([72, 72]), torch.tensor([73, 73]))
    >>> data["shortest_path"].tolist(), data["state_id"].tolist()
    ([[1], [1]], [[72, 72, 72, 72], [72, 72, 72, 72]])
    >>> after = env.step(data.set("action", torch.tensor([1, 2])))["next"]  # RotateRight, RotateLeft
    >>> after["terminated"].tolist(), after["reward"].tolist()
    ([[True], [False]], [[1.0], [-0.009...]])
    """

    batch_locked: ClassVar[bool] = True
    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 4}
    # reset(tensordict, set_state=True) takes up the episodes that the tensordict describes
    _supports_set_state = True

    def __init__(
        self,
        scenes: SceneSet,
        goals: GoalSpec = "paper",
        batch_size: Sequence[int] = (),
        *,
        history: int = 4,
        max_steps: int = 500,
        goal_sampling: str = "fixed",
        first_goal: int = 0,
        goal_reward: float = 1.0,
        step_reward: float = -0.01,
        collision_reward: float | None = None,
        seed: int | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__(device=torch.device("cpu"), batch_size=torch.Size(batch_size))
        _check_arguments(
            history=history, max_steps=max_steps, goal_sampling=goal_sampling, first_goal=first_goal
        )
        self.scenes = scenes.to("cpu")
        self.history = history
        self.max_steps = max_steps
        self.goal_sampling = goal_sampling
        self.goals = resolve_goals(self.scenes, goals)
        rewards = dynamics.Rewards.of(goal_reward, step_reward, collision_reward)
        rows = None
        if goal_sampling == "fixed":
            rows = (torch.arange(self.numel()) + first_goal).reshape(self.batch_size)
        self._world = make_world(self.scenes, self.goals, rewards, rows)
        self._make_specs()
        self._generator = torch.Generator()
        self._seed: int | None = None
        self._set_seed(seed)
        self._shown: tuple[Tensor, Tensor] | None = None
        if device is not None:
            self.to(device)

    def _make_specs(self) -> None:
        specs = env_specs(self.scenes, self.batch_size, self.history)
        self.state_spec = specs.state
        self.observation_spec = specs.observation
        self.action_spec = specs.action
        self.reward_spec = specs.reward
        self.full_done_spec = specs.done

    # -- the two halves of an episode ------------------------------------------------------------------------

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        world = self._world
        goal_id = tensordict.get("goal_id")
        after = dynamics.step(
            world.successor,
            world.blocked,
            world.rewards,
            self.max_steps,
            tensordict.get("state_id"),
            goal_id,
            tensordict.get("step_count"),
            tensordict.get("action"),
        )
        entries = after._asdict()
        for key in ("goal_id", "scene_id", "shortest_path"):
            entries[key] = tensordict.get(key)
        stepping = tensordict.get("_step", None)
        if stepping is not None:
            entries = _leave_standing(entries, tensordict, stepping.reshape(self.batch_size))
        self._show(after.state_id, goal_id)
        return self._wrap(entries)

    def _reset(
        self, tensordict: TensorDictBase | None = None, set_state: bool = False, **_: Any
    ) -> TensorDictBase:
        if set_state and tensordict is not None and "state_id" in tensordict:
            entries = self._resume(tensordict)
        else:
            start, goals = self._begin()
            entries = {
                "state_id": dynamics.start_history(start, self.history),
                # copies: nobody may write to the tables through the data
                "goal_id": goals.goal.clone(),
                "scene_id": goals.scene.clone(),
                "shortest_path": paths_from(self._world.distance, goals, start).unsqueeze(-1),
                "step_count": self._zeros(torch.int64),
            }
        for key in ("collided", "done", "terminated", "truncated"):
            entries[key] = self._zeros(torch.bool)
        mask = None if tensordict is None else tensordict.get("_reset", None)
        self._show(entries["state_id"], entries["goal_id"], mask)
        return self._wrap(entries)

    def _begin(self) -> tuple[Tensor, GoalTable]:
        """Draw an episode for every row: where it starts, and its goal."""
        world = self._world
        if world.rows is not None:
            return draw_starts(world.starts.members, world.rows, self._draw()), world.rows
        draw, scene_draw, goal_draw = self._draw(3)
        goals = draw_goals(world.starts, scene_draw, goal_draw)
        return draw_starts(world.starts.members, goals, draw), goals

    def _draw(self, *count: int) -> Tensor:
        shape = (*count, *self.batch_size)
        return torch.randint(DRAW_LIMIT, shape, generator=self._generator, device=self.device)

    def _zeros(self, dtype: torch.dtype) -> Tensor:
        return torch.zeros((*self.batch_size, 1), dtype=dtype, device=self.device)

    def _wrap(self, entries: dict[str, Tensor]) -> TensorDict:
        # What TensorDict(entries) would check of each entry at each step holds by construction.
        return TensorDict._new_unsafe(source=entries, batch_size=self.batch_size, device=self.device)

    def _step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """One step, and new episodes where one ended.

        The same as :class:`EnvBase` does, draw for draw, without the detour through :meth:`reset`, which
        checks and merges what is known here; with many rows some episode ends at almost every step. Entries
        that the environment does not know, such as a policy's outputs, stay as they are.
        """
        if tensordict.device != self.device:
            tensordict = tensordict.to(self.device)
        if "next" in tensordict or "_step" in tensordict:
            return super()._step_and_maybe_reset(tensordict)
        following = self._step(tensordict)
        tensordict.set("next", following)
        root = self._step_mdp(tensordict)
        done = following.get("done")
        if done.any():
            start, goals = self._begin()
            path = paths_from(self._world.distance, goals, start)
            mask = done.squeeze(-1)
            state_id = torch.where(done, start.unsqueeze(-1), following.get("state_id"))
            goal_id = torch.where(mask, goals.goal, following.get("goal_id"))
            entries = {
                "state_id": state_id,
                "goal_id": goal_id,
                "scene_id": torch.where(mask, goals.scene, following.get("scene_id")),
                "shortest_path": torch.where(done, path.unsqueeze(-1), following.get("shortest_path")),
                "step_count": following.get("step_count").masked_fill(done, 0),
                "collided": following.get("collided").masked_fill(done, False),
            }
            for key in ("done", "terminated", "truncated"):
                entries[key] = torch.zeros_like(done)
            for key, value in entries.items():
                root._set_str(key, value, validated=True, inplace=False, non_blocking=False)
            self._show(state_id, goal_id)
        return tensordict, root

    # -- putting agents where one wants them -----------------------------------------------------------------

    def set_state(self, state: Tensor | int, goal: Tensor | int) -> TensorDictBase:
        """Begin an episode in every row at a state of one's choice, towards a goal of one's choice.

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
            torch.as_tensor(x, dtype=torch.int64, device=self.device).expand(self.batch_size)
            for x in (state, goal)
        )
        wanted = {"state_id": dynamics.start_history(state, self.history), "goal_id": goal.clone()}
        return self.reset(TensorDict(wanted, batch_size=self.batch_size, device=self.device), set_state=True)

    def _resume(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """Take up the episodes that a tensordict describes; what it leaves out is that of a fresh episode."""
        state_id, goal_id = tensordict.get("state_id"), tensordict.get("goal_id")
        scenes = self.scenes
        for name, ids in (("state", state_id), ("goal", goal_id)):
            wrong = ids[(ids < 0) | (ids >= scenes.num_states)]
            if wrong.numel():
                raise GoalError(
                    f"{name} {int(wrong[0])} is out of range; the ids are 0..{scenes.num_states - 1}"
                )
        state = state_id[..., -1]
        distance = scenes.distance(state.cpu(), goal_id.cpu())
        for fault, what in ((distance < 0, "cannot be reached from"), (distance == 0, "is")):
            if fault.any():
                goal, start = int(goal_id.cpu()[fault][0]), int(state.cpu()[fault][0])
                raise GoalError(f"goal {goal} {what} state {start}; choose another state or goal")
        entries = {
            "state_id": state_id.clone(),
            "goal_id": goal_id.clone(),
            "scene_id": scenes.scene_id.to(self.device)[goal_id],
            "shortest_path": distance.to(self.device).unsqueeze(-1),
            "step_count": self._zeros(torch.int64),
        }
        for key in ("shortest_path", "step_count"):
            if key in tensordict:
                entries[key] = tensordict.get(key).clone()
        return entries

    # -- randomness ------------------------------------------------------------------------------------------

    def _set_seed(self, seed: int | None) -> None:
        """Start the generator anew; None starts it somewhere else each time."""
        self._seed = seed
        if seed is None:
            self._generator.seed()
        else:
            self._generator.manual_seed(seed)

    @property
    def generator(self) -> torch.Generator:
        """What every draw comes from."""
        return self._generator

    def get_rng_state(self) -> Tensor:
        """State of the generator, a byte tensor on the CPU."""
        return self._generator.get_state()

    def set_rng_state(self, state: Tensor) -> None:
        """Go on drawing from where :meth:`get_rng_state` was called, on a device of the same kind."""
        self._generator.set_state(state.cpu())

    def get_extra_state(self) -> Tensor:
        """What :meth:`state_dict` holds: the generator's state."""
        return self.get_rng_state()

    def set_extra_state(self, state: Tensor) -> None:
        """Called by :meth:`load_state_dict`."""
        self.set_rng_state(state)

    def load_state_dict(self, state_dict: Any, strict: bool = True, assign: bool = False) -> Any:
        """Restore what :meth:`state_dict` gave; an empty one, as TorchRL's collectors keep, does nothing."""
        return super().load_state_dict(state_dict, strict=strict and bool(state_dict), assign=assign)

    # -- devices ---------------------------------------------------------------------------------------------

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> TargetNavEnv:
        """What every move of a module comes down to; the tables move along, and the generator begins anew."""
        super()._apply(fn, recurse)
        self._world = map_tensors(fn, self._world)
        device = self._world.successor.device
        if device != self._generator.device:
            # A generator's state means nothing on another kind of device: draws begin again from the seed.
            self._generator = torch.Generator(device)
            self._set_seed(self._seed)
        return self

    # -- pictures --------------------------------------------------------------------------------------------

    def _show(self, state_id: Tensor, goal_id: Tensor, mask: Tensor | None = None) -> None:
        """Remember what :meth:`render` shows without being told."""
        shown = self._shown
        if mask is not None and shown is not None:
            mask = mask.reshape(self.batch_size)
            state_id = torch.where(mask.unsqueeze(-1), state_id, shown[0])
            goal_id = torch.where(mask, goal_id, shown[1])
        self.__dict__["_shown"] = (state_id, goal_id)

    def render(
        self,
        tensordict: TensorDictBase | None = None,
        row: int | tuple[int, ...] = 0,
        panels: Sequence[str] | None = None,
    ) -> np.ndarray:
        """Show one agent, as a picture.

        Args:
            tensordict: where the agents are (``state_id`` and ``goal_id``, of the environment's batch size);
                what the environment produced last when not given.
            row: which agent, its index in the batch (in row-major order when a number).
            panels: what to show from left to right: "view" what the agent sees, "goal" the goal's picture,
                "map" the scene from above. By default the view, or the map where a scene has no pictures.

        Returns:
            (h, w, 3) uint8.

        Raises:
            ConfigError: nothing to show yet, no such row, or no such panel.
            SceneError: the scene has no pictures.

        >>> from vusfa.scenes import SceneSet
        >>> env = TargetNavEnv(SceneSet.bundled(["bathroom"]), batch_size=[3])
        >>> data = env.reset()
        >>> env.render().shape, env.render(data, row=2, panels=("view", "map")).shape
        ((150, 200, 3), (150, 358, 3))
        """
        if tensordict is not None:
            state_id, goal_id = tensordict.get("state_id"), tensordict.get("goal_id")
        elif self._shown is not None:
            state_id, goal_id = self._shown
        else:
            raise ConfigError("there is nothing to render yet; call reset() first, or pass a tensordict")
        try:
            index = (
                row if isinstance(row, tuple) else np.unravel_index(row, self.batch_size or (1,))[: self.ndim]
            )
            trail, goal = state_id[index].tolist(), int(goal_id[index])
        except (IndexError, ValueError) as error:
            raise ConfigError(f"there is no row {row}; the batch is {tuple(self.batch_size)}") from error
        return draw_panels(self.scenes, trail, goal, panels)


def _check_arguments(*, history: int, max_steps: int, goal_sampling: str, first_goal: int) -> None:
    for name, value, least in (
        ("history", history, 1),
        ("max_steps", max_steps, 1),
        ("first_goal", first_goal, 0),
    ):
        if value < least:
            raise ConfigError(f"{name} is {value}; it must be at least {least}")
    if goal_sampling not in ("fixed", "episode"):
        raise ConfigError(f"goal_sampling is {goal_sampling!r}; it is 'fixed' or 'episode'")


def _leave_standing(
    entries: dict[str, Tensor], before: TensorDictBase, stepping: Tensor
) -> dict[str, Tensor]:
    """Undo the step of the rows that are not ``stepping`` (*B,); their reward is 0."""
    result = {}
    for key, value in entries.items():
        old = torch.zeros_like(value) if key == "reward" else before.get(key)
        mask = stepping.unsqueeze(-1) if value.ndim > stepping.ndim else stepping
        result[key] = torch.where(mask, value, old)
    return result
