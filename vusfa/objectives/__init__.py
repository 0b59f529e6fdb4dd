"""What is learned: losses, returns, and the optimiser and multiplier of the paper's code."""

from vusfa.deprecated import moved_names
from vusfa.objectives.a3c import A3CRMSprop
from vusfa.objectives.functional import (
    dual_ascent,
    explained_variance,
    gaussian_kl,
    information_bottleneck,
    lambda_return,
    policy_gradient_loss,
    successor_loss,
    successor_return,
)
from vusfa.objectives.hindsight import HindsightLoss, expectile_loss, relabelled_target, walked_return
from vusfa.objectives.optim import DualAscent, TFRMSprop
from vusfa.objectives.returns import USFEstimator
from vusfa.objectives.reward import RewardRegressionLoss, reward_regression_loss
from vusfa.objectives.scores import ScoreLoss
from vusfa.objectives.search import SearchLoss, best_action_log_prob
from vusfa.objectives.usf import USFLoss

__all__ = [
    "A3CRMSprop",
    "DualAscent",
    "HindsightLoss",
    "RewardRegressionLoss",
    "ScoreLoss",
    "SearchLoss",
    "TFRMSprop",
    "USFEstimator",
    "USFLoss",
    "best_action_log_prob",
    "dual_ascent",
    "expectile_loss",
    "explained_variance",
    "gaussian_kl",
    "information_bottleneck",
    "lambda_return",
    "policy_gradient_loss",
    "relabelled_target",
    "reward_regression_loss",
    "successor_loss",
    "successor_return",
    "walked_return",
]

__getattr__ = moved_names(__name__, {})
