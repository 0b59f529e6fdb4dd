"""The four models, built from one table of differences.

>>> from vusfa.modules import make_agent
>>> from vusfa.scenes import SceneSet
>>> scenes = SceneSet.bundled(["bathroom"])
>>> agent = make_agent(model="vusfa", preset="controlled", scenes=scenes)
>>> actor, critic = agent.get_policy_operator(), agent.get_value_operator()
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

from tensordict import NestedKey
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import nn
from torch.distributions import Categorical
from torchrl.envs.transforms import InitTracker, Transform
from torchrl.modules import LSTMModule

from vusfa.errors import ConfigError
from vusfa.modules.bottleneck import GaussianEncoder, LatentSampler
from vusfa.modules.frames import FeatureFrames, PictureFrames, picture_table
from vusfa.modules.normalised import NormalisedEncoder
from vusfa.modules.policy import PolicyHead, SuccessorPolicyHead
from vusfa.modules.presets import AgentConfig, resolve_config
from vusfa.modules.siamese import SiameseEncoder
from vusfa.modules.successor import RewardHead, SuccessorHead, SuccessorValue, ValueHead
from vusfa.modules.trunk import Fusion, SceneLayer, SiameseTrunk

__all__ = ["Agent", "make_agent", "transplant"]


def make_agent(model: str, preset: str = "controlled", scenes: Any = None, **overrides: Any) -> Agent:
    """Builds one of the four models.

    Args:
        model: ``"gvf"`` (Zhu et al. 2017), ``"usfa"``, ``"sfdp"`` or ``"vusfa"``.
        preset: ``"controlled"`` (the models differ only in the named ideas), ``"paper"`` (the text) or
            ``"reference"`` (the released code with its quirks).
        scenes: the :class:`vusfa.scenes.SceneSet` to live in; it gives the features, and one head a scene
            unless ``shared_heads=True``.
        overrides: fields of :class:`~vusfa.modules.presets.AgentConfig`, such as ``history=1`` or
            ``memory="lstm"``.

    Raises:
        ConfigError: an unknown model, preset, field or value.

    >>> import torch
    >>> from vusfa.scenes import SceneSet
    >>> agent = make_agent("usfa", scenes=SceneSet.bundled(["bathroom"]), history=2, hidden_size=64)
    >>> agent.config["history"], sum(p.numel() for p in agent.parameters()) > 0
    (2, True)
    """
    config = resolve_config(model, preset, **overrides)
    if scenes is None:
        raise ConfigError(
            "make_agent needs scenes=...; SceneSet.bundled() gives the four that come with the package"
        )
    return Agent(config, scenes)


def transplant(agent: Agent, scenes: Any) -> Agent:
    """A copy of an agent with ``shared_heads`` that lives in other scenes, with the same weights.

    It looks at the new scenes as at those it was trained in: features are normalised by the mean and
    deviation of the TRAINING scenes, which are among its weights. For equal features it gives equal numbers.

    Args:
        agent: built with ``shared_heads=True``.
        scenes: a ``SceneSet`` with features of the same size and as many actions.

    Returns:
        an agent on the same device, training or evaluating as the given one does. No tensor is shared.

    Raises:
        ConfigError: the agent has heads of its own for each scene, or the scenes do not fit it.

    >>> from vusfa.scenes import SceneSet
    >>> home, other = SceneSet.bundled(["bathroom"]), SceneSet.bundled(["kitchen", "bedroom"])
    >>> agent = make_agent("vusfa", scenes=home, hidden_size=8, embedding_size=8, shared_heads=True)
    >>> transplant(agent, other).config["scenes"]
    ['kitchen', 'bedroom']
    """
    if not agent.config["shared_heads"]:
        raise ConfigError(
            "the agent has heads of its own for each scene; train one with agent.shared_heads=true to take"
            " it to other scenes"
        )
    if scenes.num_actions != agent.config["num_actions"]:
        raise ConfigError(
            f"the agent chooses among {agent.config['num_actions']} actions, the scenes have"
            f" {scenes.num_actions}"
        )
    fields = {field.name for field in dataclasses.fields(AgentConfig)}
    copy = make_agent(scenes=scenes, **{k: v for k, v in agent.config.items() if k in fields})
    try:
        copy.load_state_dict(agent.state_dict())
    except RuntimeError as error:
        first = str(error).splitlines()[-1].strip()
        raise ConfigError(f"the agent does not fit the scenes' features ({first})") from error
    return copy.to(next(agent.parameters()).device).train(agent.training)


class Agent(nn.Module):
    """One model: its layers, and the actor and critic made of them.

    Actor and critic are built of the SAME TensorDictModule objects where they agree (encoder, fusion,
    scene layer, psi), so that a loss that recognises them runs the trunk once.

    | key | shape | written by |
    |---|---|---|
    | ``state_embedding``, ``goal_embedding`` | (\\*B, E) | encoder; with a bottleneck the means |
    | ``state_loc``, ``state_scale``, ``goal_loc``, ``goal_scale`` | (\\*B, E) | encoder with a bottleneck |
    | ``state_kl``, ``goal_kl`` | (\\*B, 1) | the same: divergence from N(0, 1), summed over E, in nats |
    | ``fused`` | (\\*B, hidden_size) | encoder and fusion |
    | ``goal_latent`` | (\\*B, E) | bottleneck: z_g |
    | ``hidden`` | (\\*B, hidden_size) | scene layer |
    | ``successor_features``, ``reward_weights`` | (\\*B, E) | psi, omega |
    | ``state_value`` | (\\*B, 1) | critic |
    | ``logits``, ``action``, ``action_log_prob`` | (\\*B, A), (\\*B,), (\\*B,) | actor |

    Args:
        config: see :func:`~vusfa.modules.presets.resolve_config`.
        scenes: a ``SceneSet``.

    Attributes:
        config: plain dict of names, numbers and lists: ``make_agent`` rebuilds the agent from it and the
            scenes.
    """

    def __init__(self, config: AgentConfig, scenes: Any) -> None:
        super().__init__()
        self.config = _plain(config, scenes)
        ideas, size, hidden = config.ideas, config.embedding_size, config.hidden_size
        num_scenes = 1 if config.shared_heads else scenes.num_scenes
        self.encoder: nn.Module = _make_encoder(config, scenes)
        self.encoder.requires_grad_(config.pretrained is None)
        self.fusion = Fusion(size, hidden)
        self.scene_layer = SceneLayer(num_scenes, hidden, hidden)
        self.latent = LatentSampler(config.eval_latent) if ideas.bottleneck else None
        self.successor = (
            SuccessorHead(num_scenes, hidden, size, config.successor_scale) if ideas.successor_value else None
        )
        self.reward = RewardHead(size, hidden, config.reward_scale) if ideas.successor_value else None
        self.value = SuccessorValue() if ideas.successor_value else ValueHead(num_scenes, hidden)
        self.policy: nn.Module = PolicyHead(num_scenes, hidden, scenes.num_actions)
        if ideas.successor_policy:
            self.policy = SuccessorPolicyHead(
                num_scenes,
                hidden,
                size,
                scenes.num_actions,
                successor_norm=config.successor_norm,
                successor_gain=config.successor_gain,
                rectify_logits=config.rectify_logits,
            )
        self.memory = nn.LSTM(hidden, hidden, batch_first=True) if config.memory == "lstm" else None
        # Not registered as children: the layers are, once, under the names above.
        self.__dict__["_operators"] = self._wrap(config)

    def _wrap(self, config: AgentConfig) -> dict[str, TensorDictModuleBase]:
        by_id = config.observation == "index"
        read = ["state_id", "goal_id"] if by_id else ["observation", "goal_observation"]
        embeddings = ["state_embedding", "goal_embedding"]
        gaussian = ["state_loc", "state_scale", "state_kl", "goal_loc", "goal_scale", "goal_kl"]
        steps: dict[str, TensorDictModuleBase] = {}
        written = [*embeddings, *(gaussian if self.latent else []), "fused"]
        steps["trunk"] = TensorDictModule(SiameseTrunk(self.encoder, self.fusion), read, written)
        if self.memory is not None:
            steps["memory"] = LSTMModule(lstm=self.memory, in_key="fused", out_key="remembered")
        fused = "fused" if self.memory is None else "remembered"
        steps["scene_layer"] = TensorDictModule(self.scene_layer, [fused, "scene_id"], ["hidden"])
        if self.successor is not None:
            steps["successor"] = TensorDictModule(
                self.successor, ["hidden", "scene_id"], ["successor_features"]
            )
            if self.latent is not None:
                steps["latent"] = TensorDictModule(self.latent, ["goal_loc", "goal_scale"], ["goal_latent"])
            goal = "goal_embedding" if self.latent is None else "goal_latent"
            steps["reward"] = TensorDictModule(self.reward, [goal], ["reward_weights"])
            parts = ["successor_features", "reward_weights"]
            steps["value"] = TensorDictModule(self.value, parts, ["state_value"])
        else:
            steps["value"] = TensorDictModule(self.value, ["hidden", "scene_id"], ["state_value"])
        psi = ["successor_features"] if config.ideas.successor_policy else []
        steps["policy"] = TensorDictModule(self.policy, ["hidden", *psi, "scene_id"], ["logits"])
        return steps

    def _trunk(self) -> list[TensorDictModuleBase]:
        operators = self.__dict__["_operators"]
        return [operators[name] for name in ("trunk", "memory", "scene_layer") if name in operators]

    def get_policy_operator(
        self, out_keys: Sequence[NestedKey] = ("action", "action_log_prob")
    ) -> ProbabilisticTensorDictSequential:
        """The actor. It computes psi only if its policy head reads it.

        Args:
            out_keys: what it leaves in the tensordict; an LSTM's state is kept besides. Few by default,
                because everything kept travels through collectors. ``get_dist`` and losses see all of them
                in any case.
        """
        operators = self.__dict__["_operators"]
        head = [operators["successor"]] if isinstance(self.policy, SuccessorPolicyHead) else []
        sampler = ProbabilisticTensorDictModule(
            in_keys=["logits"],
            out_keys=["action"],
            distribution_class=Categorical,
            distribution_kwargs={"validate_args": False},
            default_interaction_type=InteractionType.RANDOM,
            return_log_prob="action_log_prob" in out_keys,
            log_prob_key="action_log_prob",
        )
        recurrent = [key for key in operators["memory"].out_keys[1:]] if self.memory is not None else []
        return ProbabilisticTensorDictSequential(
            *self._trunk(), *head, operators["policy"], sampler, selected_out_keys=[*out_keys, *recurrent]
        )

    def get_value_operator(self) -> TensorDictSequential:
        """The critic; it leaves every key it writes, ``state_value`` the last."""
        operators = self.__dict__["_operators"]
        heads = [operators[name] for name in ("successor", "latent", "reward", "value") if name in operators]
        return TensorDictSequential(*self._trunk(), *heads)

    def make_env_transforms(self) -> list[Transform]:
        """What an environment must add to its observations: nothing, or an LSTM's start marks and state."""
        if self.memory is None:
            return []
        return [InitTracker(), self.__dict__["_operators"]["memory"].make_tensordict_primer()]


