"""The estimator that writes advantage, value target and successor target from one pass of the critic."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any, Self

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.objectives.value import ValueEstimatorBase

from vusfa.objectives.functional import lambda_return, successor_return
from vusfa.objectives.keys import EstimatorKeys
from vusfa.objectives.networks import entry, use_params
from vusfa.objectives.rollout_values import check_next, evaluate_rollout

__all__ = ["USFEstimator"]


class USFEstimator(ValueEstimatorBase):
    r"""Estimator of ``advantage``, ``value_target`` and, where the critic has successor features,
    ``successor_target``.

    .. math::
        G_t &= r_t + \gamma [(1 - \lambda) V(s_{t+1}) + \lambda G_{t+1}], \qquad A_t = G_t - V(s_t) \\
        \Psi_t &= \phi(s_{t+1}) + \gamma [(1 - \lambda) \psi(s_{t+1}) + \lambda \Psi_{t+1}]

    The brackets are 0 beyond a terminal; at a time-out and at the rollout's end V and psi of the state
    reached stand in for the future. With ``lmbda=1`` these are VUSFA's n-step targets
    (https://arxiv.org/abs/1908.06376, Algorithm 1, as its released code has it). For a critic without
    successor features this is the lambda return, and the advantage is the generalised advantage estimate
    (Schulman et al., 2015, https://arxiv.org/abs/1506.02438).

    Targets are constants. The input has shape ``(*batch, T)``; time is the dimension named ``"time"``, else
    the last. The critic must treat the steps of a batch independently, or be recurrent by TorchRL's
    convention, which reads ``is_init``.

    Args:
        value_network: the critic; writes the value and, if it has them, successor features and state
            embedding.
        gamma: discount per step; a buffer.
        lmbda: weight of the longer return, in [0, 1]: 1 is the n-step return up to the rollout's end, 0 the
            one-step target; a buffer.
        normalize_advantage: shift and scale a batch's advantages to mean 0 and (population) deviation 1.
        average_gae: the same with the sample's deviation, as in TorchRL's GAE.
        min_advantage_std: the least divisor. While rewards are rare all advantages are small errors of the
            critic; brought to deviation 1 they would move the policy at random.
        bootstrap_at_timeout: ``False`` takes a time-out for a terminal, as the paper's released code does.
        device: not used; the estimator follows its input.

    Raises:
        ValueError: a hyperparameter out of its range.

    >>> from tensordict.nn import TensorDictModule
    >>> critic = TensorDictModule(lambda x: x.sum(-1, keepdim=True), in_keys=["x"], out_keys=["state_value"])
    >>> no = torch.zeros(3, 1, dtype=torch.bool)
    >>> x = torch.tensor([[0.0], [1.0], [2.0]])
    >>> following = {"x": x + 1, "reward": torch.ones(3, 1), "done": no, "terminated": no}
    >>> rollout = TensorDict({"x": x, "next": following}, [3])
    >>> rollout = USFEstimator(value_network=critic, gamma=0.5)(rollout)
    >>> rollout["value_target"].squeeze(-1)
    tensor([2.1250, 2.2500, 2.5000])
    >>> rollout["advantage"].squeeze(-1)
    tensor([2.1250, 1.2500, 0.5000])
    """

    _AcceptedKeys = EstimatorKeys
    default_keys = EstimatorKeys
    gamma: Tensor
    lmbda: Tensor

    def __init__(
        self,
        *,
        value_network: TensorDictModuleBase,
        gamma: float = 0.99,
        lmbda: float = 1.0,
        normalize_advantage: bool = False,
        average_gae: bool = False,
        min_advantage_std: float = 1e-4,
        bootstrap_at_timeout: bool = True,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__(value_network=value_network, device=device)
        gamma, lmbda = float(gamma), float(lmbda)
        for name, value in (("gamma", gamma), ("lmbda", lmbda)):
            if not 0.0 <= value <= 1.0:
                raise ValueError(f"USFEstimator: {name} is {value}; give a number in [0, 1]")
        if not min_advantage_std > 0.0:
            raise ValueError(f"USFEstimator: min_advantage_std is {min_advantage_std}; give a number above 0")
        if normalize_advantage and average_gae:
            raise ValueError("USFEstimator: normalize_advantage and average_gae are both set; give one")
        # in double precision, whatever that of the rewards: 0.99 is no float32
        self.register_buffer("gamma", torch.tensor(gamma, dtype=torch.float64))
        self.register_buffer("lmbda", torch.tensor(lmbda, dtype=torch.float64))
        self.normalize_advantage = normalize_advantage
        self.average_gae = average_gae
        self.min_advantage_std = min_advantage_std
        self.bootstrap_at_timeout = bootstrap_at_timeout
        #: mean of a tensor over the ranks of a data-parallel training; None for one process
        self.mean: Callable[[Tensor], Tensor] | None = None

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Both buffers are read as Python numbers: they stay in double precision, on the CPU."""
        return self

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        for name, buffer in self.named_buffers():
            state_dict.setdefault(prefix + name, buffer)  # version 0.1 did not save them
        super()._load_from_state_dict(state_dict, prefix, *args)

    @property
    def has_successor(self) -> bool:
        """Whether the critic writes successor features and state embeddings."""
        written = {unravel_key(key) for key in self.value_network.out_keys}
        wanted = (self.tensor_keys.successor_features, self.tensor_keys.state_embedding)
        return all(unravel_key(key) in written for key in wanted)

    @property
    def out_keys(self) -> list[NestedKey]:
        """The entries written."""
        keys = self.tensor_keys
        return [keys.advantage, keys.value_target, *([keys.successor_target] if self.has_successor else [])]

    @dispatch
    def forward(
        self,
        tensordict: TensorDictBase,
        *,
        params: TensorDictBase | None = None,
        target_params: TensorDictBase | None = None,
        time_dim: int | None = None,
        written: TensorDictBase | None = None,
        index: Tensor | None = None,
    ) -> TensorDictBase:
        """Write the targets into a rollout.

        Args:
            tensordict: ``(*batch, T)``, with the critic's inputs at the root and under ``"next"``, and
                reward, done and terminated under ``"next"``.
            params: the critic's parameters; its own when ``None``.
            target_params: used in place of ``params``.
            time_dim: the dimension of time.
            written: ``(*batch, T)``, the critic's outputs at the root states, where they are known. Not
                differentiated; a recurrent critic runs all the same.
            index: ``(*batch, T)``, each step's row of a ``written`` ``(D,)`` that holds distinct rows.

        Returns:
            the same tensordict, with ``advantage`` and ``value_target``, ``(*batch, T, 1)``, and
            ``successor_target``, ``(*batch, T, E)``.

        Raises:
            ValueError: the tensordict has no time dimension.
            KeyError: an entry is missing, such as the next states (``compact_obs=True`` of a collector).
        """
        if tensordict.batch_dims < 1:
            raise ValueError("USFEstimator: a rollout has a time dimension, but the batch size is empty")
        time_dim, last = self._get_time_dim(time_dim, tensordict), tensordict.batch_dims - 1
        params = params if target_params is None else target_params
        if time_dim == last:
            return tensordict.update(self._targets(tensordict, params, written, index))
        if index is not None:
            index = index.transpose(time_dim, last)
        elif written is not None:
            written = written.transpose(time_dim, last)
        targets = self._targets(tensordict.transpose(time_dim, last), params, written, index)
        return tensordict.update(targets.transpose(time_dim, last))

    def value_estimate(
        self, tensordict: TensorDictBase, target_params: TensorDictBase | None = None, **_: Any
    ) -> Tensor:
        """The value targets alone, ``(*batch, T, 1)``; see :meth:`forward`. The input is not written."""
        targets = self(tensordict.copy(), params=target_params)
        return targets.get(self.tensor_keys.value_target)

    @torch.no_grad()
    def _targets(
        self,
        data: TensorDictBase,
        params: TensorDictBase | None,
        written: TensorDictBase | None,
        index: Tensor | None,
    ) -> TensorDict:
        keys = self.tensor_keys
        reward = entry(self, data, ("next", keys.reward))
        done = entry(self, data, ("next", keys.done))
        terminated = data.get(("next", keys.terminated), done)
        if not self.bootstrap_at_timeout:
            terminated = done
        mask = data.get(("collector", "mask"), None)
        ended = _cut_at_padding(done, mask)

        wanted = [keys.value]
        if self.has_successor:
            wanted += [keys.successor_features, keys.state_embedding]
        check_next(self, data, self.value_network)
        with contextlib.nullcontext() if params is None else use_params(self.value_network, params):
            value, following = evaluate_rollout(
                self.value_network, data, ended.any(-1), wanted, written, index
            )
        if self.has_successor:
            ended, terminated = ended.any(-1, keepdim=True), terminated.any(-1, keepdim=True)
        at_next = [x.to(reward.dtype) for x in following]  # V, psi and phi of s_{t+1}
        gamma, lmbda = float(self.gamma), float(self.lmbda)
        returns = [lambda_return(reward, at_next[0], gamma, lmbda, ended, terminated)]
        if self.has_successor:  # phi from s_{t+1} on: the paper's Eqs. 4 and 13 and its code, not its Eq. 6
            returns.append(successor_return(at_next[2], at_next[1], gamma, ended, terminated, lmbda))
        advantage = returns[0] - value.to(reward.dtype)
        if self.normalize_advantage and self.mean is not None:
            advantage = _normalize_together(advantage, self.min_advantage_std, self.mean)
        elif self.normalize_advantage or self.average_gae:
            advantage = _normalize(advantage, mask, self.min_advantage_std, int(self.average_gae))
        return TensorDict(dict(zip(self.out_keys, [advantage, *returns], strict=True)), data.batch_size)


def _cut_at_padding(done: Tensor, mask: Tensor | None) -> Tensor:
    """``done``, and also where the next step of a row is padding."""
    if mask is None:
        return done
    mask = mask.reshape(*mask.shape[: done.ndim - 1], -1).any(-1, keepdim=True)
    padding_follows = torch.zeros_like(mask)
    padding_follows[..., :-1, :] = ~mask[..., 1:, :]
    return done | padding_follows


def _normalize(advantage: Tensor, mask: Tensor | None, min_std: float, correction: int) -> Tensor:
    if mask is None:
        valid = advantage
    else:
        valid = advantage[mask.reshape(*mask.shape[: advantage.ndim - 1], -1).any(-1)]
    return (advantage - valid.mean()) / valid.std(correction=correction).clamp_min(min_std)


def _normalize_together(
    advantage: Tensor, min_std: float, mean_of_ranks: Callable[[Tensor], Tensor]
) -> Tensor:
    """As :func:`_normalize`, over batches of one size on all ranks."""
    mean = mean_of_ranks(advantage.mean())
    variance = mean_of_ranks((advantage - mean).square().mean())
    return (advantage - mean) / variance.sqrt().clamp_min(min_std)
