"""From settings to a training that stands ready: what recipes and benchmarks share."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.collectors import BaseCollector

from vusfa.envs import SceneObservation, resolve_goals
from vusfa.errors import ConfigError
from vusfa.modules import (
    ActingPolicy,
    Agent,
    StateGoalPairs,
    frozen,
    make_agent,
    pretrain_autoencoder,
    sees_one_frame,
)
from vusfa.objectives import DualAscent, RewardRegressionLoss
from vusfa.objectives.hindsight import HindsightLoss
from vusfa.scenes import SceneSet
from vusfa.training.collectors import check_goals_dealt, make_collector, make_env
from vusfa.training.learning import annealed, descend, make_loss, make_optimiser, total_loss
from vusfa.training.replay import HindsightReplay
from vusfa.training.session import Session, make_observation, scene_sources, torch_device

__all__ = [
    "Hindsight",
    "Training",
    "make_hindsight",
    "make_pairs",
    "make_reward_regression",
    "make_training",
    "row_name",
]

#: Pairs of state and goal for each frame of a batch, up to which an agent's answers are written down.
PAIRS_A_FRAME = 3


@dataclass
class Hindsight:
    """Learning from what the agent walked, towards goals named in hindsight.

    Attributes:
        loss: of transitions and goals.
        replay: where both come from.
        updates: steps of the optimiser for each batch of the collector.
    """

    loss: HindsightLoss
    replay: HindsightReplay
    updates: int


@dataclass
class Training:
    """Parts that fit one another, and how one update goes.

    Attributes:
        session: what changes while the agent learns.
        actor: the policy that walks; writes ``action``.
        observation: what stands between world and agent, or None.
        make_collector: without arguments.
        precision: context to compute in.
        multiplier: of the bottleneck's constraint, if there is one.
        hindsight: if the agent learns so, too.
        reward: regression of the reward, if reward weights learn by it.
        acting: what walks for the actor, where that has no memory.
        pairs: all that the collector may ask it, where that is written down before each batch.
        reconstructed: share of the features' variance that a pretrained encoder explains.
        settings: plain.
    """

    session: Session
    actor: TensorDictModuleBase
    observation: SceneObservation | None
    make_collector: Callable[[], BaseCollector]
    precision: Callable[[], AbstractContextManager]
    multiplier: DualAscent | None
    hindsight: Hindsight | None
    settings: Mapping[str, Any]
    reward: RewardRegressionLoss | None = None
    acting: ActingPolicy | None = None
    pairs: StateGoalPairs | None = None
    reconstructed: float | None = None

    def collect(self, batches: Iterator[TensorDictBase]) -> TensorDictBase:
        """The collector's next batch, on its own."""
        with self.session.encoded_once(self.precision):
            return self._next(batches)

    def _next(self, batches: Iterator[TensorDictBase]) -> TensorDictBase:
        with self.precision(), ExitStack() as stack:
            if self.acting is not None and self.pairs is not None:
                stack.enter_context(self.acting.tabulated(self.pairs))
            return next(batches)

    def update(self, batches: Iterator[TensorDictBase]) -> tuple[TensorDictBase, dict[str, Tensor]]:
        """Collect, compute returns and losses, step the optimiser (with hindsight several times).

        Args:
            batches: the collector's.

        Returns:
            the batch, and the numbers to log: the loss's terms and the gradient's norm.
        """
        session, optim = self.session, self.settings["optim"]
        lr = annealed(session.frames, optim["lr"], optim["horizon"])
        session.loss.entropy_coeff = annealed(session.frames, **self.settings["entropy"])
        later: dict[str, Tensor] = {}
        with session.encoded_once(self.precision):
            batch = self._next(batches)
            with self.precision():  # another one: autocast keeps weights that it converted without gradients
                terms = session.loss(batch)
                if self.reward is not None:
                    terms.update(self.reward(batch))
            total = total_loss(session.loss, terms)
            if self.hindsight is not None:
                self.hindsight.replay.extend(batch)
                later, own = self._look_back()
                total = total + own
        norm = descend(session.optimiser, total, lr, optim["max_grad_norm"])
        if self.multiplier is not None:
            self.multiplier.step()
        for _ in range(self.hindsight.updates - 1 if self.hindsight is not None else 0):
            with ExitStack() as stack:
                with self.precision():
                    stack.enter_context(frozen(session.agent, grad=True))
                later, own = self._look_back()
            descend(session.optimiser, own, lr, optim["max_grad_norm"])
        return batch, {**terms, **later, "grad_norm": norm}

    def _look_back(self) -> tuple[dict[str, Tensor], Tensor]:
        assert self.hindsight is not None
        with self.precision():
            terms = self.hindsight.loss(self.hindsight.replay.sample())
        return dict(terms.items()), total_loss(self.hindsight.loss, terms)


