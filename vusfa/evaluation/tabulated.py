"""The policy of a one-frame agent as a table: the logits of every state of a scene to every goal in it.

Where an agent sees one frame and no more, there are as many different inputs as pairs of states of one scene.
An evaluation of all goals asks for each of them many times; once they are written down a step of an episode
is one look-up.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.nn.probabilistic import interaction_type
from torch import Tensor

from vusfa.modules import Agent, action_logits, frozen
from vusfa.modules.acting import draw_actions
from vusfa.scenes import SceneSet

__all__ = ["TabulatedPolicy", "sees_one_frame"]


def sees_one_frame(agent: Agent) -> bool:
    """Whether an agent's actions depend on the ids of state and goal alone.

    >>> from vusfa.modules import make_agent
    >>> sees_one_frame(make_agent("gvf", scenes=SceneSet.bundled(["bathroom"])))
    False
    """
    config = agent.config
    return config["history"] == 1 and config["observation"] == "index" and config["memory"] is None


class TabulatedPolicy(TensorDictModuleBase):
    """Writes ``action`` as the agent's actor does, from logits that are computed here, once.

    Args:
        agent: as it now is; later updates do not reach the table.
        scenes: its world.
        at_once: pairs of state and goal that are computed together.

    Raises:
        ValueError: the agent sees more than one frame, or something else than ids.

    >>> from tensordict import TensorDict
    >>> from vusfa.modules import make_agent
    >>> rooms = SceneSet.bundled(["bathroom"])
    >>> policy = TabulatedPolicy(make_agent("gvf", scenes=rooms, history=1, hidden_size=8), rooms)
    >>> rows = TensorDict({"state_id": torch.zeros(3, 1).long(), "goal_id": torch.arange(3)}, [3])
    >>> policy(rows)["action"].shape, policy.logits(torch.tensor([5]), torch.tensor([7])).shape
    (torch.Size([3]), torch.Size([1, 4]))
    """

    def __init__(self, agent: Agent, scenes: SceneSet, at_once: int = 50_000) -> None:
        super().__init__()
        if not sees_one_frame(agent):
            config = agent.config
            raise ValueError(
                "only the policy of an agent that sees one frame, by its id, without a memory, is a table;"
                f" this one has history={config['history']}, observation={config['observation']},"
                f" memory={config['memory']}"
            )
        self.in_keys, self.out_keys = ["state_id", "goal_id"], ["action"]
        size = scenes.offsets.diff()
        self._size, self._offset, self._scene_id = size, scenes.offsets[:-1], scenes.scene_id
        self._first = torch.cat([size.new_zeros(1), (size**2).cumsum(0)])
        self._table = _all_logits(agent, scenes, at_once)

    def logits(self, state: Tensor, goal: Tensor) -> Tensor:
        """The agent's logits (\\*B, A) for global ids of states and of goals in the same scene, (\\*B,)."""
        scene = self._scene_id[goal]
        first, size = self._offset[scene], self._size[scene]
        return self._table[self._first[scene] + (goal - first) * size + state - first]

    def probabilities(self, state: Tensor, goal: Tensor, scene: Tensor) -> Tensor:
        """The chances of the actions, for :func:`vusfa.evaluation.exact.exact_goals`."""
        return self.logits(state, goal).softmax(-1)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Adds ``action``, (\\*B,) int64."""
        logits = self.logits(tensordict.get("state_id")[..., -1], tensordict.get("goal_id"))
        actions = draw_actions(logits.flatten(0, -2), interaction_type())
        return tensordict.set("action", actions.view(logits.shape[:-1]))


@torch.no_grad()
def _all_logits(agent: Agent, scenes: SceneSet, at_once: int) -> Tensor:
    """(sum of N^2, A): scene by scene, goal by goal, state by state."""
    was, parts = agent.training, []
    agent.eval()
    try:
        with frozen(agent):
            for index, scene in enumerate(scenes.scenes):
                states = torch.arange(scene.num_states, device=scenes.device) + scenes.offsets[index]
                for goals in states.split(max(1, at_once // scene.num_states)):
                    state, goal = states.repeat(len(goals)), goals.repeat_interleave(len(states))
                    parts.append(
                        action_logits(agent, state.unsqueeze(-1), goal, torch.full_like(goal, index))
                    )
    finally:
        agent.train(was)
    return torch.cat(parts)
