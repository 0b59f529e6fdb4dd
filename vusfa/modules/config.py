"""Models, which differ in three ideas, and architectures, which set the fields of :class:`AgentConfig`."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable
from typing import Any, Literal, NamedTuple

from vusfa.errors import ConfigError, near
from vusfa.limits import MAX_CONV_SIDE, MAX_UNITS, brief

__all__ = ["ARCHITECTURES", "MODELS", "AgentConfig", "Model", "register_model", "resolve_config"]


class Model(NamedTuple):
    """The ideas of a model.

    Attributes:
        successor_value: V = psi . omega instead of a linear value head.
        successor_policy: SFDP: the policy reads (detached) psi too.
        bottleneck: embeddings are Gaussians, omega reads a sample of the goal's.
        agent: subclass of :class:`~vusfa.modules.Agent` that builds it; None for that class itself.
    """

    successor_value: bool
    successor_policy: bool
    bottleneck: bool
    agent: Callable[[AgentConfig, Any], Any] | None = None


#: The four models of the paper's Table 1, and those of :func:`register_model`.
MODELS: dict[str, Model] = {
    #             psi . omega  SFDP   bottleneck
    "gvf": Model(False, False, False),
    "usfa": Model(True, False, False),
    "sfdp": Model(True, True, False),
    "vusfa": Model(True, True, True),
}

#: What an architecture sets, for all models (``"*"``) and then for one; else AgentConfig's default holds.
ARCHITECTURES: dict[str, dict[str, dict[str, Any]]] = {
    # The four models differ only in the ideas of MODELS. The five settings below are not the paper's: with
    # them all four models learn (docs/training.md).
    "controlled": {
        "*": {
            "normalize_features": True,
            "normalize_embedding": True,
            "successor_norm": "layer",
            "successor_scale": 100.0,
            "reward_scale": 1e-3,
        },
        "vusfa": {"initial_scale": 0.1},
    },
    # The paper's text, which does not say how a scale is made. The GVF baseline is that of Zhu et al., whose
    # encoder is one layer.
    "paper": {"*": {}, "gvf": {"embedding_layer": False}, "vusfa": {"eval_latent": "sample"}},
    # The released code, quirks included.
    "reference": {
        "*": {},
        "gvf": {"embedding_layer": False},
        "usfa": {"shared_encoder": False},
        "sfdp": {},
        "vusfa": {"history": 1, "state_layer": True, "scale": "raw", "rectify_logits": True},
    },
}

#: Fields that neither the paper nor its code knows: changing them would make those architectures a lie.
_OURS_ALONE = (
    "normalize_features",
    "normalize_embedding",
    "successor_norm",
    "successor_scale",
    "reward_scale",
    "initial_scale",
    "shared_heads",
    "pretrained",
    "fusion",
    "previous_action",
)


@dataclasses.dataclass(frozen=True)
class AgentConfig:
    """All that shapes an agent, besides its scenes.

    Attributes:
        model: a name of :data:`MODELS`.
        architecture: a name of :data:`ARCHITECTURES`.
        history: frames H that the encoder reads; 1 with ``memory="lstm"`` unless given.
        embedding_size: E, size of phi, psi and omega.
        hidden_size: outputs of every other layer.
        observation: what the agent reads: ``"index"`` (``state_id``, ``goal_id``), or ``"features"`` or
            ``"pixels"`` (``observation``, ``goal_observation``).
        encoder: ``"mlp"`` on precomputed features, or ``"conv"``: three convolutions on pictures.
        picture_size: height and width that the convolutions see, pixels.
        normalize_features: bring each feature to mean 0, deviation 1 over the scenes' states.
        normalize_embedding, shared_encoder, state_layer: see :class:`~vusfa.modules.SiameseEncoder`.
        embedding_layer: a linear layer behind the encoder's first; without it E must equal ``hidden_size``.
        fusion: ``"concatenation"`` of the embeddings of state and goal, or ``"correlation"``: the features'
            parts are compared, too (:class:`~vusfa.modules.PartCorrelation`).
        memory: ``"lstm"``: a recurrent layer behind the fusion of state and goal.
        previous_action: it also reads the action before (:class:`~vusfa.modules.PreviousAction`).
        shared_heads: all scenes share the weights behind the fusion, and which scene it is is not read;
            :func:`~vusfa.modules.transplant` takes such an agent to other scenes.
        pretrained: ``"autoencoder"``: constant encoder of :func:`~vusfa.modules.pretrain_autoencoder`.
        successor_norm, rectify_logits: see :class:`~vusfa.modules.SuccessorPolicyHead`.
        successor_scale, reward_scale: factors on the outputs of the layers of psi and omega.
        scale, initial_scale: see :class:`~vusfa.modules.GaussianBottleneck`.
        eval_latent: what omega reads in evaluation mode: the ``"mean"`` of z_g or a ``"sample"``.
        deduplicate: encode each distinct state and goal of a batch once. ``False`` encodes row by row, to the
            same numbers up to rounding, as is done in any case while compiling, exporting and under
            ``torch.vmap``: no shape then depends on a value.
    """

    model: str
    architecture: str = "controlled"
    history: int = 4
    embedding_size: int = 512
    hidden_size: int = 512
    observation: Literal["index", "features", "pixels"] = "index"
    encoder: Literal["mlp", "conv"] = "mlp"
    picture_size: tuple[int, int] = (60, 80)
    normalize_features: bool = False
    normalize_embedding: bool = False
    shared_encoder: bool = True
    embedding_layer: bool = True
    state_layer: bool = False
    fusion: Literal["concatenation", "correlation"] = "concatenation"
    memory: Literal["lstm"] | None = None
    previous_action: bool = False
    shared_heads: bool = False
    pretrained: Literal["autoencoder"] | None = None
    successor_norm: Literal["layer"] | None = None
    successor_scale: float = 1.0
    reward_scale: float = 1.0
    rectify_logits: bool = False
    scale: Literal["softplus", "raw"] = "softplus"
    initial_scale: float | None = None
    eval_latent: Literal["mean", "sample"] = "mean"
    deduplicate: bool = True

    @property
    def ideas(self) -> Model:
        """The model's row of :data:`MODELS`."""
        return MODELS[self.model]


