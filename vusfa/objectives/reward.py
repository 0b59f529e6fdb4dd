"""Reward weights learned by regression of the reward itself, without a gradient of the value."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictSequential
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import LossModule

__all__ = ["RewardRegressionLoss", "reward_regression_loss"]


def reward_regression_loss(embedding: Tensor, weights: Tensor, reward: Tensor) -> Tensor:
    r"""Squared error of the reward that embedding and weights predict, (\*B,).

    .. math:: (\phi(s') \cdot \omega(g) - r)^2

    Equation 3 of Ma et al., Universal Successor Representations for Transfer Reinforcement Learning
    (https://arxiv.org/abs/1804.03758), with features of the state arrived in.

    Args:
        embedding: phi(s'), (\*B, E); a constant.
        weights: omega(g), (\*B, E).
        reward: r, (\*B, 1).

    >>> import torch
    >>> phi, omega = torch.tensor([[1.0, 2.0]]), torch.tensor([[3.0, -1.0]])
    >>> reward_regression_loss(phi, omega, torch.tensor([[4.0]]))
    tensor([9.])
    """
    predicted = (embedding.detach().float() * weights.float()).sum(-1)
    return (predicted - reward.squeeze(-1)).square()


@dataclass
class RewardKeys:
    """Names of the entries that the loss reads."""

    reward: NestedKey = "reward"
    state_embedding: NestedKey = "state_embedding"
    reward_weights: NestedKey = "reward_weights"


class RewardRegressionLoss(LossModule):
    """Trains the layers behind a critic's ``reward_weights``, and nothing else, to predict the reward.

    Beside :class:`~vusfa.objectives.USFLoss` with ``critic_coeff=0`` this is how successor features were
    trained before the value's gradient went through omega; phi is then usually an autoencoder's.

    Args:
        critic_network: writes ``state_embedding`` and ``reward_weights``; only the modules that these need
            run, on the next step's entries. What a next step does not hold, such as the goal, is this step's.
        reward_coeff: the term's coefficient.

    Returns (of ``forward``): ``loss_reward``, with its coefficient, a scalar.

    Raises:
        ValueError: the critic writes no reward weights.

    >>> import torch
    >>> from vusfa.modules import make_agent
    >>> from vusfa.scenes import SceneSet
    >>> rooms = SceneSet.bundled(["bathroom"])
    >>> agent = make_agent("usfa", scenes=rooms, history=1, hidden_size=8, embedding_size=8)
    >>> steps = TensorDict({
    ...     "goal_id": torch.zeros(5, dtype=torch.int64), "scene_id": torch.zeros(5, dtype=torch.int64),
    ...     "next": {"state_id": torch.arange(5).view(5, 1), "reward": torch.ones(5, 1)},
    ... }, [5])
    >>> RewardRegressionLoss(agent.get_value_operator())(steps)["loss_reward"].shape
    torch.Size([])
    """

    _AcceptedKeys = RewardKeys
    default_keys = RewardKeys
    tensor_keys: RewardKeys
    out_keys = ("loss_reward",)

    def __init__(self, critic_network: TensorDictSequential, reward_coeff: float = 1.0) -> None:
        super().__init__()
        wanted = [self.tensor_keys.state_embedding, self.tensor_keys.reward_weights]
        missing = [key for key in wanted if key not in critic_network.out_keys]
        if missing:
            raise ValueError(
                f"RewardRegressionLoss: the critic writes no {missing[0]!r}; one with successor features does"
            )
        self.critic_network = critic_network.select_subsequence(out_keys=wanted)
        self.critic_network_params = self.target_critic_network_params = None
        self.reward_coeff = reward_coeff

    @property
    def in_keys(self) -> list[NestedKey]:
        """Everything that ``forward`` may read."""
        networks = list(self.critic_network.in_keys)
        following: list[Any] = [("next", key) for key in (*networks, self.tensor_keys.reward)]
        return [*networks, *following]

    def _forward_value_estimator_keys(self, **_: Any) -> None:
        """There is no estimator."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The term.

        Args:
            tensordict: steps of any batch shape. Not written.
        """
        keys, following = self.tensor_keys, tensordict.get("next")
        inputs = tensordict.select(*self.critic_network.in_keys, strict=False)
        inputs = inputs.update(following.select(*self.critic_network.in_keys, strict=False))
        written = self.critic_network(inputs)
        error = reward_regression_loss(
            written.get(keys.state_embedding), written.get(keys.reward_weights), following.get(keys.reward)
        )
        return TensorDict({"loss_reward": self.reward_coeff * error.mean()}, [])
