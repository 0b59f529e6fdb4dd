"""Training updates as ``recipes/train.py`` makes them, one at a time, without files and log lines.

The settings are the recipe's own, composed from ``recipes/conf`` as its command line would, and the calls are
the recipe's: what is measured is what a user gets. ``tests/benchmarks/test_trainer.py`` holds the two to one
another, weight for weight.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from benchmarks.report import Options
from vusfa.envs import resolve_goals
from vusfa.modules import make_agent
from vusfa.scenes import SceneSet
from vusfa.training import (
    Session,
    annealed,
    descend,
    make_collector,
    make_env,
    make_loss,
    make_observation,
    make_optimiser,
    scene_sources,
    torch_device,
    total_loss,
)
from vusfa.training.launch import compose

__all__ = ["CONF", "Trainer", "make_trainer", "recipe_settings", "small"]

CONF = Path(__file__).parents[1] / "recipes" / "conf"


def recipe_settings(overrides: Sequence[str] = ()) -> DictConfig:
    """The settings of ``python recipes/train.py OVERRIDES``, resolved.

    >>> recipe_settings(["agent.history=1"]).agent.history
    1
    """
    cfg = compose(CONF, "train", list(overrides))
    OmegaConf.resolve(cfg)
    return cfg


class Trainer:
    """One training, update by update.

    Args:
        cfg: the recipe's settings, see :func:`recipe_settings`.
        scenes: the world; opened as the settings say when not given.

    Attributes:
        session: the recipe's, with agent, loss, optimiser, frames and meters.
        batches: the collector's.
    """

    def __init__(self, cfg: DictConfig, scenes: SceneSet | None = None) -> None:
        self.cfg = cfg
        torch.manual_seed(cfg.seed)
        plain: dict[str, Any] = OmegaConf.to_container(cfg, resolve=True)  # type: ignore[assignment]
        self._plain, device = plain, torch_device(cfg.device)
        self._half = partial(torch.autocast, device.type, torch.bfloat16, enabled=cfg.autocast)
        scenes = SceneSet.open(cfg.scenes) if scenes is None else scenes
        goals = resolve_goals(scenes, plain["env"]["goals"])
        given = {key: value for key, value in plain["agent"].items() if value is not None}
        agent = make_agent(scenes=scenes, **given).to(device)
        actor, critic = agent.get_policy_operator(out_keys=["action"]), agent.get_value_operator()
        loss, _, self._multiplier = make_loss(
            actor, critic, entropy_coeff=plain["entropy"]["start"], **plain["objective"]
        )
        optim = plain["optim"]
        optimiser = make_optimiser(
            agent.parameters(), optim["kind"], optim["lr"], optim["max_grad_norm"], **optim["options"]
        )
        settings = {"config": plain, "overrides": [], "sources": scene_sources(cfg.scenes)}
        self.session = Session(scenes, goals, agent, loss.to(device), optimiser, settings)
        task = {**plain["env"], "goals": goals}
        observation = make_observation(agent, scenes, task.pop("crop"))
        transforms = [*([observation] if observation is not None else []), *agent.make_env_transforms()]
        env = partial(make_env, scenes, transforms, history=agent.config["history"], device=device, **task)
        collector = partial(
            make_collector,
            make_env=env,
            policy=actor,
            seed=cfg.seed,
            autocast=cfg.autocast,
            **plain["collector"],
        )
        self.actor = actor
        self._open = ExitStack()
        self.batches = self._open.enter_context(self.session.collecting(collector))

    @property
    def agent(self) -> torch.nn.Module:
        """What learns."""
        return self.session.agent

    def collect(self) -> int:
        """Collect one batch and throw it away; the frames it has."""
        with self.session.encoded_once(self._half), self._half():
            return next(self.batches).numel()

    def update(self) -> int:
        """Collect, compute returns and loss, step the optimiser; the frames that it took."""
        session, optim = self.session, self._plain["optim"]
        before = session.frames
        lr = annealed(before, optim["lr"], optim["horizon"])
        session.loss.entropy_coeff = annealed(before, **self._plain["entropy"])
        with session.encoded_once(self._half):
            with self._half():
                batch = next(self.batches)
            with self._half():
                terms = session.loss(batch)
        norm = descend(session.optimiser, total_loss(session.loss, terms), lr, optim["max_grad_norm"])
        if self._multiplier is not None:
            self._multiplier.step()
        session.count(batch, {**terms, "grad_norm": norm}, 0.0)
        return session.frames - before

    def close(self) -> None:
        """End the collector's processes."""
        self._open.close()


def make_trainer(overrides: Sequence[str] = (), scenes: SceneSet | None = None) -> Trainer:
    """A training with the recipe's settings and what is said otherwise.

    >>> trainer = make_trainer(["scenes=[bathroom]", "agent.hidden_size=8", "agent.embedding_size=8"])
    >>> trainer.update() == trainer.cfg.collector.num_envs * trainer.cfg.collector.rollout
    True
    >>> trainer.close()
    """
    return Trainer(recipe_settings(overrides), scenes)


def small(options: Options) -> list[str]:
    """What the options change of the recipe's settings: all tiny with ``--quick``, then what was given."""
    if not options.quick:
        return list(options.overrides)
    sizes = ["agent.hidden_size=16", "agent.embedding_size=16"]
    return ["scenes=[bathroom]", *sizes, "collector.num_envs=8", "collector.rollout=4", *options.overrides]
