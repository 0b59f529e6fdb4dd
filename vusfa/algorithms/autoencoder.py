"""The baseline of the paper's text: a pretrained encoder, and regression of the reward."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from vusfa.algorithms.registry import register_algorithm
from vusfa.algorithms.usf import USF
from vusfa.errors import ConfigError
from vusfa.modules import Agent, pretrain_autoencoder
from vusfa.scenes import SceneSet

__all__ = ["Autoencoder"]


@register_algorithm("autoencoder")
class Autoencoder(USF):
    """An autoencoder's phi, pretrained on all states and then constant, as in Ma et al. 2018
    (https://arxiv.org/abs/1804.03758).

    ``preset=autoencoder`` has its numbers: no gradient of the value (``objective.critic_coeff=0``), omega by
    regression of the reward (``objective.terms.reward=1``).

    Attributes:
        explained: share of the features' variance that the reconstruction explains; None before.
    """

    explained: float | None = None

    def __init__(self, agent: Agent, scenes: SceneSet, settings: Mapping[str, Any]) -> None:
        super().__init__(agent, scenes, settings)
        if agent.config["pretrained"] != "autoencoder":
            raise ConfigError(
                f"algorithm=autoencoder pretrains the encoder, but agent.pretrained is"
                f" {agent.config['pretrained']}; give agent.pretrained=autoencoder, or preset=autoencoder"
            )

    def prepare(self) -> str:
        """Pretrain the encoder."""
        self.explained = pretrain_autoencoder(self.agent, seed=self.settings["seed"])
        return f"autoencoder: explains {100 * self.explained:.1f} % of the features' variance"
