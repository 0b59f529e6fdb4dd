"""Inference-only policies: the actor's actions, without the tensors that only a loss reads.

With few rows per step, moving what a loss may read about costs as much as the matrix products do.
:class:`InferencePolicy` runs the actor's layers on plain tensors. While weights are constant, what depends on
single frames is computed once, and an agent that sees one frame by its id becomes a :class:`TabularPolicy`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.nn.probabilistic import InteractionType, interaction_type
from torch import Tensor, nn
from torchrl.modules import LSTMModule

from vusfa.deprecated import moved_names
from vusfa.errors import ConfigError
from vusfa.modules.draws import action_probs, draw, draw_actions
from vusfa.modules.precision import autocast_copy
from vusfa.modules.rows import RowScenes, SceneBlocks, SortedByScene
from vusfa.modules.steps import AtHome
from vusfa.modules.tables import states_around, table_pays
from vusfa.modules.trunk import SiameseTrunk, remember
from vusfa.modules.unique import shapes_may_vary
from vusfa.scenes import SceneSet, check_home

if TYPE_CHECKING:
    from vusfa.modules.agents import Agent

__all__ = ["InferencePolicy", "TabularPolicy"]


class _Layers(NamedTuple):
    """``trunk`` runs on states and goals, ``heads`` on what it returns."""

    trunk: Callable[[Tensor, Tensor], Any]
    heads: list[nn.Module]


class InferencePolicy(AtHome, TensorDictModuleBase):
    """Inference-only policy: the same actions as the actor's, without intermediate tensors.

    It writes ``action``, the next state of an LSTM, and nothing else. Actions are drawn by default;
    ``torchrl.envs.utils.set_exploration_type`` asks for the likeliest. Weights are the agent's own, so an
    update reaches it at once.

    Args:
        agent: any.

    >>> from tensordict import TensorDict
    >>> from vusfa.modules import make_agent
    >>> from vusfa.scenes import SceneSet
    >>> policy = InferencePolicy(make_agent("vusfa", scenes=SceneSet.bundled()))
    >>> rows = TensorDict({"state_id": torch.zeros(3, 4).long(), "goal_id": torch.arange(3)}, [3])
    >>> policy(rows.set("scene_id", torch.zeros(3).long()))["action"].shape
    torch.Size([3])
    >>> with policy.cached(goals=torch.arange(3)):
    ...     policy(rows)["action"].shape
    torch.Size([3])
    """

    def __init__(self, agent: Agent) -> None:
        super().__init__()
        self.agent = agent
        trunk, *heads = agent.actor_steps()
        before = [] if agent.action_input is None else ["previous_action"]
        self._remembering = len(before) + (agent.memory is not None)
        memory = heads[len(before) : self._remembering]
        self._memory_keys = [*before, *(key for step in memory for key in step.in_keys[1:])]
        self._written_keys = [key for step in memory for key in step.out_keys[1:]]
        self.in_keys = [*trunk.in_keys, "scene_id", *self._memory_keys]
        self.out_keys = ["action", *self._written_keys]
        read = {key for step in heads for key in step.in_keys}
        self._whole = not isinstance(trunk.module, SiameseTrunk) or bool(read & set(trunk.out_keys[:-1]))
        self._trunk_keys = trunk.out_keys if self._whole else trunk.out_keys[-1:]
        self._keys = [(step.in_keys, step.out_keys) for step in heads]
        self._layers: _Layers | None = None
        self._table: list[TabularPolicy] = []

    @contextmanager
    def cached(
        self,
        goals: Tensor | None = None,
        scenes: SceneSet | None = None,
        rows: int | None = None,
        states: Tensor | None = None,
    ) -> Iterator[None]:
        """Context in which the weights are constant and what calls share is computed once, without gradients.

        Args:
            goals: (G,) ids of the only goals to come; None for all states.
            scenes: the agent's world. An agent that sees one frame is then tabulated, where the table has at
                most three times as many entries as ``rows``.
            rows: expected number of rows; None for many.
            states: (n,) ids of the only states to come, ascending; found where ``scenes`` are given.
        """
        before = self._layers, self._table
        check_home(self, scenes)
        try:
            if scenes is not None and self.agent.is_tabular and table_pays(scenes, goals, rows):
                self._table = [TabularPolicy(self.agent, scenes, goals)]
            else:
                if scenes is not None and goals is not None:
                    states = states_around(scenes, goals)
                self._layers = self._cached_layers(goals, rows, states)
            yield
        finally:
            self._layers, self._table = before

    def _cached_layers(self, goals: Tensor | None, rows: int | None, states: Tensor | None) -> _Layers:
        trunk, *heads = self._modules_run()
        first, last = heads[: self._remembering], heads[self._remembering :]
        if self._whole or not trunk.encoder.by_id or self._computes_frames(rows):
            trunk, *last = autocast_copy([trunk, *last])
            return _Layers(trunk if self._whole else trunk.fused, [*first, *last])
        return _Layers(trunk.cached(goals, rows, states).fused, [*first, *autocast_copy(last)])

    def _computes_frames(self, rows: int | None) -> bool:
        """Whether frames are learned, and so few are asked for that not all should be computed."""
        frames = self.agent.encoder.frames
        learned = next(frames.parameters(), None) is not None
        return learned and rows is not None and 2 * rows < frames.num_states

    def logits(self, state: Tensor, goal: Tensor, scene_id: RowScenes) -> Tensor:
        """Logits (R, A) of rows, for an agent without a memory.

        Args:
            state: (R, H) int64 ids, oldest first, or observations (R, H, ...), as the agent reads them.
            goal: (R,) ids, or observations (R, ...).
            scene_id: (R,) int64; or, of rows sorted by scene, with the counts; or blocks that the rows, in
                any order, are to be laid out in.
        """
        blocks = scene_id if isinstance(scene_id, SceneBlocks) else None
        logits = self._run(state, goal, {"scene_id": scene_id}, blocks)["logits"]
        return logits if blocks is None else blocks.pick_up(logits)

    def _run(
        self, state: Tensor, goal: Tensor, others: dict[Any, Any], blocks: SceneBlocks | None = None
    ) -> dict[Any, Any]:
        """All that the layers write, of observations of rows and the ``others`` that they read."""
        trunk, heads = self._layers or self._own_layers()
        values: dict[Any, Any] = dict(zip(self._trunk_keys, _tuple(trunk(state, goal)), strict=True))
        if blocks is not None:
            values = {key: blocks.lay_out(value) for key, value in values.items()}
        values |= others
        for head, (in_keys, out_keys) in zip(heads, self._keys, strict=True):
            values.update(zip(out_keys, _tuple(head(*(values[key] for key in in_keys))), strict=True))
        return values

    def _modules_run(self) -> list[Any]:
        memory = partial(remember, self.agent.memory)
        return [memory if isinstance(s, LSTMModule) else s.module for s in self.agent.actor_steps()]

    def _own_layers(self) -> _Layers:
        trunk, *heads = self._modules_run()
        return _Layers(trunk if self._whole else trunk.fused, heads)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Adds ``action``, (\\*B,) int64, and the next state of a memory."""
        if self._table:
            return self._table[0](tensordict)
        state, goal, scene, *memory = (tensordict.get(key, None) for key in self.in_keys)
        if state is None or goal is None or scene is None:
            raise ConfigError(
                f"the policy reads {self.in_keys}, and some of these are missing; TargetNavEnv sends ids, and"
                " the transform vusfa.envs.SceneObservation adds observations"
            )
        batch = scene.dim()
        rows = state.reshape(-1, *state.shape[batch:]), goal.reshape(-1, *goal.shape[batch:])
        if not memory:
            actions = draw_actions(self._by_scene(*rows, scene.reshape(-1)), interaction_type())
            return tensordict.set("action", actions.view(scene.shape))
        others = dict(zip(self._memory_keys, memory, strict=True))
        if key := next((k for k in ("is_init", "previous_action") if others.get(k, scene) is None), None):
            raise ConfigError(f"the policy reads {key!r}; give the environment agent.make_env_transforms()")
        others = {key: None if x is None else x.reshape(-1, *x.shape[batch:]) for key, x in others.items()}
        values = self._run(*rows, {"scene_id": scene.reshape(-1), **others})
        for key in self._written_keys:
            tensordict.set(key, values[key].view(*scene.shape, *values[key].shape[1:]))
        return tensordict.set("action", draw_actions(values["logits"], interaction_type()).view(scene.shape))

    def _by_scene(self, state: Tensor, goal: Tensor, scene: Tensor) -> Tensor:
        """Logits of rows in any order, computed scene by scene."""
        # on an accelerator counting means waiting for it
        if self.agent.num_scenes == 1 or scene.is_cuda or not shapes_may_vary(scene):
            return self.logits(state, goal, scene)
        if self.agent.scene_slots is not None:
            scene = self.agent.scene_slots[scene]
        rows, order = SortedByScene.sort(scene, self.agent.num_scenes)
        blocks = SceneBlocks.of(rows, order)
        if blocks is not None:
            return self.logits(state, goal, blocks)
        logits = self.logits(state[order], goal[order], rows)
        return torch.empty_like(logits).index_copy_(0, order, logits)


