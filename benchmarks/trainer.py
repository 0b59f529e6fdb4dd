"""Updates of the trainer that ``vusfa train`` makes, one at a time, without files and log lines.

The settings are the recipe's own, composed from ``vusfa/conf`` as its command line would:
``tests/benchmarks/test_trainer.py`` compares the weights of both.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase

from benchmarks.report import Options
from vusfa.cli.launch import compose
from vusfa.scenes import SceneSet
from vusfa.training import Trainer, make_trainer

__all__ = ["Running", "apart", "recipe_settings", "running", "small"]


def recipe_settings(overrides: Sequence[str] = ()) -> DictConfig:
    """The settings of ``python recipes/train.py OVERRIDES``, resolved.

    >>> recipe_settings(["agent.history=1"]).agent.history
    1
    """
    cfg = compose(overrides=overrides)
    OmegaConf.resolve(cfg)
    return cfg


@dataclass
class Running:
    """A collecting trainer, as workloads to measure.

    Attributes:
        trainer: with the recipe's settings.
        batches: its collector's.
    """

    trainer: Trainer
    batches: Iterator[TensorDictBase]

    def collect(self) -> int:
        """Collect one batch and drop it; return its frames."""
        return self.trainer.collect(self.batches).numel()

    def update(self) -> int:
        """Make one update; return its frames."""
        return self.trainer.update(self.batches)[0].numel()


@contextmanager
def running(overrides: Sequence[str] = (), scenes: SceneSet | None = None) -> Iterator[Running]:
    """A trainer with the recipe's settings but for the overrides; its processes end with the context.

    >>> with running(["scenes=[bathroom]", "agent.hidden_size=8", "agent.embedding_size=8"]) as ours:
    ...     ours.update() == 256 * 50
    True
    """
    settings: Any = OmegaConf.to_container(recipe_settings(overrides))
    trainer = make_trainer(settings, scenes=scenes)
    with trainer.collecting() as batches:
        yield Running(trainer, batches)


def apart(function: Callable[..., Any], *arguments: object) -> Any:
    """Compute a function's result in a process of its own."""
    context = multiprocessing.get_context("forkserver")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(function, *arguments).result()


def small(options: Options) -> list[str]:
    """Overrides of the recipe's settings: tiny sizes with ``--quick``, then those of the options."""
    if not options.quick:
        return list(options.overrides)
    sizes = ["agent.hidden_size=16", "agent.embedding_size=16"]
    return ["scenes=[bathroom]", *sizes, "collector.num_envs=8", "collector.rollout=4", *options.overrides]