def register_model(name: str, model: Model) -> Model:
    """Add a model to :data:`MODELS`, under a name that ``make_agent`` and the setting ``agent.model`` take.

    Args:
        name: not taken yet.
        model: its ideas, and the agent class that builds it.

    Raises:
        ConfigError: the name is taken by another model.

    >>> _ = register_model("usfa again", Model(True, False, False))
    >>> MODELS.pop("usfa again").successor_value
    True
    """
    if MODELS.get(name, model) != model:
        raise ConfigError(f"there is a model {name!r} already; register yours under another name")
    MODELS[name] = model
    return model


def resolve_config(model: str, architecture: str = "controlled", **overrides: Any) -> AgentConfig:
    """The configuration of a model in an architecture, with fields overridden.

    Raises:
        ConfigError: an unknown model, architecture, field or value; fields that contradict each other; a
            field that the paper's architectures do not have.

    >>> config = resolve_config("vusfa", "reference")
    >>> config.history, config.scale, config.state_layer
    (1, 'raw', True)
    >>> resolve_config("vusfa", histroy=1)
    Traceback (most recent call last):
    ...
    vusfa.errors.ConfigError: make_agent knows no field 'histroy'; did you mean 'history'?
    """
    _check_choice("model", model, MODELS)
    _check_choice("architecture", architecture, ARCHITECTURES)
    fields = [field.name for field in dataclasses.fields(AgentConfig)][2:]
    for name in overrides:
        if name not in fields:
            raise ConfigError(f"make_agent knows no field {name!r}; {near(name, fields)}")
    settings = {**ARCHITECTURES[architecture]["*"], **ARCHITECTURES[architecture].get(model, {})}
    if architecture != "controlled":
        for name in _OURS_ALONE:
            if overrides.get(name, settings.get(name, _default(name))) != settings.get(name, _default(name)):
                raise ConfigError(
                    f"{name} is no part of architecture {architecture!r}; use architecture='controlled' to"
                    " change it"
                )
    if overrides.get("observation", "index") == "pixels":
        settings["encoder"] = "conv"
    if overrides.get("encoder", settings.get("encoder")) == "conv":
        settings["normalize_features"] = False  # it has none; asking for it is refused below
    if overrides.get("memory") is not None:
        settings["history"] = 1
    settings.update(overrides)
    if "picture_size" in settings:
        settings["picture_size"] = _two_sides(settings["picture_size"])
    return _checked(AgentConfig(model=model, architecture=architecture, **settings))


