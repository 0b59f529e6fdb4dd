"""An additional term of the loss in one file: a penalty on the size of successor features.

python examples/extending/loss_term.py objective.terms.successor_size=0.01 scenes=[bathroom]
"""

from __future__ import annotations

from typing import Any

from tensordict import TensorDict, TensorDictBase
from torchrl.objectives import LossModule

from vusfa.algorithms import register_loss_term
from vusfa.cli.launch import launch
from vusfa.experiments.training import train
from vusfa.modules import Agent


class SuccessorSize(LossModule):
    """Mean square of psi(s, g), times a coefficient.

    Args:
        agent: whose critic writes ``successor_features``.
        coefficient: weight of the term.

    Raises:
        ValueError: the agent has no successor features.
    """

    out_keys = ("loss_successor_size",)

    def __init__(self, agent: Agent, coefficient: float) -> None:
        super().__init__()
        critic = agent.get_value_operator()
        if "successor_features" not in critic.out_keys:
            raise ValueError("the model has no successor features")
        self.critic_network = critic.select_subsequence(out_keys=["successor_features"])
        self.critic_network_params = self.target_critic_network_params = None
        self.coefficient = coefficient
        self.in_keys = list(self.critic_network.in_keys)

    def _forward_value_estimator_keys(self, **_: Any) -> None:
        """There is no estimator."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The term of a batch, a scalar."""
        written = self.critic_network(tensordict.select(*self.in_keys))
        size = written["successor_features"].float().square().mean()
        return TensorDict({"loss_successor_size": self.coefficient * size}, [])


register_loss_term("successor_size", SuccessorSize)


def main(settings: dict[str, Any], overrides: list[str]) -> int:
    """Train and evaluate like ``vusfa train``."""
    return train(settings, overrides).exit_code


if __name__ == "__main__":
    launch(main)
