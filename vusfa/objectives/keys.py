"""The tensordict entries that the loss and its estimator read and write, renamed by their ``set_keys``."""

from __future__ import annotations

from dataclasses import dataclass

from tensordict.nn import composite_lp_aggregate
from tensordict.utils import NestedKey
from torchrl.objectives.value import ValueEstimatorBase

__all__ = ["EstimatorKeys", "LossKeys"]


@dataclass
class EstimatorKeys(ValueEstimatorBase._AcceptedKeys):
    """Entries of :class:`~vusfa.objectives.USFEstimator`.

    Attributes:
        advantage: where the advantage is written.
        value_target: where the value's target is written.
        value: the value, which the critic writes.
        successor_features: psi, which the critic writes.
        state_embedding: phi, which the critic writes.
        successor_target: where psi's target is written.
        reward: under ``"next"``.
        done: under ``"next"``.
        terminated: under ``"next"``.
        steps_to_next_obs: of TorchRL's estimators; not read by ours.
        sample_log_prob: of TorchRL's estimators; not read by ours.

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
    """Entries of :class:`~vusfa.objectives.USFLoss`; those that its estimator has too are passed on to it.

    Attributes:
        advantage: the advantage; computed when absent.
        value_target: the value's target.
        value: the value, which the critic writes.
        successor_features: psi, which the critic writes.
        successor_target: psi's target.
        state_embedding: phi, which the critic writes.
        state_loc: mean of the state's latent, which the critic writes.
        state_scale: its scale.
        goal_loc: mean of the goal's latent, which the critic writes.
        goal_scale: its scale.
        state_kl: divergence of the state's latent from N(0, 1), summed over its features, where the critic
            writes it; computed from mean and scale where not.
        goal_kl: that of the goal's latent.
        action: the action taken, or a list of keys for a composite action.
        reward: under ``"next"``.
        done: under ``"next"``.
        terminated: under ``"next"``.
        sample_log_prob: log-probability of the action when it was taken, for estimators that correct for its
            age (TorchRL's ``VTrace``).

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
