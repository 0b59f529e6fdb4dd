"""The networks of the four models, as TensorDictModules.

>>> from vusfa.modules import make_agent
>>> from vusfa.scenes import SceneSet
>>> agent = make_agent(model="vusfa", preset="controlled", scenes=SceneSet.bundled())
>>> agent.get_value_operator().out_keys[-1]
'state_value'
"""

from vusfa.modules.acting import ActingPolicy, action_chances, action_logits, draw, draw_actions
from vusfa.modules.agents import Agent, make_agent, transplant
from vusfa.modules.autoencoder import explained_features, pretrain_autoencoder
from vusfa.modules.bottleneck import GaussianEncoder, LatentSampler
from vusfa.modules.episodic import TriedActions
from vusfa.modules.frames import FeatureFrames, PictureFrames
from vusfa.modules.freezing import frozen
from vusfa.modules.linear import HistoryLinear, SceneLinear
from vusfa.modules.normalised import NormalisedEncoder
from vusfa.modules.pairs import ActionTable, StateGoalPairs, sees_one_frame
from vusfa.modules.policy import PolicyHead, SuccessorPolicyHead
from vusfa.modules.presets import MODELS, PRESETS, AgentConfig, resolve_config
from vusfa.modules.siamese import SiameseEncoder
from vusfa.modules.successor import RewardHead, SuccessorHead, SuccessorValue, ValueHead
from vusfa.modules.trunk import Fusion, SceneLayer

__all__ = [
    "MODELS",
    "PRESETS",
    "ActingPolicy",
    "ActionTable",
    "Agent",
    "AgentConfig",
    "FeatureFrames",
    "Fusion",
    "GaussianEncoder",
    "HistoryLinear",
    "LatentSampler",
    "NormalisedEncoder",
    "PictureFrames",
    "PolicyHead",
    "RewardHead",
    "SceneLayer",
    "SceneLinear",
    "SiameseEncoder",
    "StateGoalPairs",
    "SuccessorHead",
    "SuccessorPolicyHead",
    "SuccessorValue",
    "TriedActions",
    "ValueHead",
    "action_chances",
    "action_logits",
    "draw",
    "draw_actions",
    "explained_features",
    "frozen",
    "make_agent",
    "pretrain_autoencoder",
    "resolve_config",
    "sees_one_frame",
    "transplant",
]
