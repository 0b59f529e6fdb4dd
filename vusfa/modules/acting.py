"""The actor of one that only walks: the same actions as the actor's, for less.

An actor made of tensordict modules writes down everything that a loss may want. Who collects or evaluates
wants actions alone, at every step, of few rows; then moving tensors about costs as much as the products do.
So here one module does it all: rows are brought into the order of scenes once, so that each scene reads one
stretch of them, and nothing but the action is written.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.nn.probabilistic import InteractionType, interaction_type
from torch import Tensor

from vusfa.modules.policy import SuccessorPolicyHead
from vusfa.modules.rows import RowScenes, SceneBlocks, SceneRows
from vusfa.modules.trunk import SiameseTrunk

if TYPE_CHECKING:
    from vusfa.modules.agents import Agent
    from vusfa.modules.pairs import ActionTable, StateGoalPairs

__all__ = ["ActingPolicy", "action_chances", "action_logits", "draw", "draw_actions"]


def action_logits(agent: Agent, state: Tensor, goal: Tensor, scene_id: RowScenes) -> Tensor:
    """An agent's logits, without anything else that its actor writes on the way.

    Args:
        agent: one without a memory.
        state: (R, H) int64 ids, oldest first, or observations (R, H, ...), as the agent reads them.
        goal: (R,) ids, or observations (R, ...).
        scene_id: (R,) int64; or, of rows sorted by scene, with the counts; or blocks that the rows, in any
            order, are to be laid out in.

    Returns:
        (R, A) float32.

    >>> from vusfa.modules import make_agent
    >>> from vusfa.scenes import SceneSet
    >>> agent = make_agent("vusfa", scenes=SceneSet.bundled(["bathroom"]))
    >>> state, goal, scene_id = torch.zeros(3, 4).long(), torch.arange(3), torch.zeros(3).long()
    >>> action_logits(agent, state, goal, scene_id).shape
    torch.Size([3, 4])
    """
    fused = SiameseTrunk(agent.encoder, agent.fusion).fused(state, goal)
    if isinstance(scene_id, SceneBlocks):
        return scene_id.pick_up(_of_fused(agent, scene_id.lay_out(fused), scene_id))
    return _of_fused(agent, fused, scene_id)


def _of_fused(agent: Agent, fused: Tensor, scene_id: RowScenes) -> Tensor:
    hidden = agent.scene_layer(fused, scene_id)
    if isinstance(agent.policy, SuccessorPolicyHead):
        assert agent.successor is not None
        return agent.policy(hidden, agent.successor(hidden, scene_id), scene_id)
    return agent.policy(hidden, scene_id)


def draw_actions(logits: Tensor, interaction: InteractionType | None = None) -> Tensor:
    """Actions (R,) int64 of logits (R, A): the likeliest, or a draw from their softmax.

    Draws are those of ``torch.distributions.Categorical``, number for number, from torch's global generator.

    Args:
        logits: of the actions.
        interaction: what is asked for; None is a draw. MODE and DETERMINISTIC are the likeliest.

    Raises:
        NotImplementedError: a mean or a median, which actions do not have.

    >>> draw_actions(torch.tensor([[0.0, 9.0], [3.0, 1.0]]), InteractionType.DETERMINISTIC)
    tensor([1, 0])
    """
    if interaction in (InteractionType.MODE, InteractionType.DETERMINISTIC):
        return logits.argmax(-1)
    if interaction in (None, InteractionType.RANDOM):
        return draw(action_chances(logits))
    raise NotImplementedError(f"interaction type {interaction}: actions have none; take RANDOM or MODE")


def action_chances(logits: Tensor) -> Tensor:
    """Chances (\\*B, A) of the actions from logits (\\*B, A), rounded as ``torch.distributions.Categorical``
    rounds them.

    >>> action_chances(torch.tensor([0.0, 0.0]))
    tensor([0.5000, 0.5000])
    """
    return (logits - logits.logsumexp(-1, keepdim=True)).softmax(-1)


def draw(chances: Tensor) -> Tensor:
    """An action (\\*B,) int64 of each row of chances (\\*B, A).

    The race that ``torch.multinomial`` runs: exponential clocks, of which the first to ring wins; the same
    numbers from torch's global generator, and the same winner. What it asks of all chances beforehand at each
    call (that they are finite and none is negative) is left out.

    >>> draw(torch.tensor([[0.0, 1.0], [1.0, 0.0]]))
    tensor([1, 0])
    """
    clocks = torch.empty_like(chances, memory_format=torch.contiguous_format).exponential_()
    return (chances / clocks).argmax(-1)


class ActingPolicy(TensorDictModuleBase):
    """Writes ``action``, and nothing else.

    Draws by default; ``torchrl.envs.utils.set_exploration_type`` asks for the likeliest action. Weights are
    the agent's own, so an update reaches it at once.

    Args:
        agent: any without a memory, which would have to be written down, too.

    Raises:
        ValueError: an agent with a memory; its actor is ``agent.get_policy_operator()``.

    >>> from tensordict import TensorDict
    >>> from vusfa.modules import make_agent
    >>> from vusfa.scenes import SceneSet
    >>> policy = ActingPolicy(make_agent("vusfa", scenes=SceneSet.bundled()))
    >>> rows = TensorDict({"state_id": torch.zeros(3, 4).long(), "goal_id": torch.arange(3)}, [3])
    >>> policy(rows.set("scene_id", torch.zeros(3).long()))["action"].shape
    torch.Size([3])
    """

    def __init__(self, agent: Agent) -> None:
        super().__init__()
        if agent.memory is not None:
            raise ValueError("the agent has a memory, which must be kept; take agent.get_policy_operator()")
        self.agent = agent
        by_id = agent.config["observation"] == "index"
        self.in_keys = [
            *(("state_id", "goal_id") if by_id else ("observation", "goal_observation")),
            "scene_id",
        ]
        self.out_keys = ["action"]
        self._num_scenes = agent.scene_layer.linear.num_scenes  # that have weights of their own
        self._table: ActionTable | None = None

    @contextmanager
    def tabulated(self, pairs: StateGoalPairs) -> Iterator[None]:
        """Within it, actions are drawn from chances that are written down on the way in. The weights must not
        change meanwhile, and no goal be asked for that ``pairs`` does not have.

        Args:
            pairs: of the agent's world.

        Raises:
            ValueError: the agent sees more than one frame, or something else than ids.
        """
        self._table = pairs.actions(self.agent)
        try:
            yield
        finally:
            self._table = None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Adds ``action``, (\\*B,) int64."""
        state, goal, scene = (tensordict.get(key) for key in self.in_keys)
        batch = scene.dim()
        rows = (
            state.reshape(-1, *state.shape[batch:]),
            goal.reshape(-1, *goal.shape[batch:]),
            scene.reshape(-1),
        )
        if self._table is not None:
            actions = self._table(rows[0][:, -1], rows[1], interaction_type())
        else:
            actions = draw_actions(self._logits(*rows), interaction_type())
        return tensordict.set("action", actions.view(scene.shape))

    def _logits(self, state: Tensor, goal: Tensor, scene: Tensor) -> Tensor:
        if self._num_scenes == 1 or scene.is_cuda:  # there counting means waiting for the device
            return action_logits(self.agent, state, goal, scene)
        rows, order = SceneRows.sort(scene, self._num_scenes)
        blocks = SceneBlocks.of(rows, order)
        if blocks is not None:
            return action_logits(self.agent, state, goal, blocks)
        logits = action_logits(self.agent, state[order], goal[order], rows)
        return torch.empty_like(logits).index_copy_(0, order, logits)
