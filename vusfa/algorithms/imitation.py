"""Shortest paths of the training scenes, learned on the agent's own walks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.modules import set_recurrent_mode

from vusfa.algorithms.base import AlgorithmSettings
from vusfa.algorithms.experience import ExperienceGraph, merge_graphs
from vusfa.algorithms.registry import register_algorithm
from vusfa.algorithms.replay_search import make_search_loss
from vusfa.algorithms.usf import USF
from vusfa.errors import CheckpointError, ConfigError, near
from vusfa.modules import Agent
from vusfa.scenes import SceneSet

__all__ = ["EXPERTS", "Imitation", "ImitationSettings"]

#: Whose shortest paths are learned.
EXPERTS = ("scenes", "experience")


@dataclass
class ImitationSettings(AlgorithmSettings):
    """Numbers of ``algorithm=imitation``.

    Attributes:
        expert: whose shortest paths are learned: ``"scenes"``, those of the scenes' graphs; ``"experience"``,
            those in the graph of the agent's own transitions so far, for which no graph is read.
        minibatches: parts of a batch, each with an optimizer step; sequences of the collector stay whole.
        critic_coeff, objective_coeff: of :class:`~vusfa.objectives.SearchLoss`.
    """

    expert: str = "scenes"
    minibatches: int = 8
    critic_coeff: float = 1.0
    objective_coeff: float = 1.0


@register_algorithm("imitation")
class Imitation(USF):
    """DAgger (Ross et al. 2011, https://arxiv.org/abs/1011.0686): the agent walks by its own policy, and in
    every state that it comes to it learns what an expert would do there.

    The expert knows the graphs of the scenes that are trained in, or an
    :class:`~vusfa.algorithms.ExperienceGraph` of the agent's own transitions. Of its shortest paths
    :class:`~vusfa.objectives.SearchLoss` learns all first steps, and the length. No reward is needed; what a
    model learns besides, by ``objective.successor_coeff`` and ``objective.bottleneck_coeff``, is that of
    :class:`~vusfa.algorithms.USF`. Any agent can be trained, one with a memory, too.
    """

    Settings = ImitationSettings

    def __init__(self, agent: Agent, scenes: SceneSet, settings: Mapping[str, Any]) -> None:
        super().__init__(agent, scenes, settings)
        numbers = settings["algorithm"]
        for name in ("objective_coeff", "critic_coeff"):
            if settings["objective"][name]:
                raise ConfigError(
                    f"objective.{name} is {settings['objective'][name]}: algorithm=imitation learns policy"
                    f" and value from the expert; give objective.{name}=0, and algorithm.{name} its weight"
                )
        if self.threads is not None:
            raise ConfigError(
                "algorithm=imitation knows no threads, for which optim=a3c stands; give optim=adam"
            )
        self._parts, rows = numbers["minibatches"], settings["collector"]["num_envs"]
        if self._parts < 1 or rows % self._parts:
            raise ConfigError(
                f"algorithm.minibatches is {self._parts}, which does not divide collector.num_envs={rows}"
            )
        if numbers["expert"] not in EXPERTS:
            raise ConfigError(
                f"algorithm.expert is {numbers['expert']!r}; {near(numbers['expert'], EXPERTS)}"
            )
        self._learns_graph = numbers["expert"] == "experience"
        self.expert = ExperienceGraph(scenes.num_states, scenes.num_actions)
        if not self._learns_graph:
            self.expert.extend(all_transitions(scenes))
        self.search_loss = make_search_loss("algorithm=imitation", agent, settings)
        #: Whether the model has terms of its own besides: TD of psi, the bottleneck's KL.
        self.has_more = agent.successor is not None or bool(self.terms)

    def minibatches(self, batch: TensorDictBase) -> Sequence[TensorDictBase]:
        """Parts of the environments; a graph of own transitions has the batch by then."""
        if self._learns_graph:
            self.expert.extend(batch)
        return batch.split(len(batch) // self._parts)

    def losses(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Terms of a batch whose states the expert has labelled."""
        steps, best = self.expert.label(batch.get("state_id")[..., -1], batch.get("goal_id"))
        labelled = batch.copy().set("steps_to_goal", steps.to(batch.device or "cpu"))
        labelled.set("best_action", best.to(batch.device or "cpu"))
        with set_recurrent_mode(True):
            terms = dict(self.search_loss(labelled).items())
        if self.has_more:
            torch.clear_autocast_cache()
            terms |= super().losses(batch)
        return terms

    def state_dict(self) -> dict[str, Any]:
        """The loss's buffers, and a graph of own transitions."""
        own = {"experience": self.expert.state_dict()} if self._learns_graph else {}
        return {**super().state_dict(), **own}

    def merge_states(self, states: Sequence[dict[str, Any]]) -> dict[str, Any]:
        """With the transitions of all ranks, which each gets when it resumes."""
        graphs = [state["experience"] for state in states if state is not None and "experience" in state]
        return {**states[0], "experience": merge_graphs(graphs)} if graphs else states[0]

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue with the graph; a ``CheckpointError`` where it is missing."""
        super().load_state_dict(state)
        if self._learns_graph:
            if not state.get("experience"):
                raise CheckpointError("of a training without a graph of own transitions; give expert=scenes")
            self.expert.load_state_dict(state["experience"])


def all_transitions(scenes: SceneSet) -> TensorDict:
    """Every state with every action and the state that follows, as a collector's batch (n,) would have them.

    >>> all_transitions(SceneSet.bundled(["bathroom"])).shape
    torch.Size([704])
    """
    states = torch.arange(scenes.num_states).repeat_interleave(scenes.num_actions)
    actions = torch.arange(scenes.num_actions).repeat(scenes.num_states)
    columns = {
        "state_id": states.unsqueeze(-1),
        "action": actions,
        "scene_id": scenes.scene_id.cpu()[states],
        "next": {"state_id": scenes.successor.cpu()[states, actions].unsqueeze(-1)},
    }
    return TensorDict(columns, [len(states)])
