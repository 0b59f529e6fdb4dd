"""Algorithm: what is learned from a batch, as the trainer sees it.

The trainer (:mod:`vusfa.training`) collects, asks for losses, steps the optimizer, and names no algorithm; an
algorithm names no collector, file or logger. A new one is a subclass and one line of registration::

    @register_algorithm("mine")
    class Mine(Algorithm):
        def losses(self, batch):
            return {"loss_mine": ...}

``examples/extending/algorithm.py`` is a complete one.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from tensordict import TensorDictBase
from torch import Tensor, nn

from vusfa.algorithms.schedule import threads_per_step
from vusfa.modules import Agent
from vusfa.scenes import SceneSet

__all__ = ["Algorithm", "AlgorithmSettings"]


@dataclass
class AlgorithmSettings:
    """Settings of an algorithm; a subclass adds its own numbers, with their defaults.

    Attributes:
        name: under which it is registered.
    """

    name: str


class Algorithm:
    """Losses of an agent, and what belongs to them.

    Each update of the trainer is: :meth:`schedule`, collect, :meth:`losses` and one optimizer step,
    :attr:`replay_steps` times :meth:`replay_losses` and one optimizer step, :meth:`after_step`; the same for
    further :meth:`minibatches`, without replay. A loss is an
    entry whose name begins with ``loss_``; these are added up. Other entries are logged.

    Args:
        agent: what learns.
        scenes: its world.
        settings: all settings of the training; an algorithm's own are ``settings["algorithm"]``.

    Raises:
        ConfigError: settings or an agent that it does not fit; a subclass checks them in ``__init__``.

    Attributes:
        replay_steps: further optimizer steps per batch.
        threads: environments per optimizer step, each of which counts as one update of the optimizer; None
            for one update per batch.
    """

    #: Class of its settings; Hydra's ConfigStore gets it under the registered name.
    Settings: ClassVar[type[AlgorithmSettings]] = AlgorithmSettings
    replay_steps: int = 0

    def __init__(self, agent: Agent, scenes: SceneSet, settings: Mapping[str, Any]) -> None:
        self.agent, self.scenes, self.settings = agent, scenes, settings
        self.threads = threads_per_step(settings)

    def parameters(self) -> Iterable[nn.Parameter]:
        """Everything that the optimizer moves: the agent's parameters, and those of networks of its own."""
        return self.agent.parameters()

    def prepare(self) -> str | None:
        """Work before the first batch of a new training (not of a resumed one); returns a line to print."""
        return None

    def schedule(self, frames: int) -> None:
        """Sets what depends on the number of frames trained on, such as a coefficient."""

    def minibatches(self, batch: TensorDictBase) -> Sequence[TensorDictBase]:
        """Parts of a batch, (num_envs, T), each of which gets an optimizer step of its own, in this order.

        The whole batch, but with ``optim=a3c`` groups of as many environments as a step stands for.
        """
        return (batch,) if self.threads is None else batch.split(self.threads)

    def losses(self, batch: TensorDictBase) -> Mapping[str, Tensor]:
        """Terms of a collector's batch, (num_envs, T); scalars."""
        raise NotImplementedError

    def replay_losses(self) -> Mapping[str, Tensor]:
        """Terms of one further step: from a replay buffer, or of the batch once more; scalars."""
        raise NotImplementedError

    def after_step(self) -> None:
        """Follows the last optimizer step of an update: a multiplier's step, target networks."""

    def state_dict(self) -> dict[str, Any]:
        """What it has learned besides the agent, as tensors and plain data."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from what :meth:`state_dict` gave."""
        self.warm_start(state)

    def warm_start(self, state: Mapping[str, Any]) -> None:
        """Takes from a ``state_dict`` what belongs to the agent's weights, such as a multiplier, and nothing
        that belongs to the run, such as a replay buffer: for an agent that learns another task."""
