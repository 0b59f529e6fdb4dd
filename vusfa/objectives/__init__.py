"""What is learned: losses, returns, and the optimiser and multiplier of the paper's code."""

from vusfa.objectives.functional import (
    dual_ascent,
    explained_variance,
    gaussian_kl,
    information_bottleneck,
    lambda_return,
    n_step_return,
    policy_gradient_loss,
    successor_loss,
    successor_return,
)
from vusfa.objectives.optim import DualAscent, TFRMSprop
from vusfa.objectives.returns import USFEstimator
from vusfa.objectives.usf import USFLoss

__all__ = [
    "DualAscent",
    "TFRMSprop",
    "USFEstimator",
    "USFLoss",
    "dual_ascent",
    "explained_variance",
    "gaussian_kl",
    "information_bottleneck",
    "lambda_return",
    "n_step_return",
    "policy_gradient_loss",
    "successor_loss",
    "successor_return",
]