class TabularPolicy(AtHome, TensorDictModuleBase):
    """Table of an agent that sees one frame by its id: logits of every state and goal of a scene.

    Where many steps are walked with the same weights, one large product for all pairs and a look-up per step
    cost less than asking the agent. Pairs are numbered scene by scene, goal by goal, state by state.

    Args:
        agent: as it is now; later updates do not reach the table.
        scenes: its world.
        goals: (G,) global ids of the only goals that will be asked for; None for all states.
        at_once: pairs that are computed together.

    Attributes:
        state, goal, scene: (P,) int64, of each pair: global ids, and the scene's index.

    Raises:
        ValueError: an agent of more than one frame, of observations, or of other scenes; no such goal.

    >>> from tensordict import TensorDict
    >>> from vusfa.modules import make_agent
    >>> rooms = SceneSet.bundled(["bathroom"])
    >>> policy = TabularPolicy(make_agent("gvf", scenes=rooms, history=1, hidden_size=8), rooms)
    >>> rows = TensorDict({"state_id": torch.zeros(3, 1).long(), "goal_id": torch.arange(3)}, [3])
    >>> policy(rows)["action"].shape, policy.logits(torch.tensor([5]), torch.tensor([7])).shape
    (torch.Size([3]), torch.Size([1, 4]))
    """

    def __init__(
        self, agent: Agent, scenes: SceneSet, goals: Tensor | None = None, *, at_once: int = 50_000
    ) -> None:
        if not agent.is_tabular:
            config = agent.config
            raise ValueError(
                "only the policy of an agent that sees one frame, by its id, without a memory, is a table;"
                f" this one has history={config['history']}, observation={config['observation']},"
                f" memory={config['memory']}"
            )
        super().__init__()
        check_home(agent, scenes)
        self.home = agent.home
        self.in_keys, self.out_keys = ["state_id", "goal_id"], ["action"]
        every = torch.arange(scenes.num_states, device=scenes.device)
        goals = every if goals is None else scenes.known(goals).unique()  # sorted, hence scene by scene
        scene = scenes.scene_id[goals]
        size, offset = scenes.offsets.diff()[scene], scenes.offsets[scene]
        first = size.cumsum(0) - size
        # so that base[goal] + state is the pair's number; where a state is no goal, far below every number
        self._base = torch.full_like(every, -(2**40)).index_copy_(0, goals, first - offset)
        which = torch.repeat_interleave(torch.arange(len(goals), device=goals.device), size)
        self.goal, self.scene = goals[which], scene[which]
        self.state = torch.arange(len(which), device=goals.device) - (first - offset)[which]
        self._logits = self._ask(agent, goals, states_around(scenes, goals), at_once)
        self._probs: Tensor | None = None

    @torch.no_grad()
    def _ask(self, agent: Agent, goals: Tensor, states: Tensor | None, at_once: int) -> Tensor:
        policy, parts = InferencePolicy(agent), []
        columns = (part.split(at_once) for part in (self.state, self.goal, self.scene))
        with policy.cached(goals, states=states):
            for state, goal, scene in zip(*columns, strict=True):
                rows: RowScenes = scene
                if agent.num_scenes > 1 and not scene.is_cuda:  # there counting means waiting for the device
                    slot = scene if agent.scene_slots is None else agent.scene_slots[scene]
                    rows = SortedByScene.of(slot, agent.num_scenes)
                parts.append(policy.logits(state.unsqueeze(-1), goal, rows))
        return torch.cat(parts)

    def rows(self, state: Tensor, goal: Tensor) -> Tensor:
        """Numbers (\\*B,) of pairs of global ids (\\*B,); negative where the goal is not among the goals."""
        return self._base[goal] + state

    def logits(self, state: Tensor, goal: Tensor) -> Tensor:
        """Logits (\\*B, A) for global ids of states and of goals in the same scene, (\\*B,)."""
        return self._logits[self.rows(state, goal)]

    def probabilities(self, state: Tensor, goal: Tensor, scene: Tensor) -> Tensor:
        """Probabilities (\\*B, A) of the actions, for :func:`vusfa.evaluation.exact.exact_goals`."""
        return self.logits(state, goal).softmax(-1)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Adds ``action``, (\\*B,) int64."""
        rows = self.rows(tensordict.get("state_id")[..., -1], tensordict.get("goal_id"))
        interaction = interaction_type()
        if interaction in (None, InteractionType.RANDOM):
            if self._probs is None:
                self._probs = action_probs(self._logits)
            return tensordict.set("action", draw(self._probs[rows]))
        return tensordict.set("action", draw_actions(self._logits[rows], interaction))


def _tuple(written: Any) -> tuple[Any, ...]:
    return written if isinstance(written, tuple) else (written,)


__getattr__ = moved_names(
    __name__,
    {"ActingPolicy": "vusfa.modules.InferencePolicy", "TabulatedPolicy": "vusfa.modules.TabularPolicy"},
)
