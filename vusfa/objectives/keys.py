"""The tensordict entries that USFLoss and its estimator read and write, renamed by their ``set_keys``."""

from __future__ import annotations

from dataclasses import dataclass

from tensordict.nn import composite_lp_aggregate
from tensordict.utils import NestedKey
from torchrl.objectives.value import ValueEstimatorBase

__all__ = ["EstimatorKeys", "LossKeys"]


@dataclass
class EstimatorKeys(ValueEstimatorBase._AcceptedKeys):
    """Entries of :class:`~vusfa.objectives.USFEstimator`.

    The critic writes ``value``, ``successor_features`` (psi) and ``state_embedding`` (phi); the estimator
    writes ``advantage``, ``value_target`` and ``successor_target``; ``reward``, ``done`` and ``terminated``
    are read under ``"next"``. TorchRL's estimators also read the last two; this one does not.

    >>> EstimatorKeys(value="v").value
    'v'
    """

    # TorchRL looks keys up in this very class, so those of its parent are repeated
    advantage: NestedKey = "advantage"
    value_target: NestedKey = "value_target"
    value: NestedKey = "state_value"
    successor_features: NestedKey = "successor_features"
    state_embedding: NestedKey = "state_embedding"
    successor_target: NestedKey = "successor_target"
    reward: NestedKey = "reward"
    done: NestedKey = "done"
    terminated: NestedKey = "terminated"
    steps_to_next_obs: NestedKey = "steps_to_next_obs"
    sample_log_prob: NestedKey | None = None


@dataclass
class LossKeys:
    """Entries of :class:`~vusfa.objectives.USFLoss`, which passes on those that its estimator has, too.

    Attributes:
        advantage, value_target, successor_target: targets; computed where the advantage is absent.
        value, successor_features, state_embedding: V, psi and phi, which the critic writes.
        state_loc, state_scale, goal_loc, goal_scale: mean and scale of the latents, which the critic writes.
        state_kl, goal_kl: divergence of each latent from N(0, 1), summed over its features, where the critic
            writes it; else computed from mean and scale.
        action: the action taken, or a list of keys for a composite action.
        reward, done, terminated: under ``"next"``.
        sample_log_prob: log-probability of the action when it was taken, which TorchRL's ``VTrace`` reads.

    >>> LossKeys(value="v").value
    'v'
    """

    advantage: NestedKey = "advantage"
    value_target: NestedKey = "value_target"
    value: NestedKey = "state_value"
    successor_features: NestedKey = "successor_features"
    successor_target: NestedKey = "successor_target"
    state_embedding: NestedKey = "state_embedding"
    state_loc: NestedKey = "state_loc"
    state_scale: NestedKey = "state_scale"
    goal_loc: NestedKey = "goal_loc"
    goal_scale: NestedKey = "goal_scale"
    state_kl: NestedKey = "state_kl"
    goal_kl: NestedKey = "goal_kl"
    action: NestedKey | list[NestedKey] = "action"
    reward: NestedKey = "reward"
    done: NestedKey = "done"
    terminated: NestedKey = "terminated"
    sample_log_prob: NestedKey | list[NestedKey] | None = None

    def __post_init__(self) -> None:
        if self.sample_log_prob is None:
            aggregate = composite_lp_aggregate(nowarn=True)
            self.sample_log_prob = "sample_log_prob" if aggregate else "action_log_prob"