def _make_encoder(config: AgentConfig, scenes: Any) -> nn.Module:
    by_id = config.observation == "index"
    frames: FeatureFrames | PictureFrames
    if config.encoder == "conv":
        frames = PictureFrames(picture_table(scenes) if by_id else None, config.picture_size)
    else:
        frames = FeatureFrames(scenes.features, lookup=by_id, normalise=config.normalise_features)
    bottleneck = config.ideas.bottleneck
    code_size = config.embedding_size * (2 if bottleneck else 1)
    encoder = SiameseEncoder(
        frames,
        config.history,
        config.hidden_size,
        code_size if config.embedding_layer else None,
        shared=config.shared_encoder,
        state_layer=config.state_layer,
        by_id=by_id,
    )
    embeddings: nn.Module = encoder
    if bottleneck:
        embeddings = GaussianEncoder(encoder, config.scale, config.initial_scale)
    return NormalisedEncoder(embeddings) if config.normalise_embedding else embeddings


def _plain(config: AgentConfig, scenes: Any) -> dict[str, Any]:
    plain = dataclasses.asdict(config)
    plain["picture_size"] = list(config.picture_size)
    plain["scenes"] = list(scenes.names)
    plain["fingerprint"] = scenes.fingerprint
    plain["num_actions"] = scenes.num_actions
    return plain
