"""Training updates as ``recipes/train.py`` makes them, one at a time, without files and log lines.

The settings are the recipe's own, composed from ``vusfa/conf`` as its command line would, and the calls are
the recipe's: what is measured is what a user gets. ``tests/benchmarks/test_trainer.py`` holds the two to one
another, weight for weight.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from benchmarks.report import Options
from vusfa.scenes import SceneSet
from vusfa.training import make_training
from vusfa.training.launch import compose

__all__ = ["CONF", "Trainer", "make_trainer", "recipe_settings", "small"]

from vusfa.conf import FOLDER as CONF


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
        plain: dict[str, Any] = OmegaConf.to_container(cfg, resolve=True)  # type: ignore[assignment]
        self._training = make_training(plain, scenes=scenes)
        self.session, self.actor = self._training.session, self._training.actor
        self._open = ExitStack()
        self.batches = self._open.enter_context(self.session.collecting(self._training.make_collector))

    @property
    def agent(self) -> torch.nn.Module:
        """What learns."""
        return self.session.agent

    def collect(self) -> int:
        """Collect one batch and throw it away; the frames it has."""
        return self._training.collect(self.batches).numel()

    def update(self) -> int:
        """Collect, compute returns and loss, step the optimiser; the frames that it took."""
        batch, terms = self._training.update(self.batches)
        self.session.count(batch, terms, 0.0)
        return batch.numel()

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
