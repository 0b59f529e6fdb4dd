"""The base of off-policy losses of a value and a policy towards named goals."""

from __future__ import annotations

from typing import ClassVar, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

from vusfa.objectives.network_loss import NetworkLoss

__all__ = ["GoalLoss", "weighted_mean"]


class GoalLoss(NetworkLoss):
    """Base of losses with a critic's term and a policy's term, of rows that count or do not; the arguments
    are those of :class:`~vusfa.objectives.SearchLoss`."""

    #: Names of the critic's and of the policy's term, and of the entries for logging.
    terms: ClassVar[tuple[str, str]]
    logged: ClassVar[tuple[str, ...]]
    _schedulable_buffers = frozenset({"critic_coeff", "objective_coeff"})

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        critic_network: TensorDictModuleBase,
        *,
        critic_coeff: float | None = 1.0,
        objective_coeff: float | None = 1.0,
        gamma: float = 0.95,
        goal_reward: float = 1.0,
        step_reward: float = -0.01,
        reduction: Literal["none", "mean", "sum"] | None = "mean",
        functional: bool = True,
    ) -> None:
        if not 0 < gamma < 1:
            raise ValueError(f"{type(self).__name__}: gamma is {gamma}; give a number between 0 and 1")
        networks = {"actor_network": actor_network, "critic_network": critic_network}
        super().__init__(networks, reduction=reduction, functional=functional)
        self._register_coefficients(critic_coeff=critic_coeff, objective_coeff=objective_coeff)
        self.gamma, self.goal_reward, self.step_reward = gamma, goal_reward, step_reward

    def check(self) -> None:
        """Raise where the critic lacks an entry; ``forward`` does so, too."""
        self._check_written("value")

    def _default_out_keys(self) -> list[NestedKey]:
        coefficients = self.critic_coeff, self.objective_coeff
        present = [term for term, one in zip(self.terms, coefficients, strict=True) if one is not None]
        return [*present, *self.logged]

    def _counted(self, tensordict: TensorDictBase, counts: Tensor) -> Tensor:
        """Which rows (*batch,) bool count and are not hidden by a mask."""
        valid = self._valid(tensordict, counts)
        return counts if valid is None else counts & valid

    def _value(self, written: TensorDictBase) -> Tensor:
        """V, (*batch,), float32 or more."""
        value = written.get(self.tensor_keys.value).squeeze(-1)
        return value.to(torch.promote_types(value.dtype, torch.float32))

    def _weighted(self, coefficient: Tensor, values: Tensor, weight: Tensor) -> Tensor:
        if self.reduction == "mean":
            return weighted_mean(coefficient, values, weight)
        # select, not multiply: what a mask hides may be infinite
        values = coefficient * (weight * torch.where(weight > 0, values, 0.0))
        return values if self.reduction == "none" else values.sum()


def weighted_mean(coefficient: float | Tensor, values: Tensor, weight: Tensor) -> Tensor:
    """The weighted mean, times a coefficient; 0 where every weight is 0."""
    total = (weight * torch.where(weight > 0, values, 0.0)).sum()
    return coefficient * total / weight.sum().clamp(min=torch.finfo(weight.dtype).tiny)
