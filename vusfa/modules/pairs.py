"""All pairs of a state and a goal in one scene: what a one-frame agent can be asked, and what it answers.

An agent that sees one frame by its id is a function of two small numbers. Where many steps are walked with
the same weights, writing its answers down once, in one large product, and looking them up costs less than
asking it at every step.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from tensordict.nn.probabilistic import InteractionType
from torch import Tensor

from vusfa.modules.acting import action_chances, action_logits, draw, draw_actions
from vusfa.modules.rows import RowScenes, SceneRows
from vusfa.scenes import SceneSet

if TYPE_CHECKING:
    from vusfa.modules.agents import Agent

__all__ = ["ActionTable", "StateGoalPairs", "sees_one_frame"]


def sees_one_frame(agent: Agent) -> bool:
    """Whether an agent's actions depend on the ids of state and goal alone.

    >>> from vusfa.modules import make_agent
    >>> sees_one_frame(make_agent("gvf", scenes=SceneSet.bundled(["bathroom"])))
    False
    """
    config = agent.config
    return config["history"] == 1 and config["observation"] == "index" and config["memory"] is None


class StateGoalPairs:
    """Numbers the pairs of a state and a goal in its scene, scene by scene, goal by goal, state by state.

    Args:
        scenes: the world.
        goals: (G,) global ids of the only goals; None for all states.

    Attributes:
        state, goal, scene: (P,) int64, of each pair: global ids, and the scene's index.

    >>> rooms = SceneSet.bundled(["bathroom", "bedroom"])
    >>> pairs = StateGoalPairs(rooms, torch.tensor([180, 3]))
    >>> len(pairs) == sum(scene.num_states for scene in rooms.scenes)
    True
    >>> row = pairs.rows(torch.tensor([5]), torch.tensor([3]))
    >>> pairs.state[row].item(), pairs.goal[row].item(), pairs.scene[row].item()
    (5, 3, 0)
    """

    def __init__(self, scenes: SceneSet, goals: Tensor | None = None) -> None:
        every = torch.arange(scenes.num_states, device=scenes.device)
        goals = every if goals is None else goals.to(scenes.device).unique()  # sorted, hence scene by scene
        scene = scenes.scene_id[goals]
        size, offset = scenes.offsets.diff()[scene], scenes.offsets[scene]
        first = size.cumsum(0) - size
        # so that base[goal] + state is the pair's number; where a state is no goal, far below every number
        self._base = torch.full_like(every, -(2**40)).index_copy_(0, goals, first - offset)
        which = torch.repeat_interleave(torch.arange(len(goals), device=goals.device), size)
        self.goal, self.scene = goals[which], scene[which]
        self.state = torch.arange(len(which), device=goals.device) - (first - offset)[which]

    def __len__(self) -> int:
        """P."""
        return len(self.state)

    def rows(self, state: Tensor, goal: Tensor) -> Tensor:
        """Numbers (\\*B,) of pairs of global ids (\\*B,); negative where the goal is not among the goals."""
        return self._base[goal] + state

    @torch.no_grad()
    def logits(self, agent: Agent, at_once: int = 50_000) -> Tensor:
        """An agent's answers to all pairs, (P, A) float32, as it is now.

        Args:
            agent: sees one frame, by its id, and has no memory.
            at_once: pairs that are computed together.

        Raises:
            ValueError: the agent sees more, or something else.
        """
        if not sees_one_frame(agent):
            config = agent.config
            raise ValueError(
                "only the policy of an agent that sees one frame, by its id, without a memory, is a table;"
                f" this one has history={config['history']}, observation={config['observation']},"
                f" memory={config['memory']}"
            )
        heads, parts = agent.scene_layer.linear.num_scenes, []
        columns = (part.split(at_once) for part in (self.state, self.goal, self.scene))
        for state, goal, scene in zip(*columns, strict=True):
            rows: RowScenes = scene
            if heads > 1 and not scene.is_cuda:  # there counting means waiting for the device
                rows = SceneRows.of(scene, heads)
            parts.append(action_logits(agent, state.unsqueeze(-1), goal, rows))
        return torch.cat(parts)

    def actions(self, agent: Agent, at_once: int = 50_000) -> ActionTable:
        """What an agent does in each pair, as it is now; arguments and errors as those of :meth:`logits`."""
        return ActionTable(self, self.logits(agent, at_once))


class ActionTable:
    """A policy that is written down: for each pair its logits, and its chances once they are asked for.

    Draws are those of :func:`~vusfa.modules.acting.draw_actions` from the pair's logits.

    Args:
        pairs: of a world.
        logits: (P, A) of them.

    >>> rooms = SceneSet.bundled(["bathroom"])
    >>> pairs = StateGoalPairs(rooms, torch.tensor([3]))
    >>> table = ActionTable(pairs, torch.tensor([0.0, 50.0, 0.0, 0.0]).expand(len(pairs), 4))
    >>> table(torch.tensor([5, 6]), torch.tensor([3, 3]))
    tensor([1, 1])
    """

    def __init__(self, pairs: StateGoalPairs, logits: Tensor) -> None:
        self.pairs = pairs
        self._logits = logits
        self._chances: Tensor | None = None

    def __call__(self, state: Tensor, goal: Tensor, interaction: InteractionType | None = None) -> Tensor:
        """Actions (\\*B,) for global ids of states and of goals in the same scene, (\\*B,)."""
        rows = self.pairs.rows(state, goal)
        if interaction not in (None, InteractionType.RANDOM):
            return draw_actions(self._logits[rows], interaction)
        if self._chances is None:
            self._chances = action_chances(self._logits)
        return draw(self._chances[rows])

    def logits(self, state: Tensor, goal: Tensor) -> Tensor:
        """Logits (\\*B, A) for the same."""
        return self._logits[self.pairs.rows(state, goal)]
