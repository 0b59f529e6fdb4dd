"""The paper's algorithm with off-policy learning towards goals named in hindsight."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tensordict import TensorDictBase
from torch import Tensor

from vusfa.algorithms.base import check_replay
from vusfa.algorithms.registry import register_algorithm
from vusfa.algorithms.replay import HindsightReplay, RankedReplay
from vusfa.algorithms.usf import USF
from vusfa.errors import CheckpointError, ConfigError
from vusfa.modules import Agent
from vusfa.objectives.hindsight import HindsightLoss
from vusfa.scenes import SceneSet

__all__ = ["Hindsight"]

# arguments of HindsightReplay and of HindsightLoss among the settings of hindsight
_OF_REPLAY = ("capacity", "batch_size", "horizon", "own_future")
_OF_LOSS = ("critic_coeff", "objective_coeff", "expectile", "temperature", "max_weight")


@register_algorithm("hindsight")
class Hindsight(RankedReplay, USF):
    """:class:`~vusfa.algorithms.USF`, and :class:`~vusfa.objectives.HindsightLoss` on transitions from
    :class:`~vusfa.algorithms.HindsightReplay`, with the numbers of ``settings["hindsight"]``.

    The first of ``hindsight.updates`` steps learns from the batch, too: its gradient is that of both losses.
    """

    def __init__(self, agent: Agent, scenes: SceneSet, settings: Mapping[str, Any]) -> None:
        super().__init__(agent, scenes, settings)
        numbers, task, collector = settings["hindsight"], settings["env"], settings["collector"]
        updates = numbers["updates"]
        if updates < 1:
            raise ConfigError(f"hindsight.updates is {updates}; give 1 or more, or algorithm=usf")
        check_replay("hindsight", agent, self.threads)
        if collector["kind"] == "multi_async":
            raise ConfigError(
                "hindsight follows each environment from batch to batch, which collector.kind=multi_async"
                " hands over in no fixed order; give single or multi_sync, or algorithm=usf"
            )
        self.replay_steps = updates - 1
        sizes = {name: numbers[name] for name in _OF_REPLAY}
        self.replay = HindsightReplay(scenes.num_states, collector["num_envs"], **sizes)
        try:
            self.hindsight_loss = HindsightLoss(
                agent.get_policy_operator(),
                agent.get_value_operator(),
                **{name: numbers[name] for name in _OF_LOSS},
                gamma=settings["objective"]["gamma"],
                goal_reward=task["goal_reward"],
                step_reward=task["step_reward"],
                functional=False,
            )
        except ValueError as error:
            raise ConfigError(f"hindsight: {error}") from error
        self.hindsight_loss.to(next(agent.parameters()).device)

    def scenes_on_record(self) -> Tensor:
        """Those of the replay buffer."""
        return self.replay.scenes()

    def losses(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """On-policy terms, and those of a sample that may hold the batch."""
        terms = super().losses(batch)
        self.replay.extend(batch)
        return self._with_replay(terms)

    def replay_losses(self) -> dict[str, Tensor]:
        """Terms of a sample."""
        return dict(self.hindsight_loss(self.replay.sample()).items())

    def state_dict(self) -> dict[str, Any]:
        """The loss's buffers, and the replay buffer."""
        return {**super().state_dict(), "replay": self.replay.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue with the replay buffer; a ``CheckpointError`` where the state has none."""
        super().load_state_dict(state)
        if not state.get("replay"):
            raise CheckpointError("of a training without hindsight; give algorithm=usf")
        self.replay.load_state_dict(state["replay"])
