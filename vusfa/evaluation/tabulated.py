"""The policy of a one-frame agent as a table: the logits of every state of a scene to every goal in it.

Where an agent sees one frame and no more, there are as many different inputs as pairs of states of one scene.
An evaluation of all goals asks for each of them many times; once they are written down a step of an episode
is one look-up.
"""

from __future__ import annotations

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.nn.probabilistic import interaction_type
from torch import Tensor

from vusfa.modules import Agent, StateGoalPairs, frozen
from vusfa.scenes import SceneSet

__all__ = ["TabulatedPolicy"]


class TabulatedPolicy(TensorDictModuleBase):
    """Writes ``action`` as the agent's actor does, from logits that are computed here, once.

    Args:
        agent: as it now is; later updates do not reach the table.
        scenes: its world.
        goals: (G,) global ids of the only goals that will be asked for; None for all states.
        at_once: pairs of state and goal that are computed together.

    Raises:
        ValueError: the agent sees more than one frame, or something else than ids.

    >>> import torch
    >>> from tensordict import TensorDict
    >>> from vusfa.modules import make_agent
    >>> rooms = SceneSet.bundled(["bathroom"])
    >>> policy = TabulatedPolicy(make_agent("gvf", scenes=rooms, history=1, hidden_size=8), rooms)
    >>> rows = TensorDict({"state_id": torch.zeros(3, 1).long(), "goal_id": torch.arange(3)}, [3])
    >>> policy(rows)["action"].shape, policy.logits(torch.tensor([5]), torch.tensor([7])).shape
    (torch.Size([3]), torch.Size([1, 4]))
    """

    def __init__(
        self, agent: Agent, scenes: SceneSet, goals: Tensor | None = None, *, at_once: int = 50_000
    ) -> None:
        super().__init__()
        self.in_keys, self.out_keys = ["state_id", "goal_id"], ["action"]
        was = agent.training
        agent.eval()
        try:
            with frozen(agent):
                self._table = StateGoalPairs(scenes, goals).actions(agent, at_once)
        finally:
            agent.train(was)

    def logits(self, state: Tensor, goal: Tensor) -> Tensor:
        """The agent's logits (\\*B, A) for global ids of states and of goals in the same scene, (\\*B,)."""
        return self._table.logits(state, goal)

    def probabilities(self, state: Tensor, goal: Tensor, scene: Tensor) -> Tensor:
        """The chances of the actions, for :func:`vusfa.evaluation.exact.exact_goals`."""
        return self.logits(state, goal).softmax(-1)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Adds ``action``, (\\*B,) int64."""
        state, goal = tensordict.get("state_id")[..., -1], tensordict.get("goal_id")
        return tensordict.set("action", self._table(state, goal, interaction_type()))