def _checked(config: AgentConfig) -> AgentConfig:
    for name, choices in (
        ("observation", ("index", "features", "pixels")),
        ("encoder", ("mlp", "conv")),
        ("fusion", ("concatenation", "correlation")),
        ("memory", (None, "lstm")),
        ("pretrained", (None, "autoencoder")),
        ("successor_norm", (None, "layer")),
        ("scale", ("softplus", "raw")),
        ("eval_latent", ("mean", "sample")),
    ):
        _check_choice(name, getattr(config, name), choices)
    for name in ("history", "embedding_size", "hidden_size"):
        value = getattr(config, name)
        if type(value) is not int or value < 1:
            raise ConfigError(f"{name} is {brief(value)}; it must be a whole number of 1 or more")
        if value > MAX_UNITS:
            raise ConfigError(f"{name} is {brief(value)}; it must be at most {MAX_UNITS:,}")
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if field.type == "bool" and type(value) is not bool:
            raise ConfigError(f"{field.name} is {brief(value)}; it must be True or False")
        if field.type.startswith("float") and not _is_finite(value) and value != field.default:
            raise ConfigError(f"{field.name} is {brief(value)}; it must be a finite number")
    if (config.observation, config.encoder) in (("features", "conv"), ("pixels", "mlp")):
        raise ConfigError(
            f"observation {config.observation!r} does not go with encoder {config.encoder!r};"
            " convolutions read 'pixels' or 'index', the mlp reads 'features' or 'index'"
        )
    if config.encoder == "conv" and config.normalize_features:
        raise ConfigError(
            "normalize_features is for precomputed features; the conv encoder has none, leave it out"
        )
    if config.fusion == "correlation" and config.encoder == "conv":
        raise ConfigError(
            "fusion='correlation' compares parts of precomputed features; the conv encoder has none, leave it"
            " out"
        )
    if config.previous_action and config.memory is None:
        raise ConfigError(
            "previous_action is for an agent that remembers; give memory='lstm', or leave it out"
        )
    if config.pretrained and (config.encoder, config.observation) != ("mlp", "index"):
        raise ConfigError(
            "pretrained='autoencoder' reconstructs the scenes' features; give observation='index'"
            " and encoder='mlp'"
        )
    if config.pretrained and (config.ideas.bottleneck or not config.shared_encoder):
        raise ConfigError(
            "pretrained='autoencoder' makes one code for states and goals, and no Gaussian; give"
            " shared_encoder=True and model='gvf', 'usfa' or 'sfdp'"
        )
    if not config.embedding_layer:
        if config.ideas.bottleneck:
            raise ConfigError(
                "embedding_layer is False, but the bottleneck's mean and scale come from that layer"
            )
        if config.embedding_size != config.hidden_size:
            raise ConfigError(
                f"embedding_size is {config.embedding_size} and hidden_size {config.hidden_size};"
                " without embedding_layer they must be equal"
            )
    return config


def _two_sides(size: Any) -> tuple[int, int]:
    try:
        height, width = (int(side) for side in size)
    except (TypeError, ValueError):
        raise ConfigError(f"picture_size is {brief(size)}; give height and width, such as [60, 80]") from None
    if max(height, width) > MAX_CONV_SIDE:
        raise ConfigError(f"picture_size is {brief(size)}; give at most {MAX_CONV_SIDE:,} pixels per side")
    return height, width


def _is_finite(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)


def _default(name: str) -> Any:
    return AgentConfig.__dataclass_fields__[name].default


def _check_choice(what: str, value: Any, choices: Iterable[Any]) -> None:
    if value not in choices:
        raise ConfigError(f"{what} is {brief(value)}; {near(value, choices)}")
