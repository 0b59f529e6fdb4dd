"""Settings of a training: one dataclass per group, with the type of every setting.

Each default is given once: in the YAML files beside this module, or here if all choices share it.
:mod:`vusfa.conf.schema` checks values against these types with OmegaConf. ``None`` stands for ``null``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

__all__ = [
    "ALGORITHMS",
    "LARGEST",
    "LOSS_TERMS",
    "MAX_STEPS",
    "POSITIVE",
    "AgentSettings",
    "ClusterSettings",
    "CollectorSettings",
    "EarlyStoppingSettings",
    "EntropySettings",
    "EnvSettings",
    "EvaluationSettings",
    "HindsightSettings",
    "LoggerSettings",
    "ObjectiveSettings",
    "OptimSettings",
    "Settings",
    "flat",
    "lazily",
]

#: Settings of every registered algorithm, by its name (:func:`vusfa.algorithms.register_algorithm`).
ALGORITHMS: dict[str, Any] = {}
#: Registered additional loss terms (:func:`vusfa.algorithms.register_loss_term`), with a coefficient of 0.
LOSS_TERMS: dict[str, float] = {}
#: Steps after which an episode is truncated, in training and evaluation, unless settings say otherwise.
MAX_STEPS = 500
#: Settings that a run uses as divisors, and a time limit.
POSITIVE = (
    "log_every",
    "checkpoint_every",
    "total_frames",
    "optim.horizon",
    "entropy.horizon",
    "collector.timeout",
    *(f"early_stopping.{name}" for name in ("success", "every", "episodes_per_goal", "max_steps")),
)
#: Largest value of settings by which threads and processes begin, or memory is taken at once.
LARGEST = {
    "threads": 1024,
    "collector.num_workers": 1024,
    "hindsight.capacity": 1 << 28,
    "hindsight.batch_size": 1 << 24,
    "algorithm.batch_size": 1 << 24,
    "algorithm.policy_pairs": 1 << 24,
    "algorithm.capacity": 1 << 28,
    "algorithm.horizon": 1 << 16,
}


@dataclass
class EnvSettings:
    """Settings of :class:`vusfa.envs.TargetNavEnv`; goals and crop may be of several types. The last
    three are those of :class:`vusfa.envs.SceneRotation`; ``active_scenes`` null: always all."""

    goals: Any
    goal_sampling: str
    crop: Any
    goal_reward: float
    step_reward: float
    collision_reward: float | None
    crop_dropout: float = 0.0
    max_steps: int = MAX_STEPS
    active_scenes: int | None = None
    scene_stay: int = 100_000
    scene_weights: dict[str, float] = field(default_factory=dict)


@dataclass
class AgentSettings:
    """Settings of :func:`vusfa.modules.make_agent`; null leaves a field to the architecture."""

    model: str
    architecture: str
    history: int | None
    embedding_size: int | None
    hidden_size: int | None
    observation: str | None
    encoder: str | None
    picture_size: list[int] | None
    normalize_features: bool | None
    normalize_embedding: bool | None
    shared_encoder: bool | None
    embedding_layer: bool | None
    state_layer: bool | None
    memory: str | None
    shared_heads: bool | None
    pretrained: str | None
    successor_norm: str | None
    rectify_logits: bool | None
    scale: str | None
    initial_scale: float | None
    eval_latent: str | None
    successor_scale: float | None
    reward_scale: float | None
    fusion: str | None = None  # later than version 0.2, whose checkpoints have neither
    previous_action: bool | None = None


@dataclass
class ObjectiveSettings:
    """Settings of USFLoss, USFEstimator and DualAscent of :mod:`vusfa.objectives`, and coefficients of
    further terms."""

    objective_coeff: float
    critic_coeff: float
    successor_coeff: float
    bottleneck_coeff: float
    bottleneck_step_size: float
    information_target: float
    bottleneck_on: str
    gamma: float
    lmbda: float
    normalize_advantage: bool
    min_advantage_std: float
    bootstrap_at_timeout: bool
    terms: dict[str, float]


@dataclass
class HindsightSettings:
    """Settings of ``algorithm=hindsight``."""

    updates: int
    batch_size: int
    capacity: int
    horizon: int
    own_future: float
    critic_coeff: float
    objective_coeff: float
    expectile: float
    temperature: float
    max_weight: float


@dataclass
class OptimSettings:
    """Settings of :func:`vusfa.training.make_optimizer`."""

    kind: str
    lr: float
    horizon: int | None
    max_grad_norm: float | None
    options: dict[str, Any]


@dataclass
class CollectorSettings:
    """Settings of :func:`vusfa.training.make_collector`; the last two are of ``collector=ray``."""

    kind: str
    num_envs: int
    rollout: int
    num_workers: int
    timeout: float | None = 300.0
    address: str | None = None
    resources: dict[str, float] = field(default_factory=dict)


@dataclass
class ClusterSettings:
    """Settings of :func:`vusfa.cli.ray_train.train_on_ray`; kind null: learn in this process."""

    kind: str | None = None
    workers: int = 2
    min_workers: int | None = None
    address: str | None = None
    resources: dict[str, float] = field(default_factory=dict)
    max_failures: int = 3


@dataclass
class LoggerSettings:
    """Settings of :func:`vusfa.training.make_loggers`."""

    kinds: list[str]
    project: str
    mode: str | None
    name: str | None
    entity: str | None = None
    group: str | None = None
    tags: list[str] = field(default_factory=list)


@dataclass
class EvaluationSettings:
    """Settings of the evaluation at the end, whose goals may be a word, a list of ids, or null; and of those
    during the training, whose interval is ``"auto"``, a number of frames, or null."""

    goals: Any
    episodes_per_goal: int
    interval: Any
    max_steps: int = MAX_STEPS


@dataclass
class EntropySettings:
    """Coefficient of the policy's entropy, linear in the frames."""

    start: float
    end: float
    horizon: int | None


