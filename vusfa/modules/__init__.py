"""The networks of the models, as TensorDictModules.

>>> from vusfa.modules import make_agent
>>> from vusfa.scenes import SceneSet
>>> agent = make_agent(model="vusfa", architecture="controlled", scenes=SceneSet.bundled())
>>> agent.get_value_operator().out_keys[-1]
'state_value'
"""

from vusfa.deprecated import moved_names
from vusfa.modules.agents import Agent, make_agent
from vusfa.modules.autoencoder import explained_features, pretrain_autoencoder
from vusfa.modules.bottleneck import GaussianBottleneck, LatentSampler, gaussian_kl
from vusfa.modules.config import ARCHITECTURES, MODELS, AgentConfig, Model, register_model, resolve_config
from vusfa.modules.correlation import CorrelationTrunk, PartCorrelation
from vusfa.modules.draws import action_probs, draw, draw_actions
from vusfa.modules.episodic import TriedActions
from vusfa.modules.frames import FeatureFrames, PictureFrames
from vusfa.modules.inference import InferencePolicy, TabularPolicy
from vusfa.modules.linear import HistoryLinear, SceneLinear
from vusfa.modules.policy import PolicyHead, SuccessorPolicyHead
from vusfa.modules.previous_action import ActionInput, PreviousAction
from vusfa.modules.siamese import SiameseEncoder
from vusfa.modules.successor import RewardHead, SuccessorHead, SuccessorValue, ValueHead
from vusfa.modules.transplanting import transplant
from vusfa.modules.trunk import Fusion, SceneLayer
from vusfa.modules.unique import gather, unique_rows
from vusfa.modules.upgrade import upgrade_agent_config, upgrade_agent_state

__all__ = [
    "ARCHITECTURES",
    "MODELS",
    "ActionInput",
    "Agent",
    "AgentConfig",
    "CorrelationTrunk",
    "FeatureFrames",
    "Fusion",
    "GaussianBottleneck",
    "HistoryLinear",
    "InferencePolicy",
    "LatentSampler",
    "Model",
    "PartCorrelation",
    "PictureFrames",
    "PolicyHead",
    "PreviousAction",
    "RewardHead",
    "SceneLayer",
    "SceneLinear",
    "SiameseEncoder",
    "SuccessorHead",
    "SuccessorPolicyHead",
    "SuccessorValue",
    "TabularPolicy",
    "TriedActions",
    "ValueHead",
    "action_probs",
    "draw",
    "draw_actions",
    "explained_features",
    "gather",
    "gaussian_kl",
    "make_agent",
    "pretrain_autoencoder",
    "register_model",
    "resolve_config",
    "transplant",
    "unique_rows",
    "upgrade_agent_config",
    "upgrade_agent_state",
]

__getattr__ = moved_names(
    __name__,
    {
        "PRESETS": "vusfa.modules.ARCHITECTURES",
        "ActingPolicy": "vusfa.modules.InferencePolicy",
        "action_chances": "vusfa.modules.action_probs",
    },
)
