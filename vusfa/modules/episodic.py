"""Memory of one episode: which actions were taken in which picture.

It counts and does not learn: compare results with those of the same memory around a random policy.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.nn.probabilistic import interaction_type
from torch import Tensor

from vusfa.modules.agents import Agent
from vusfa.modules.draws import draw_actions
from vusfa.modules.inference import InferencePolicy

__all__ = ["TriedActions"]


class TriedActions(TensorDictModuleBase):
    r"""A policy that prefers what it has not tried in this episode.

    .. math::
        \pi(a | s) \propto \exp(l(s, g)_a / T - \beta \, n(s, a))

    with n(s, a) how often it took a in state s in this episode. It reads ``tried`` (\*B, N, A), ``is_init``
    and what the agent reads, and writes ``action`` and ``("next", "tried")``, which
    :func:`vusfa.evaluation.evaluate` carries from step to step.

    Args:
        agent: one without a memory that reads ids; None for a random policy.
        num_states: N, of the world.
        num_actions: A.
        weight: beta.
        temperature: T.

    >>> from tensordict import TensorDict
    >>> policy = TriedActions(None, num_states=3, num_actions=4, weight=1e9)
    >>> rows = TensorDict({"state_id": torch.ones(1, 1).long(), "is_init": torch.ones(1, 1).bool()}, [1])
    >>> taken = []
    >>> for _ in range(4):
    ...     rows = policy(rows)
    ...     taken.append(int(rows["action"]))
    ...     rows["tried"], rows["is_init"] = rows["next", "tried"], torch.zeros(1, 1).bool()
    >>> sorted(taken)
    [0, 1, 2, 3]
    """

    def __init__(
        self,
        agent: Agent | None,
        num_states: int,
        num_actions: int,
        *,
        weight: float = 3.0,
        temperature: float = 1.0,
    ) -> None:
        super().__init__()
        if agent is not None and (agent.memory is not None or agent.config["observation"] != "index"):
            raise ValueError("the agent must read ids and have no memory of its own")
        self.policy = None if agent is None else InferencePolicy(agent)
        self.num_states, self.num_actions = num_states, num_actions
        self.weight, self.temperature = weight, temperature
        self.in_keys = ["state_id", "goal_id", "scene_id", "tried", "is_init"]
        self.out_keys = ["action", ("next", "tried")]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Adds ``action`` (n,) and the counts after it, (n, N, A) uint8."""
        state = tensordict.get("state_id")
        row, here = torch.arange(len(state), device=state.device), state[:, -1]
        tried = tensordict.get("tried", None)
        if tried is None:
            shape = len(state), self.num_states, self.num_actions
            tried = torch.zeros(shape, dtype=torch.uint8, device=state.device)
        tried = tried * (~tensordict.get("is_init")).to(tried.dtype).view(-1, 1, 1)
        action = draw_actions(self._logits(tensordict) - self.weight * tried[row, here], interaction_type())
        tried[row, here, action] += (tried[row, here, action] < 255).to(tried.dtype)
        return tensordict.set("action", action).set(("next", "tried"), tried)

    def _logits(self, tensordict: TensorDictBase) -> Tensor:
        state = tensordict.get("state_id")
        if self.policy is None:
            return torch.zeros(len(state), self.num_actions, device=state.device)
        goal, scene = tensordict.get("goal_id"), tensordict.get("scene_id")
        return self.policy.logits(state, goal, scene) / self.temperature
