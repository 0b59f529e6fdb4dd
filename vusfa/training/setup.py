"""Construction of a trainer from settings, for recipes, experiments and benchmarks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import BaseCollector

from vusfa.algorithms import make_algorithm, threads_per_step
from vusfa.conf.settings import LARGEST, lazily
from vusfa.envs import SceneObservation, SceneRotation, resolve_goals
from vusfa.envs.observation import crop_index
from vusfa.envs.rotation import Rotation
from vusfa.envs.scene_env import usable_device
from vusfa.errors import ConfigError
from vusfa.limits import brief
from vusfa.modules import Agent, make_agent
from vusfa.scenes import SceneSet
from vusfa.training.active_heads import ActiveHeads
from vusfa.training.checkpoint import load_checkpoint
from vusfa.training.collectors import check_goals_dealt, make_collector, make_env, rows_per_worker
from vusfa.training.hogwild import HogwildTrainer
from vusfa.training.memory import keep_memory
from vusfa.training.optimization import make_optimizer
from vusfa.training.precision import resolve_autocast
from vusfa.training.ranks import Ranks, settings_of_rank
from vusfa.training.trainer import Trainer
from vusfa.training.upgrade import upgrade_config

__all__ = ["decide_autocast", "make_observation", "make_trainer", "row_name", "set_threads"]


def make_trainer(
    settings: Mapping[str, Any],
    overrides: Sequence[str] = (),
    scenes: SceneSet | None = None,
    ranks: Ranks | None = None,
) -> Trainer:
    """Make a trainer from the settings of ``vusfa train``.

    Args:
        settings: as in vusfa/conf/train.yaml, plain and resolved.
        overrides: the command line that made them, kept in checkpoints.
        scenes: the world; opened as the settings say when not given.
        ranks: of a data-parallel training (:mod:`vusfa.training.distributed`), which the trainer belongs to.

    Raises:
        VusfaError: settings that are out of range or do not fit each other.
    """
    ranks = ranks or Ranks()
    torch.manual_seed(settings["seed"])
    device, optim = usable_device(settings["device"]), settings["optim"]
    if not isinstance(settings["autocast"], bool):
        settings = {**settings, "autocast": decide_autocast(settings)}
    if scenes is None:
        skip_broken = settings.get("skip_broken_scenes", False)
        scenes = SceneSet.open(settings["scenes"], skip_broken, lazily(settings))
        settings = {**settings, "scenes": list(scenes.sources)}  # what a folder or a pattern stood for
    goals = resolve_goals(scenes, settings["env"]["goals"])
    task = {**settings["env"], "goals": goals}
    rotation = make_rotation(task, settings["seed"])
    turns = None if rotation is None else Rotation(rotation, scenes, goals)
    num_goals = len(goals) if turns is None else turns.rows_needed
    check_goals_dealt(num_goals, settings["collector"]["num_envs"], task["goal_sampling"])
    counts = ("kind", "num_envs", "num_workers", "rollout")
    rows_per_worker(**{name: settings["collector"][name] for name in counts})  # refused before any work
    chosen = {key: value for key, value in settings["agent"].items() if value is not None}
    agent = make_agent(scenes=scenes, **chosen).to(device)
    own = settings if ranks.size == 1 else settings_of_rank(settings, ranks.size)
    algorithm = make_algorithm(settings["algorithm"]["name"], agent, scenes, own)
    optimizer = make_optimizer(
        algorithm.parameters(),
        optim["kind"],
        optim["lr"],
        optim["max_grad_norm"],
        threads=threads_per_step(settings),
        **optim["options"],
    )
    note = None if settings["resume"] else algorithm.prepare()
    if ranks.size > 1:
        algorithm.share_statistics(ranks.mean)
    crop, dropout = task.pop("crop"), task.pop("crop_dropout", 0.0)
    if not 0 <= dropout <= 255 / 256:
        raise ConfigError(f"env.crop_dropout is {dropout}; give a number from 0 to 255/256")
    if dropout and (agent.config["observation"], agent.config["encoder"]) != ("index", "mlp"):
        raise ConfigError(
            f"env.crop_dropout is {dropout}: only an agent that looks features up by ids sees it; give 0"
        )
    observation = make_observation(agent, scenes, crop)
    transforms = [*([observation] if observation is not None else []), *agent.make_env_transforms()]
    env = partial(make_env, scenes, transforms, history=agent.config["history"], device=device, **task)
    if rotation is not None:
        env = partial(env, rotation=rotation, frames_per_step=settings["collector"]["num_envs"])

    def collector(policy: TensorDictModuleBase) -> BaseCollector:
        # of a resumed training the frames are known by now
        turned = {} if rotation is None else {"first_frame": trainer.frames}
        made = make_collector(
            make_env=partial(env, **turned),
            policy=policy,
            seed=settings["seed"],
            autocast=settings["autocast"],
            first_goal=ranks.rank * own["collector"]["num_envs"],
            **own["collector"],
        )
        ranks.seed(made, settings["seed"] + trainer.frames)
        return made

    parts: dict[str, Any] = {
        "scenes": scenes,
        "goals": goals,
        "agent": agent,
        "algorithm": algorithm,
        "optimizer": optimizer,
        "settings": settings,
        "overrides": overrides,
        "observation": observation if crop == "first" else make_observation(agent, scenes),
        "note": note,
        "ranks": ranks,
    }
    if turns is not None and turns.rotates and agent.num_scenes > 1:
        if settings["collector"]["kind"] == "hogwild" or ranks.size > 1:
            what = "collector=hogwild" if ranks.size == 1 else "a training of several ranks"
            raise ConfigError(
                f"{what} shares the heads of all scenes, of which env.active_scenes would lend each process"
                " some; give agent.shared_heads=true"
            )
        if settings["collector"]["kind"] == "single":
            parts["heads"] = ActiveHeads(agent, optimizer)
    if settings["collector"]["kind"] == "hogwild":
        return HogwildTrainer(make_env=env, **parts)
    trainer = Trainer(make_collector=collector, **parts)
    return trainer


def make_rotation(task: dict[str, Any], seed: int) -> SceneRotation | None:
    """Take the settings of a rotation of scenes out of those of ``env``; None where all are active.

    >>> make_rotation({"active_scenes": 4, "scene_stay": 1000}, seed=0)
    SceneRotation(active=4, stay=1000, seed=0, weights={})
    """
    chosen = {"active_scenes": "active", "scene_stay": "stay", "scene_weights": "weights"}
    given = {argument: task.pop(name) for name, argument in chosen.items() if name in task}
    return SceneRotation(seed=seed, **given) if given.get("active") is not None else None


def decide_autocast(settings: Mapping[str, Any]) -> bool:
    """Decide whether to compute in bfloat16; a resumed training keeps its precision by default.

    Args:
        settings: as in vusfa/conf/train.yaml, plain and resolved.

    Raises:
        VusfaError: a setting that makes no sense, a device or a checkpoint that cannot be used.

    >>> decide_autocast({"autocast": False, "device": "cpu"})
    False
    """
    setting = settings["autocast"]
    if setting == "auto" and settings["resume"]:
        setting = load_checkpoint(settings["resume"])["config"]["autocast"]
    return resolve_autocast(setting, usable_device(settings["device"]))


def make_observation(agent: Agent, scenes: SceneSet, crop: str = "first") -> SceneObservation | None:
    """Make the transform that adds the observations of an agent that reads features or pixels; None for one
    that reads ids.

    Args:
        agent: the agent.
        scenes: the world.
        crop: of :class:`~vusfa.envs.SceneObservation`, for features; checked for an agent that reads ids.

    >>> scenes = SceneSet.bundled(["bathroom"])
    >>> make_observation(make_agent("gvf", scenes=scenes, observation="features"), scenes).kind
    'features'
    """
    kind = agent.config["observation"]
    if kind == "index":
        if crop_index(crop, scenes.num_crops) != 0 and scenes.is_lazy:
            raise ConfigError(
                f"env.crop is {crop}: an agent that reads ids sees other crops of scenes in memory only; give"
                " fewer scenes, or env.crop=first"
            )
        return None
    if kind == "features":
        return SceneObservation(scenes, "features", crop=crop)
    return SceneObservation(scenes, "pixels", size=tuple(agent.config["picture_size"]))


def row_name(settings: Mapping[str, Any]) -> str:
    """Name of a trained agent in tables: its model, what it reads or remembers that is not the default, and
    whether it learned with hindsight.

    >>> row_name({"agent": {"model": "vusfa"}, "algorithm": {"name": "hindsight"}})
    'vusfa + hindsight'
    >>> row_name({"agent": {"model": "vusfa", "memory": "lstm"}, "algorithm": {"name": "usf"}})
    'vusfa, LSTM'
    >>> row_name({"agent": {"model": "gvf"}})  # of version 0.1, from before there was hindsight
    'gvf'
    """
    settings = upgrade_config(settings)
    agent, algorithm = settings["agent"], settings["algorithm"]["name"]
    learns_pictures = agent.get("encoder") == "conv" or agent.get("observation") == "pixels"
    parts = {
        "LSTM": agent.get("memory") == "lstm",
        "pixels": learns_pictures,
        "autoencoder": agent.get("pretrained") == "autoencoder",
    }
    name = ", ".join([agent["model"], *(part for part, present in parts.items() if present)])
    return name if algorithm in ("usf", "autoencoder") else f"{name} + {algorithm.replace('_', ' ')}"


def set_threads(threads: int) -> None:
    """Set the number of processor threads that torch uses in this process, and have it keep its memory
    (:func:`~vusfa.training.memory.keep_memory`).

    Raises:
        ConfigError: fewer than one, or more than any machine has.

    >>> before = torch.get_num_threads()
    >>> set_threads(1)
    >>> torch.get_num_threads()
    1
    >>> set_threads(before)
    """
    if not 1 <= threads <= LARGEST["threads"]:
        raise ConfigError(f"threads is {brief(threads)}; give 1 to {LARGEST['threads']:,}")
    torch.set_num_threads(threads)
    keep_memory()
