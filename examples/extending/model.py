"""A fifth model in one file: a policy whose hidden state is gated by psi.

python examples/extending/model.py agent.model=gated scenes=[bathroom]
"""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn

from vusfa.cli.launch import launch
from vusfa.experiments.training import train
from vusfa.modules import Agent, AgentConfig, Model, PolicyHead, register_model


class GatedPolicyHead(nn.Module):
    """Logits of the hidden state times the sigmoid of a linear layer on psi, which is a constant here."""

    def __init__(self, num_scenes: int, hidden_size: int, embedding_size: int, num_actions: int) -> None:
        super().__init__()
        self.gate = nn.Linear(embedding_size, hidden_size)
        self.head = PolicyHead(num_scenes, hidden_size, num_actions)

    def forward(self, hidden: Tensor, successor: Tensor, scene_id: Tensor) -> Tensor:
        """(\\*B, hidden_size), psi (\\*B, E) and scene indices (\\*B,) to logits (\\*B, A)."""
        return self.head(hidden * self.gate(successor.detach()).sigmoid(), scene_id)


class GatedAgent(Agent):
    """USFA with that policy; the model's ideas determine its inputs: hidden state, psi, scene."""

    def make_policy(self, config: AgentConfig, num_actions: int) -> nn.Module:
        """The gated head."""
        return GatedPolicyHead(self.num_scenes, config.hidden_size, config.embedding_size, num_actions)


register_model("gated", Model(True, True, False, GatedAgent))


def main(settings: dict[str, Any], overrides: list[str]) -> int:
    """Train and evaluate like ``vusfa train``."""
    return train(settings, overrides).exit_code


if __name__ == "__main__":
    launch(main)
