"""Agents: the layers of one model, and the actor and critic made of them."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from typing import Any

from tensordict import NestedKey
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictModule,
    TensorDictSequential,
)
from torch import Tensor, nn
from torch.distributions import Categorical
from torchrl.data import Unbounded
from torchrl.envs.transforms import InitTracker, TensorDictPrimer, Transform

from vusfa.deprecated import moved_names
from vusfa.errors import ConfigError
from vusfa.modules.bottleneck import GaussianBottleneck, LatentSampler
from vusfa.modules.config import AgentConfig, resolve_config
from vusfa.modules.correlation import CorrelationTrunk, make_correlation
from vusfa.modules.frames import FeatureFrames, PictureFrames, picture_table
from vusfa.modules.policy import PolicyHead, SuccessorPolicyHead
from vusfa.modules.previous_action import ActionInput, PreviousAction
from vusfa.modules.siamese import SiameseEncoder
from vusfa.modules.steps import Actor, Moved, Observing, Remembering, Step
from vusfa.modules.successor import RewardHead, SuccessorHead, SuccessorValue, ValueHead
from vusfa.modules.trunk import Fusion, SceneLayer, SiameseTrunk
from vusfa.scenes import Home, check_scenes

__all__ = ["Agent", "make_agent"]


def make_agent(model: str, architecture: str = "controlled", scenes: Any = None, **overrides: Any) -> Agent:
    """Build one of the models.

    Args:
        model: ``"gvf"`` (Zhu et al. 2017), ``"usfa"``, ``"sfdp"``, ``"vusfa"``, or a registered name.
        architecture: ``"controlled"`` (the models differ only in the named ideas), ``"paper"`` (the text) or
            ``"reference"`` (the released code with its quirks).
        scenes: the :class:`vusfa.scenes.SceneSet` to live in; it gives the features, and one head per scene
            unless ``shared_heads=True``.
        overrides: fields of :class:`~vusfa.modules.config.AgentConfig`, such as ``history=1`` or
            ``memory="lstm"``.

    Raises:
        ConfigError: an unknown model, architecture, field or value.

    >>> import torch
    >>> from vusfa.scenes import SceneSet
    >>> agent = make_agent("usfa", scenes=SceneSet.bundled(["bathroom"]), history=2, hidden_size=64)
    >>> agent.config["history"], sum(p.numel() for p in agent.parameters()) > 0
    (2, True)
    """
    if "preset" in overrides:
        warnings.warn(
            "make_agent's preset is called architecture since version 0.2; the old name goes with 0.3",
            DeprecationWarning,
            stacklevel=2,
        )
        architecture = overrides.pop("preset")
    config = resolve_config(model, architecture, **overrides)
    if scenes is None:
        raise ConfigError(
            "make_agent needs scenes=...; SceneSet.bundled() gives the four that come with the package"
        )
    check_scenes(scenes)
    return (config.ideas.agent or Agent)(config, scenes)


class Agent(nn.Module):
    """One model: its layers, and the actor and critic made of them.

    Actor and critic are built of the same TensorDictModule objects where they agree (encoder, fusion, scene
    layer, psi), so that a loss that recognizes them runs the trunk once.

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
        config: see :func:`~vusfa.modules.config.resolve_config`.
        scenes: a ``SceneSet``.

    Attributes:
        config: plain dict, from which ``make_agent`` rebuilds the agent in the same scenes.
        num_scenes: scenes that the heads hold weights of; 1 with shared heads.
        home: what it takes for granted of scenes; actor and critic know it, too.
        scene_slots: (n,) int64, where those of each scene are; None in order. See
            :class:`~vusfa.modules.SceneLinear`.
    """

    scene_slots: Tensor | None = None

    def __init__(self, config: AgentConfig, scenes: Any) -> None:
        super().__init__()
        self.config = _plain(config, scenes)
        self.num_scenes: int = 1 if config.shared_heads else scenes.num_scenes
        hidden = config.hidden_size
        self.encoder = self.make_encoder(config, scenes)
        self.encoder.requires_grad_(config.pretrained is None)
        self.fusion = Fusion(config.embedding_size, hidden)
        self.correlation = make_correlation(scenes, hidden) if config.fusion == "correlation" else None
        self.scene_layer = SceneLayer(self.num_scenes, hidden, hidden)
        self.latent = LatentSampler(config.eval_latent) if config.ideas.bottleneck else None
        self.successor, self.reward, self.value = self.make_value(config)
        self.policy: nn.Module = self.make_policy(config, scenes.num_actions)
        self.action_input = ActionInput(scenes.num_actions, hidden) if config.previous_action else None
        self.memory = nn.LSTM(hidden, hidden, batch_first=True) if config.memory == "lstm" else None
        self._steps = self.make_steps(config)  # a plain dict: the layers are children under the names above
        self.home = _home(self.config, scenes)
        for step in self._steps.values():
            step.home = self.home

    @property
    def is_tabular(self) -> bool:
        """Whether the actions depend on the ids of one state and one goal alone.

        >>> from vusfa.scenes import SceneSet
        >>> make_agent("gvf", scenes=SceneSet.bundled(["bathroom"])).is_tabular
        False
        """
        config = self.config
        return config["history"] == 1 and config["observation"] == "index" and config["memory"] is None

    def make_encoder(self, config: AgentConfig, scenes: Any) -> SiameseEncoder:
        """phi; reads states and goals, see :class:`~vusfa.modules.siamese.SiameseEncoder`."""
        by_id = config.observation == "index"
        frames: FeatureFrames | PictureFrames
        if config.encoder == "conv":
            frames = PictureFrames(picture_table(scenes) if by_id else None, config.picture_size)
        else:
            frames = FeatureFrames(scenes.features, lookup=by_id, normalize=config.normalize_features)
        return SiameseEncoder(
            frames,
            config.history,
            config.hidden_size,
            config.embedding_size if config.embedding_layer else None,
            shared=config.shared_encoder,
            state_layer=config.state_layer,
            by_id=by_id,
            bottleneck=GaussianBottleneck(config.scale, config.initial_scale)
            if config.ideas.bottleneck
            else None,
            normalize=config.normalize_embedding,
            deduplicate=config.deduplicate,
        )

    def make_value(self, config: AgentConfig) -> tuple[nn.Module | None, nn.Module | None, nn.Module]:
        """psi, omega and what makes a value of them; or none, none and a value of the hidden state."""
        size, hidden = config.embedding_size, config.hidden_size
        if not config.ideas.successor_value:
            return None, None, ValueHead(self.num_scenes, hidden)
        successor = SuccessorHead(self.num_scenes, hidden, size, config.successor_scale)
        return successor, RewardHead(size, hidden, config.reward_scale), SuccessorValue()

    def make_policy(self, config: AgentConfig, num_actions: int) -> nn.Module:
        """Logits of what :meth:`policy_keys` name."""
        plain = PolicyHead(self.num_scenes, config.hidden_size, num_actions)  # drawn by all: seeds stay equal
        if not config.ideas.successor_policy:
            return plain
        return SuccessorPolicyHead(
            self.num_scenes,
            config.hidden_size,
            config.embedding_size,
            num_actions,
            successor_norm=config.successor_norm,
            rectify_logits=config.rectify_logits,
        )

    def policy_keys(self, config: AgentConfig) -> list[str]:
        """Entries that the policy reads, in the order of its arguments."""
        return ["hidden", *(["successor_features"] if config.ideas.successor_policy else []), "scene_id"]

    def make_steps(self, config: AgentConfig) -> dict[str, Step]:
        """The layers by name, in the order of computation, with the entries that they read and write."""
        read = (
            ["state_id", "goal_id"] if config.observation == "index" else ["observation", "goal_observation"]
        )
        gaussian = ["state_loc", "state_scale", "state_kl", "goal_loc", "goal_scale", "goal_kl"]
        written = ["state_embedding", "goal_embedding", *(gaussian if self.latent else []), "fused"]
        if self.correlation is None:
            trunk = SiameseTrunk(self.encoder, self.fusion)
        else:
            trunk = CorrelationTrunk(self.encoder, self.fusion, self.correlation)
        steps: dict[str, Step] = {"trunk": Observing(trunk, read, written)}
        fused = "fused"
        if self.action_input is not None:
            steps["action_input"] = Moved(self.action_input, [fused, "previous_action"], ["acted"])
            fused = "acted"
        if self.memory is not None:
            steps["memory"] = Remembering(lstm=self.memory, in_key=fused, out_key="remembered")
            fused = "remembered"
        steps["scene_layer"] = Step(self.scene_layer, [fused, "scene_id"], ["hidden"])
        if self.successor is not None:
            steps["successor"] = Step(self.successor, ["hidden", "scene_id"], ["successor_features"])
            goal = "goal_embedding"
            if self.latent is not None:
                goal = "goal_latent"
                steps["latent"] = Step(self.latent, ["goal_loc", "goal_scale"], [goal])
            steps["reward"] = Step(self.reward, [goal], ["reward_weights"])
            read_by_value = ["successor_features", "reward_weights"]
        else:
            read_by_value = ["hidden", "scene_id"]
        steps["value"] = Step(self.value, read_by_value, ["state_value"])
        steps["policy"] = Step(self.policy, self.policy_keys(config), ["logits"])
        return steps

    def actor_steps(self) -> list[Step]:
        """Steps that lead from observations to ``logits``."""
        return self._steps_to("logits")

    def critic_steps(self) -> list[Step]:
        """Steps that lead from observations to ``state_value``."""
        return self._steps_to("state_value")

    def _steps_to(self, key: str) -> list[Step]:
        needed, chosen = {key}, []
        for step in reversed(self._steps.values()):
            if needed & set(step.out_keys):
                needed |= set(step.in_keys)
                chosen.append(step)
        return chosen[::-1]

    def get_policy_operator(self, out_keys: Sequence[NestedKey] = ("action", "action_log_prob")) -> Actor:
        """The actor. It computes psi only if its policy head reads it.

        Args:
            out_keys: what it leaves in the tensordict, besides an LSTM's state. Few by default, because all
                of it travels through collectors; ``get_dist`` and losses see everything in any case.
        """
        sampler = ProbabilisticTensorDictModule(
            in_keys=["logits"],
            out_keys=["action"],
            distribution_class=Categorical,
            distribution_kwargs={"validate_args": False},
            default_interaction_type=InteractionType.RANDOM,
            return_log_prob="action_log_prob" in out_keys,
            log_prob_key="action_log_prob",
        )
        recurrent = self._steps["memory"].out_keys[1:] if self.memory is not None else []
        return Actor(*self.actor_steps(), sampler, selected_out_keys=[*out_keys, *recurrent])

    def get_value_operator(self) -> TensorDictSequential:
        """The critic; it leaves every key it writes, ``state_value`` the last."""
        return TensorDictSequential(*self.critic_steps())

    def make_env_transforms(self) -> list[Transform]:
        """What an environment must add to its observations: nothing, or an LSTM's start marks and state, and
        the action before where the agent reads it."""
        if self.memory is None:
            return []
        dtype = next(self.memory.parameters()).dtype
        shape = (self.memory.num_layers, self.memory.hidden_size)
        states = {key: Unbounded(shape, dtype=dtype) for key in self._steps["memory"].in_keys[1:3]}
        acted = [] if self.action_input is None else [PreviousAction(self.config["num_actions"])]
        return [InitTracker(), TensorDictPrimer(states, expand_specs=True), *acted]


def _home(config: dict[str, Any], scenes: Any) -> Home:
    return Home(
        names=tuple(config["scenes"]),
        fingerprint=config["fingerprint"],
        num_actions=config["num_actions"],
        feature_size=None if config["encoder"] == "conv" else scenes.feature_size,
        reads_ids=config["observation"] == "index",
        heads_per_scene=not config["shared_heads"],
    )


def _plain(config: AgentConfig, scenes: Any) -> dict[str, Any]:
    plain = dataclasses.asdict(config)
    plain["picture_size"] = list(config.picture_size)
    if config.deduplicate:  # a way to compute, not part of what was learned
        del plain["deduplicate"]
    plain["scenes"] = list(scenes.names)
    plain["fingerprint"] = scenes.fingerprint
    plain["num_actions"] = scenes.num_actions
    return plain


__getattr__ = moved_names(__name__, {"transplant": "vusfa.modules.transplant"})
