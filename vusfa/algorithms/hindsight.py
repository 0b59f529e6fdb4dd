"""The paper's algorithm, and off-policy learning towards goals named in hindsight."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from vusfa.algorithms.registry import register_algorithm
from vusfa.algorithms.replay import HindsightReplay
from vusfa.algorithms.usf import USF
from vusfa.errors import CheckpointError, ConfigError
from vusfa.modules import Agent
from vusfa.objectives.hindsight import HindsightLoss
from vusfa.scenes import SceneSet

__all__ = ["Hindsight"]


@register_algorithm("hindsight")
class Hindsight(USF):
    """:class:`~vusfa.algorithms.USF`, and :class:`~vusfa.objectives.HindsightLoss` on transitions from
    :class:`~vusfa.algorithms.HindsightReplay`; numbers are those of ``settings["hindsight"]``.

    The first of ``hindsight.updates`` steps is the batch's own: its gradient is the sum of both losses'.

    Attributes:
        replay: transitions and their goals.
        hindsight_loss: of a sample.
    """

    def __init__(self, agent: Agent, scenes: SceneSet, settings: Mapping[str, Any]) -> None:
        super().__init__(agent, scenes, settings)
        numbers, task, collector = dict(settings["hindsight"]), settings["env"], settings["collector"]
        updates = numbers.pop("updates")
        if updates < 1:
            raise ConfigError(f"hindsight.updates is {updates}; give 1 or more, or algorithm=usf")
        if agent.config["observation"] != "index" or agent.config["memory"] is not None:
            raise ConfigError(
                "hindsight names goals by their ids, to an agent that reads ids and has no memory; give"
                " agent.observation=index and agent.memory=null, or algorithm=usf"
            )
        if collector["kind"] == "multi_async":
            raise ConfigError(
                "hindsight follows each environment from batch to batch, which collector.kind=multi_async"
                " hands over in no fixed order; give single or multi_sync, or algorithm=usf"
            )
        if self.threads is not None:
            raise ConfigError(
                "optim.kind=a3c_rmsprop makes an update per environment of a batch, and steps from"
                " hindsight's replay have none; give optim=adam, or algorithm=usf"
            )
        self.replay_steps = updates - 1
        sizes = {name: numbers.pop(name) for name in ("capacity", "batch_size", "horizon", "own_future")}
        self.replay = HindsightReplay(scenes.num_states, collector["num_envs"], **sizes)
        try:
            self.hindsight_loss = HindsightLoss(
                agent.get_policy_operator(),
                agent.get_value_operator(),
                gamma=settings["objective"]["gamma"],
                goal_reward=task["goal_reward"],
                step_reward=task["step_reward"],
                **numbers,
            )
        except ValueError as error:
            raise ConfigError(f"hindsight: {error}") from error

    def losses(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """On-policy terms, and those of a sample that may hold the batch."""
        terms = super().losses(batch)
        self.replay.extend(batch)
        # converted weights are not shared with the on-policy terms: gradients would be added in bfloat16
        torch.clear_autocast_cache()
        return {**terms, **self.replay_losses()}

    def replay_losses(self) -> dict[str, Tensor]:
        """Terms of a sample."""
        return dict(self.hindsight_loss(self.replay.sample()).items())

    def state_dict(self) -> dict[str, Any]:
        """The loss's buffers, and the replay buffer."""
        return {**super().state_dict(), "replay": self.replay.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues with the replay buffer.

        Raises:
            CheckpointError: the state has none.
        """
        super().load_state_dict(state)
        if not state.get("replay"):
            raise CheckpointError("of a training without hindsight; give algorithm=usf")
        self.replay.load_state_dict(state["replay"])