def make_training(
    settings: Mapping[str, Any], overrides: Sequence[str] = (), scenes: SceneSet | None = None
) -> Training:
    """All parts of a training, from the settings of ``recipes/train.py``.

    Args:
        settings: as in vusfa/conf/train.yaml, plain and resolved.
        overrides: the command line that made them, for whoever resumes.
        scenes: the world; opened as the settings say when not given.

    Raises:
        VusfaError: settings that make no sense, in words.
    """
    torch.manual_seed(settings["seed"])
    device, optim = torch_device(settings["device"]), settings["optim"]
    scenes = SceneSet.open(settings["scenes"]) if scenes is None else scenes
    goals = resolve_goals(scenes, settings["env"]["goals"])
    check_goals_dealt(len(goals), settings["collector"]["num_envs"], settings["env"]["goal_sampling"])
    given = {key: value for key, value in settings["agent"].items() if value is not None}
    agent = make_agent(scenes=scenes, **given).to(device)
    actor, critic = agent.get_policy_operator(out_keys=["action"]), agent.get_value_operator()
    objective = {key: value for key, value in settings["objective"].items() if key != "reward_coeff"}
    loss, _, multiplier = make_loss(actor, critic, entropy_coeff=settings["entropy"]["start"], **objective)
    reward = make_reward_regression(critic, settings["objective"].get("reward_coeff", 0.0))
    optimiser = make_optimiser(
        agent.parameters(), optim["kind"], optim["lr"], optim["max_grad_norm"], **optim["options"]
    )
    reconstructed = None
    if agent.config["pretrained"] and not settings["resume"]:
        reconstructed = pretrain_autoencoder(agent, seed=settings["seed"])
    saved = {"config": settings, "overrides": overrides, "sources": scene_sources(settings["scenes"])}
    hindsight = make_hindsight(settings, agent, scenes)
    session = Session(scenes, goals, agent, loss.to(device), optimiser, saved)
    session.replay = None if hindsight is None else hindsight.replay
    task = {**settings["env"], "goals": goals}
    observation = make_observation(agent, scenes, task.pop("crop"))
    transforms = [*([observation] if observation is not None else []), *agent.make_env_transforms()]
    env = partial(make_env, scenes, transforms, history=agent.config["history"], device=device, **task)
    acting = None if agent.memory is not None else ActingPolicy(agent)
    collector = partial(
        make_collector,
        make_env=env,
        policy=actor if acting is None else acting,
        seed=settings["seed"],
        autocast=settings["autocast"],
        **settings["collector"],
    )
    precision = partial(torch.autocast, device.type, torch.bfloat16, enabled=settings["autocast"])
    return Training(
        session,
        actor,
        observation,
        collector,
        precision,
        multiplier,
        hindsight,
        settings,
        reward,
        acting,
        make_pairs(settings, agent, scenes, goals),
        reconstructed,
    )


def row_name(settings: Mapping[str, Any]) -> str:
    """What a trained agent is called in tables: its model, what it reads or remembers that is not the
    default, and whether it learned with hindsight.

    >>> row_name({"agent": {"model": "vusfa"}, "hindsight": {"updates": 10}})
    'vusfa + hindsight'
    >>> row_name({"agent": {"model": "vusfa", "memory": "lstm"}})
    'vusfa, LSTM'
    >>> row_name({"agent": {"model": "gvf"}})  # from before there was hindsight
    'gvf'
    """
    agent, updates = settings["agent"], settings.get("hindsight", {}).get("updates", 0)
    learns_pictures = agent.get("encoder") == "conv" or agent.get("observation") == "pixels"
    told = {
        "LSTM": agent.get("memory") == "lstm",
        "pixels": learns_pictures,
        "autoencoder": agent.get("pretrained") == "autoencoder",
    }
    name = ", ".join([agent["model"], *(words for words, true in told.items() if true)])
    return f"{name} + hindsight" if updates else name


def make_pairs(
    settings: Mapping[str, Any], agent: Agent, scenes: SceneSet, goals: torch.Tensor
) -> StateGoalPairs | None:
    """What a collector may ask, where writing all answers down before each batch is the shorter way: for an
    agent of one frame in one process, and no more than :data:`PAIRS_A_FRAME` pairs for each frame of a batch.
    None elsewhere.

    A pair in a product of thousands costs a fraction of what it costs in a step's product of 64.
    """
    collector = settings["collector"]
    if not sees_one_frame(agent) or collector["kind"] != "single" or settings["hindsight"]["updates"]:
        return None
    pairs = StateGoalPairs(scenes, goals)
    frames = collector["num_envs"] * collector["rollout"]
    return pairs if len(pairs) <= PAIRS_A_FRAME * frames else None


def make_reward_regression(critic: TensorDictSequential, coeff: float) -> RewardRegressionLoss | None:
    """What ``objective.reward_coeff`` asks for; None for 0.

    Raises:
        ConfigError: the model has no reward weights.
    """
    if not coeff:
        return None
    try:
        return RewardRegressionLoss(critic, coeff)
    except ValueError as error:
        raise ConfigError(f"objective.reward_coeff is {coeff}: {error}; or give 0") from error


def make_hindsight(settings: Mapping[str, Any], agent: Agent, scenes: SceneSet) -> Hindsight | None:
    """What ``hindsight`` of the settings asks for; None for no updates.

    Raises:
        ConfigError: an agent, or a way to collect, that it does not fit.
    """
    chosen, task = dict(settings["hindsight"]), settings["env"]
    updates = chosen.pop("updates")
    if not updates:
        return None
    if agent.config["observation"] != "index" or agent.config["memory"] is not None:
        raise ConfigError(
            "hindsight names goals by their ids, to an agent that reads ids and has no memory; give"
            " agent.observation=index and agent.memory=null, or hindsight=none"
        )
    if settings["collector"]["kind"] == "multi_async":
        raise ConfigError(
            "hindsight follows each environment from batch to batch, which collector.kind=multi_async hands"
            " over in no fixed order; give single or multi_sync, or hindsight=none"
        )
    sizes = {key: chosen.pop(key) for key in ("capacity", "batch_size", "horizon", "own_future")}
    replay = HindsightReplay(scenes.num_states, settings["collector"]["num_envs"], **sizes)
    try:
        loss = HindsightLoss(
            agent.get_policy_operator(),
            agent.get_value_operator(),
            gamma=settings["objective"]["gamma"],
            goal_reward=task["goal_reward"],
            step_reward=task["step_reward"],
            **chosen,
        )
    except ValueError as error:
        raise ConfigError(f"hindsight: {error}") from error
    return Hindsight(loss, replay, updates)