@dataclass
class EarlyStoppingSettings:
    """Conditions for ending a training before ``total_frames``; success null: never."""

    success: float | None
    every: int
    episodes_per_goal: int
    max_steps: int


@dataclass
class Settings:
    """All settings of a training.

    ``autocast`` and ``lazy_scenes`` are true, false or ``"auto"``; ``scenes`` is a list, or one name.
    ``algorithm`` has the settings of the one chosen, see :data:`ALGORITHMS`. ``by_model`` holds numbers of
    presets that depend on the model.
    """

    env: EnvSettings
    agent: AgentSettings
    algorithm: Any
    objective: ObjectiveSettings
    hindsight: HindsightSettings
    optim: OptimSettings
    collector: CollectorSettings
    logger: LoggerSettings
    evaluation: EvaluationSettings
    entropy: EntropySettings
    early_stopping: EarlyStoppingSettings
    scenes: Any
    seed: int
    name: str
    folder: str | None
    total_frames: int
    device: str
    threads: int
    autocast: Any
    log_every: int
    checkpoint_every: int
    resume: str | None
    overwrite: bool
    by_model: dict[str, Any] = field(default_factory=dict)
    skip_broken_scenes: bool = False
    lazy_scenes: Any = "auto"
    cluster: ClusterSettings = field(default_factory=ClusterSettings)


def lazily(settings: Mapping[str, Any]) -> bool | None:
    """The argument ``lazy`` of :meth:`vusfa.scenes.SceneSet.open` that settings ask for; None: by the number
    of files.

    >>> lazily({"lazy_scenes": "auto"}), lazily({"lazy_scenes": True}), lazily({})
    (None, True, None)
    """
    lazy = settings.get("lazy_scenes")
    return lazy if isinstance(lazy, bool) else None


def flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings as one level with dotted names.

    >>> flat({"optim": {"lr": 0.1}, "seed": 1})
    {'optim.lr': 0.1, 'seed': 1}
    """
    result: dict[str, Any] = {}
    for key, value in settings.items():
        if isinstance(value, Mapping):
            result |= flat(value, f"{prefix}{key}.")
        else:
            result[f"{prefix}{key}"] = value
    return result
