"""A new algorithm in one file: proximal policy optimization (Schulman et al. 2017, arXiv 1707.06347).

    python examples/extending/algorithm.py algorithm=ppo algorithm.epochs=3 scenes=[bathroom]

Each batch is used for several passes; the other losses of the paper's models are unchanged.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from vusfa.algorithms import USF, AlgorithmSettings, register_algorithm
from vusfa.cli.launch import launch
from vusfa.errors import ConfigError
from vusfa.experiments.training import train
from vusfa.modules import Agent
from vusfa.scenes import SceneSet


@dataclass
class PPOSettings(AlgorithmSettings):
    """Settings ``algorithm.*``; clip is of the ratio of probabilities, epochs are passes over a batch."""

    clip: float = 0.2
    epochs: int = 4


@register_algorithm("ppo")
class PPO(USF):
    """USF with the clipped surrogate objective as the policy's term."""

    Settings = PPOSettings

    def __init__(self, agent: Agent, scenes: SceneSet, settings: Mapping[str, Any]) -> None:
        super().__init__(agent, scenes, settings)
        self.clip, epochs = settings["algorithm"]["clip"], settings["algorithm"]["epochs"]
        if epochs < 1:
            raise ConfigError(f"algorithm.epochs is {epochs}; give 1 or more")
        self.replay_steps = epochs - 1
        self.actor = agent.get_policy_operator()

    def losses(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Terms of the first pass; advantages and probabilities are kept for the others."""
        with torch.no_grad():
            self.batch = self.loss.value_estimator(batch.clone(False))
            self.before = self._log_prob()
        return self.replay_losses()

    def replay_losses(self) -> dict[str, Tensor]:
        """Terms of one pass, all but the policy's as in USF."""
        ratio = (self._log_prob() - self.before).exp()
        clipped = ratio.clamp(1 - self.clip, 1 + self.clip)
        advantage = self.batch["advantage"].squeeze(-1)
        objective = -torch.minimum(ratio * advantage, clipped * advantage).mean()
        return {**super().losses(self.batch), "loss_objective": objective}

    def _log_prob(self) -> Tensor:
        return self.actor.get_dist(self.batch).log_prob(self.batch["action"])


def main(settings: dict[str, Any], overrides: list[str]) -> int:
    """Train and evaluate like ``vusfa train``."""
    return train(settings, overrides).exit_code


if __name__ == "__main__":
    launch(main)
