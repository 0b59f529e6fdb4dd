"""Reward weights learned by regression of the reward itself, without a gradient of the value."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor

from vusfa.objectives.functional import assert_same_shape
from vusfa.objectives.network_loss import NetworkLoss
from vusfa.objectives.networks import entry
from vusfa.objectives.rollout_values import check_next

__all__ = ["RewardRegressionLoss", "reward_regression_loss"]


def reward_regression_loss(embedding: Tensor, weights: Tensor, reward: Tensor) -> Tensor:
    r"""Squared error of the reward that embedding and weights predict.

    .. math:: (\phi(s') \cdot \omega(g) - r)^2

    Equation 3 of Ma et al., Universal Successor Representations for Transfer Reinforcement Learning
    (https://arxiv.org/abs/1804.03758), with the embedding of the next state.

    Args:
        embedding: phi(s'), (\*B, E); a constant.
        weights: omega(g), (\*B, E).
        reward: r, (\*B, 1).

    Returns:
        (\*B,).

    Raises:
        ValueError: shapes do not fit each other.

    >>> import torch
    >>> phi, omega = torch.tensor([[1.0, 2.0]]), torch.tensor([[3.0, -1.0]])
    >>> reward_regression_loss(phi, omega, torch.tensor([[4.0]]))
    tensor([9.])
    """
    predicted = (embedding.detach().float() * weights.float()).sum(-1)
    reward = reward.squeeze(-1) if reward.ndim > predicted.ndim else reward
    assert_same_shape("reward_regression_loss", predicted=predicted, reward=reward)
    return (predicted - reward).square()


@dataclass
class RewardKeys:
    """Entries of :class:`RewardRegressionLoss`: ``reward`` under ``"next"``; the others are the critic's."""

    reward: NestedKey = "reward"
    state_embedding: NestedKey = "state_embedding"
    reward_weights: NestedKey = "reward_weights"


class RewardRegressionLoss(NetworkLoss):
    """Regression of the reward, which trains the layers behind a critic's ``reward_weights`` and no others.

    For successor features without a gradient of the value: beside :class:`~vusfa.objectives.USFLoss` with
    ``critic_coeff=0``, and usually an autoencoder's phi.

    Args:
        critic_network: writes ``state_embedding`` and ``reward_weights``; only the modules that these need
            run, on the next step's entries. What ``"next"`` lacks, such as the goal, is this step's.
        reward_coeff: the term's coefficient; a buffer.
        reduction: ``"mean"``, ``"sum"`` or ``"none"`` over steps.
        functional: whether the loss holds the critic's parameters as a tensordict apart from the modules.

    Returns (of ``forward``): ``loss_reward``, with its coefficient.

    Raises:
        TypeError: the argument is no critic.
        ValueError: in ``forward``, the critic writes no reward weights (renamed by ``set_keys``).

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
    _schedulable_buffers = frozenset({"reward_coeff"})

    def __init__(
        self,
        critic_network: TensorDictModuleBase,
        reward_coeff: float = 1.0,
        *,
        reduction: Literal["none", "mean", "sum"] | None = "mean",
        functional: bool = True,
    ) -> None:
        super().__init__({"critic_network": critic_network}, reduction=reduction, functional=functional)
        self._register_coefficients(reward_coeff=reward_coeff)

    def check(self) -> None:
        """Raise where the critic lacks an entry; ``forward`` does so, too."""
        self._check_written("state_embedding", "reward_weights")

    def _needed(self) -> TensorDictModuleBase:
        """The modules of the critic that the term needs."""
        self.check()
        keys = self.tensor_keys
        if not isinstance(self.critic_network, TensorDictSequential):
            return self.critic_network
        return self.critic_network.select_subsequence(out_keys=[keys.state_embedding, keys.reward_weights])

    def _default_in_keys(self) -> list[NestedKey]:
        networks = list(self._needed().in_keys)
        return [*networks, *(("next", key) for key in (*networks, self.tensor_keys.reward))]

    def _default_out_keys(self) -> list[NestedKey]:
        return ["loss_reward"]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The term, a scalar, or ``(*batch,)`` with ``reduction="none"``.

        Args:
            tensordict: steps of any batch shape. Not written.

        Raises:
            KeyError: an entry is missing, such as the next states (``compact_obs=True`` of a collector).
        """
        keys, critic = self.tensor_keys, self._needed()
        check_next(self, tensordict, critic)
        reward = entry(self, tensordict, ("next", keys.reward))
        valid = self._valid(tensordict, reward)
        if valid is not None:  # what a mask hides may be infinite
            reward = torch.where(valid, reward, 0.0)
        inputs = tensordict.select(*critic.in_keys, strict=False)
        inputs = inputs.update(tensordict.get("next").select(*critic.in_keys, strict=False))
        for key in map(unravel_key, critic.in_keys):
            entry(self, inputs, key)
        with self._params_in_place():
            written = critic(inputs)
        embedding, weights = written.get(keys.state_embedding), written.get(keys.reward_weights)
        error = reward_regression_loss(embedding, weights, reward)
        term = self.reward_coeff * self._reduce_loss(error, tensordict)
        self._clear_weakrefs(tensordict, "critic_network_params")
        return TensorDict({"loss_reward": term}, [])
