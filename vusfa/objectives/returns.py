"""The estimator that writes advantage, value target and successor target from one pass of the critic."""

from __future__ import annotations

import contextlib
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.objectives.value import ValueEstimatorBase

from vusfa.objectives.functional import lambda_return
from vusfa.objectives.keys import EstimatorKeys
from vusfa.objectives.rollout_values import evaluate_rollout

__all__ = ["USFEstimator"]

MASK_KEY = ("collector", "mask")


class USFEstimator(ValueEstimatorBase):
    r"""Writes ``advantage``, ``value_target`` and, where the critic has successor features,
    ``successor_target``.

    .. math::
        G_t &= r_t + \gamma [(1 - \lambda) V(s_{t+1}) + \lambda G_{t+1}], \qquad A_t = G_t - V(s_t) \\
        \Psi_t &= \phi(s_{t+1}) + \gamma [(1 - \lambda) \psi(s_{t+1}) + \lambda \Psi_{t+1}]

    The brackets are 0 beyond a terminal; at a time-out and at the rollout's end V and psi of the state
    reached stand in for the future. With ``lmbda=1`` these are VUSFA's n-step targets
    (https://arxiv.org/abs/1908.06376, Algorithm 1, as its released code has it). For a critic without
    successor features this is the lambda return, and the advantage is the generalised advantage estimate
    (Schulman et al., 2015, https://arxiv.org/abs/1506.02438).

    Targets are constants: nothing is differentiated. The input has shape ``(*batch, T)``; time is the
    dimension named ``"time"``, else the last. The critic must be one that treats the steps of a batch
    independently, or a recurrent one by TorchRL's convention, which reads ``is_init``.

    Args:
        value_network: the critic; writes the value and, if it has them, successor features and state
            embedding.
        gamma: discount per step.
        lmbda: weight of the longer return, in [0, 1]; 1 is the n-step return up to the rollout's end, 0 the
            one-step target.
        normalize_advantage: shift and scale the advantages of a batch to mean 0 and deviation 1.
        min_advantage_std: divide by no less than this. While rewards are rare all advantages are small errors
            of the critic; brought to deviation 1 they would drive the policy somewhere at random.
        bootstrap_at_timeout: ``False`` takes a time-out for a terminal, as the paper's released code does.
        device: accepted for TorchRL's sake; the estimator follows its input.

    Raises:
        ValueError: for a hyperparameter out of its range.

    >>> from tensordict.nn import TensorDictModule
    >>> critic = TensorDictModule(lambda x: x.sum(-1, keepdim=True), in_keys=["x"], out_keys=["state_value"])
    >>> no = torch.zeros(3, 1, dtype=torch.bool)
    >>> rollout = TensorDict({
    ...     "x": torch.tensor([[0.0], [1.0], [2.0]]),
    ...     "next": {
    ...         "x": torch.tensor([[1.0], [2.0], [3.0]]),
    ...         "reward": torch.ones(3, 1), "done": no, "terminated": no,
    ...     },
    ... }, [3])
    >>> rollout = USFEstimator(value_network=critic, gamma=0.5)(rollout)
    >>> rollout["value_target"].squeeze(-1)
    tensor([2.1250, 2.2500, 2.5000])
    >>> rollout["advantage"].squeeze(-1)
    tensor([2.1250, 1.2500, 0.5000])
    """

    _AcceptedKeys = EstimatorKeys
    default_keys = EstimatorKeys

    def __init__(
        self,
        *,
        value_network: TensorDictModuleBase,
        gamma: float = 0.99,
        lmbda: float = 1.0,
        normalize_advantage: bool = False,
        min_advantage_std: float = 1e-4,
        bootstrap_at_timeout: bool = True,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__(value_network=value_network, device=device)
        gamma, lmbda = float(gamma), float(lmbda)
        if not 0.0 <= gamma <= 1.0:
            raise ValueError(f"USFEstimator: gamma is {gamma}; give a number in [0, 1]")
        if not 0.0 <= lmbda <= 1.0:
            raise ValueError(f"USFEstimator: lmbda is {lmbda}; give a number in [0, 1]")
        if not min_advantage_std > 0.0:
            raise ValueError(f"USFEstimator: min_advantage_std is {min_advantage_std}; give a number above 0")
        self.gamma = gamma
        self.lmbda = lmbda
        self.normalize_advantage = normalize_advantage
        self.min_advantage_std = min_advantage_std
        self.bootstrap_at_timeout = bootstrap_at_timeout

    @property
    def has_successor(self) -> bool:
        """Whether the critic writes successor features and state embeddings."""
        written = {unravel_key(key) for key in self.value_network.out_keys}
        wanted = (self.tensor_keys.successor_features, self.tensor_keys.state_embedding)
        return all(unravel_key(key) in written for key in wanted)

    @property
    def out_keys(self) -> list[NestedKey]:
        """The entries written."""
        keys = [self.tensor_keys.advantage, self.tensor_keys.value_target]
        return keys + [self.tensor_keys.successor_target] if self.has_successor else keys

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
            params: the critic's parameters; its own, when ``None``.
            target_params: used in the place of ``params`` when given.
            time_dim: the dimension of time.
            written: ``(*batch, T)``, what the critic writes at the root states, by whoever has run it there
                already. Not differentiated. A recurrent critic is run all the same.
            index: ``(*batch, T)``, for a ``written`` of distinct rows ``(D,)``: which of them each step's is.

        Returns:
            the same tensordict, with ``advantage`` and ``value_target``, ``(*batch, T, 1)``, and
            ``successor_target``, ``(*batch, T, E)``.

        Raises:
            ValueError: when the tensordict has no time dimension.
        """
        if tensordict.batch_dims < 1:
            raise ValueError(
                "USFEstimator: a rollout has at least the time dimension; got an empty batch size"
            )
        time_dim = self._get_time_dim(time_dim, tensordict)
        last = tensordict.batch_dims - 1
        data = tensordict if time_dim == last else tensordict.transpose(time_dim, last)
        if time_dim != last:
            index = None if index is None else index.transpose(time_dim, last)
            written = written if written is None or index is not None else written.transpose(time_dim, last)
        targets = self._targets(data, params if target_params is None else target_params, written, index)
        if time_dim != last:
            targets = targets.transpose(time_dim, last)
        return tensordict.update(targets)

    def value_estimate(
        self, tensordict: TensorDictBase, target_params: TensorDictBase | None = None, **_: Any
    ) -> Tensor:
        """The value targets alone; see :meth:`forward`.

        Args:
            tensordict: ``(*batch, T)``, not written.
            target_params: the critic's parameters; its own, when ``None``.

        Returns:
            ``(*batch, T, 1)``.
        """
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
        reward = data.get(("next", keys.reward))
        done = data.get(("next", keys.done))
        terminated = data.get(("next", keys.terminated), done)
        if not self.bootstrap_at_timeout:
            terminated = done
        mask = data.get(MASK_KEY, None)
        ended = _cut_at_padding(done, mask)

        wanted = [keys.value]
        if self.has_successor:
            wanted += [keys.successor_features, keys.state_embedding]
        with (
            contextlib.nullcontext()
            if params is None
            else params.to_module(self.value_network, preserve_module_state=False)
        ):
            root, following = evaluate_rollout(
                self.value_network, data, ended.any(-1), wanted, written, index, [keys.value]
            )
        value, next_value = root[0].to(reward.dtype), following[0].to(reward.dtype)
        if not self.has_successor:
            value_target = self._return(reward, next_value, ended, terminated)
        else:
            # reward and embedding (of s_{t+1} on: the paper's Eqs. 4 and 13 and its code, not its Eq. 6) are
            # summed by the same recursion
            ends = ended.any(-1, keepdim=True), terminated.any(-1, keepdim=True)
            value_target = self._return(reward, next_value, *ends)
            successor_target = self._return(
                following[2].to(reward.dtype), following[1].to(reward.dtype), *ends
            )
        advantage = value_target - value
        if self.normalize_advantage:
            advantage = _normalize(advantage, mask, self.min_advantage_std)
        targets = TensorDict({}, data.batch_size)
        targets.set(keys.advantage, advantage)
        targets.set(keys.value_target, value_target)
        if self.has_successor:
            targets.set(keys.successor_target, successor_target)
        return targets

    def _return(self, cumulant: Tensor, next_value: Tensor, done: Tensor, terminated: Tensor) -> Tensor:
        return lambda_return(cumulant, next_value, self.gamma, self.lmbda, done, terminated)


def _cut_at_padding(done: Tensor, mask: Tensor | None) -> Tensor:
    """``done``, and also where the next step of a row is padding."""
    if mask is None:
        return done
    mask = mask.reshape(*mask.shape[: done.ndim - 1], -1).any(-1, keepdim=True)
    padding_follows = torch.zeros_like(mask)
    padding_follows[..., :-1, :] = ~mask[..., 1:, :]
    return done | padding_follows


def _normalize(advantage: Tensor, mask: Tensor | None, min_std: float) -> Tensor:
    if mask is None:
        valid = advantage
    else:
        valid = advantage[mask.reshape(*mask.shape[: advantage.ndim - 1], -1).any(-1)]
    return (advantage - valid.mean()) / valid.std(correction=0).clamp_min(min_std)
