"""The paper's algorithm, and shortest paths found in the agent's own transitions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from tensordict import TensorDictBase
from torch import Tensor

from vusfa.algorithms.base import AlgorithmSettings, check_replay
from vusfa.algorithms.experience import ExperienceGraph, merge_graphs
from vusfa.algorithms.registry import register_algorithm
from vusfa.algorithms.usf import USF
from vusfa.errors import CheckpointError, ConfigError
from vusfa.modules import Agent
from vusfa.objectives.search import SearchLoss
from vusfa.scenes import SceneSet

__all__ = ["ReplaySearch", "ReplaySearchSettings", "make_search_loss"]

#: Frames of walking before the first search, at most, where settings give none.
MAX_START = 100_000


@dataclass
class ReplaySearchSettings(AlgorithmSettings):
    """Numbers of ``algorithm=replay_search``.

    Attributes:
        updates: optimizer steps per batch of the collector.
        batch_size: pairs of a state and a goal in each of these steps.
        num_goals: goals among these pairs.
        path_share: share of the states that are drawn as walks to the goal pass them, the others uniformly.
        learning_starts: frames of walking before the first search; None: 40 % of ``total_frames``, at most
            100,000. A policy that has learned shortest paths tries nothing else, so every action should have
            been tried by then.
        critic_coeff, objective_coeff: of :class:`~vusfa.objectives.SearchLoss`.
    """

    updates: int = 10
    batch_size: int = 8192
    num_goals: int = 32
    path_share: float = 0.5
    learning_starts: int | None = None
    critic_coeff: float = 1.0
    objective_coeff: float = 1.0


def make_search_loss(where: str, agent: Agent, settings: Mapping[str, Any]) -> SearchLoss:
    """The loss of an agent's actor and critic, with the rewards and the discount of a training.

    Args:
        where: start of an error's message.
        agent: what learns.
        settings: all settings; ``settings["algorithm"]`` has the coefficients.

    Raises:
        ConfigError: a setting out of its range.
    """
    options = {name: settings["algorithm"][name] for name in ("critic_coeff", "objective_coeff")}
    options |= {name: settings["env"][name] for name in ("goal_reward", "step_reward")}
    options["gamma"] = settings["objective"]["gamma"]
    networks = agent.get_policy_operator(), agent.get_value_operator()
    try:
        loss = SearchLoss(*networks, **options, functional=False)
    except ValueError as error:
        raise ConfigError(f"{where}: {error}") from error
    return loss.to(next(agent.parameters()).device)


@register_algorithm("replay_search")
class ReplaySearch(USF):
    """:class:`~vusfa.algorithms.USF`, and :class:`~vusfa.objectives.SearchLoss` on pairs of states and goals
    from an :class:`~vusfa.algorithms.ExperienceGraph` of all transitions so far.

    The first of ``algorithm.updates`` steps learns from the batch, too: its gradient is that of both losses.
    """

    Settings = ReplaySearchSettings

    def __init__(self, agent: Agent, scenes: SceneSet, settings: Mapping[str, Any]) -> None:
        super().__init__(agent, scenes, settings)
        numbers = self._numbers = settings["algorithm"]
        for name in ("updates", "num_goals"):
            if numbers[name] < 1:
                raise ConfigError(f"algorithm.{name} is {numbers[name]}; give 1 or more")
        if numbers["batch_size"] < numbers["num_goals"]:
            raise ConfigError(
                f"algorithm.batch_size is {numbers['batch_size']} for {numbers['num_goals']} goals; give one"
                " pair per goal or more"
            )
        if not 0 <= numbers["path_share"] <= 1:
            raise ConfigError(
                f"algorithm.path_share is {numbers['path_share']}; give a number between 0 and 1"
            )
        starts, total = numbers["learning_starts"], settings["total_frames"]
        self._starts = min(MAX_START, int(0.4 * total)) if starts is None else starts
        if not 0 <= self._starts < total:
            raise ConfigError(
                f"algorithm.learning_starts is {starts} of total_frames {total}: nothing would be learned"
                " from the search; give fewer, 0 or more, or null"
            )
        check_replay("replay_search", agent, self.threads, history=1)
        self._searches = False
        self.graph = ExperienceGraph(scenes.num_states, scenes.num_actions)
        self.search_loss = make_search_loss("replay_search", agent, settings)

    def schedule(self, frames: int) -> None:
        """Begin to search after ``learning_starts``, once and for all."""
        super().schedule(frames)
        self._searches = self._searches or frames >= self._starts
        self.replay_steps = self._numbers["updates"] - 1 if self._searches else 0

    def scenes_on_record(self) -> Tensor:
        """Those of the graph."""
        return self.graph.scene_of[self.graph.scene_of >= 0].unique()

    def losses(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """On-policy terms, and those of pairs from a graph that has the batch."""
        terms = super().losses(batch)
        self.graph.extend(batch)
        return self._with_replay(terms) if self._searches else terms

    def replay_losses(self) -> dict[str, Tensor]:
        """Terms of a sample of pairs."""
        numbers = self._numbers
        pairs = self.graph.sample(numbers["num_goals"], numbers["batch_size"], numbers["path_share"])
        return dict(self.search_loss(pairs.to(next(self.agent.parameters()).device)).items())

    def state_dict(self) -> dict[str, Any]:
        """The loss's buffers, and the graph."""
        return {**super().state_dict(), "experience": self.graph.state_dict(), "searches": self._searches}

    def merge_states(self, states: Sequence[dict[str, Any]]) -> dict[str, Any]:
        """With the transitions of all ranks, which each gets when it resumes."""
        graphs = [state["experience"] for state in states if state is not None]
        return {**states[0], "experience": merge_graphs(graphs)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue with the graph; a ``CheckpointError`` where the state has none."""
        super().load_state_dict(state)
        if not state.get("experience"):
            raise CheckpointError("of a training without replay_search; give algorithm=usf")
        self.graph.load_state_dict(state["experience"])
        self._searches = bool(state["searches"])
