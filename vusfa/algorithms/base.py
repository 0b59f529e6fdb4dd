"""Algorithm: what is learned from a batch.

The trainer (:mod:`vusfa.training`) collects, asks for losses, steps the optimizer, and names no algorithm; an
algorithm names no collector, file or logger. A new one is a subclass and one line of registration;
``examples/extending/algorithm.py`` is complete.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from vusfa.algorithms.schedule import threads_per_step
from vusfa.envs.observation import crop_index
from vusfa.errors import ConfigError
from vusfa.modules import Agent, FeatureFrames
from vusfa.scenes import SceneSet

__all__ = ["Algorithm", "AlgorithmSettings", "check_replay"]


@dataclass
class AlgorithmSettings:
    """Settings of an algorithm: its registered name; a subclass adds its own numbers, with defaults."""

    name: str


class Algorithm:
    """Losses of an agent, and what belongs to them.

    An update is :meth:`show_crops`, :meth:`schedule`, collect, :meth:`losses` and one optimizer step,
    :attr:`replay_steps` times :meth:`show_crops`, :meth:`replay_losses` and one optimizer step,
    :meth:`after_step`; the same for further :meth:`minibatches`, without replay. Entries named ``loss_...``
    are added up; others are logged.

    Args:
        agent: what learns.
        scenes: its scenes.
        settings: all settings of the training; an algorithm's own are ``settings["algorithm"]``.

    Raises:
        ConfigError: settings or an agent that it does not fit; a subclass checks them in ``__init__``.

    Attributes:
        replay_steps: further optimizer steps per batch.
        threads: see :func:`~vusfa.algorithms.threads_per_step`.
    """

    #: Class of its settings, which Hydra's ConfigStore checks.
    Settings: ClassVar[type[AlgorithmSettings]] = AlgorithmSettings
    replay_steps: int = 0

    def __init__(self, agent: Agent, scenes: SceneSet, settings: Mapping[str, Any]) -> None:
        self.agent, self.scenes, self.settings = agent, scenes, settings
        self.threads = threads_per_step(settings)
        if (frames := self._feature_frames()) is not None:
            frames.dropout = settings.get("env", {}).get("crop_dropout", 0.0)

    def _feature_frames(self) -> FeatureFrames | None:
        """Where an agent that reads ids looks features up; None for any other."""
        frames = getattr(getattr(self.agent, "encoder", None), "frames", None)  # an extension may have none
        return frames if isinstance(frames, FeatureFrames) and frames.num_states else None

    def parameters(self) -> Iterable[nn.Parameter]:
        """What the optimizer moves: the agent's parameters, and those of networks of its own."""
        return self.agent.parameters()

    def prepare(self) -> str | None:
        """Work before the first batch of a new training, not of a resumed one; returns a line to print."""
        return None

    def show_crops(self) -> None:
        """Show an agent that reads ids other crops than the first, as ``env.crop`` says: in training mode it
        sees every state, as state and as goal, in that crop, or in one drawn anew at each call.

        Agents that are handed features get theirs from :class:`~vusfa.envs.SceneObservation`.
        """
        crop, frames = crop_index(self.settings["env"]["crop"], self.scenes.num_crops), self._feature_frames()
        if crop == 0 or frames is None:
            return
        features = self.scenes.features
        number, crops = features.shape[:2]
        drawn = torch.randint(crops, (number,)) if crop is None else torch.full((number,), crop)
        frames.show(features[torch.arange(number), drawn])

    def schedule(self, frames: int) -> None:
        """Set what depends on the number of frames trained on, such as a coefficient."""

    def minibatches(self, batch: TensorDictBase) -> Sequence[TensorDictBase]:
        """Parts of a batch (num_envs, T), one optimizer step each: all of it, or with ``optim=a3c`` groups of
        as many environments as a step stands for."""
        return (batch,) if self.threads is None else batch.split(self.threads)

    def scenes_on_record(self) -> Tensor:
        """Scenes (n,) that an update may learn in besides those of its batch."""
        return torch.empty(0, dtype=torch.int64)

    def losses(self, batch: TensorDictBase) -> Mapping[str, Tensor]:
        """Terms of a collector's batch (num_envs, T); scalars."""
        raise NotImplementedError

    def replay_losses(self) -> Mapping[str, Tensor]:
        """Terms of one further step: from a replay buffer, or of the batch once more; scalars."""
        raise NotImplementedError

    def after_step(self) -> None:
        """What follows the last optimizer step of an update, such as a multiplier's step."""

    def share_statistics(self, mean: Callable[[Tensor], Tensor]) -> None:
        """Compute a batch's statistics, such as its advantages' mean, over all ranks of a data-parallel
        training; ``mean`` gives the mean of a tensor over them. Called once, before the first batch."""

    def take_means(self, terms: Mapping[str, Tensor]) -> None:
        """Keep of an update's terms, which are now means over all ranks, what :meth:`after_step` reads."""

    def merge_states(self, states: Sequence[dict[str, Any]]) -> dict[str, Any]:
        """The ``state_dict`` of one process in place of all ranks, from theirs, None of those that are gone;
        by default the first. A ``CheckpointError`` where none can be left out."""
        return states[0]

    def share_of_state(self, state: dict[str, Any], rank: int, size: int) -> dict[str, Any]:
        """What a rank loads of a ``state_dict`` of one process; by default all of it."""
        return state

    def state_dict(self) -> dict[str, Any]:
        """What it has learned besides the agent, as tensors and plain data."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from what :meth:`state_dict` gave."""
        self.warm_start(state)

    def warm_start(self, state: Mapping[str, Any]) -> None:
        """Take from a ``state_dict`` what belongs to the agent's weights, such as a multiplier, and nothing
        that belongs to the run, such as a replay buffer: for fine-tuning."""


def check_replay(algorithm: str, agent: Agent, threads: int | None, **required: Any) -> None:
    """Refuse an agent or an optimizer that cannot learn from replay, where goals are given by their ids.

    Args:
        algorithm: its registered name.
        agent: what learns.
        threads: of the optimizer, see :func:`~vusfa.algorithms.threads_per_step`.
        **required: values of the agent's configuration that the algorithm needs besides.

    Raises:
        ConfigError: naming the setting.
    """
    for name, value in {"observation": "index", "memory": None, **required}.items():
        given, wanted = (str(each).replace("None", "null") for each in (agent.config[name], value))
        if given != wanted:
            raise ConfigError(
                f"algorithm={algorithm} cannot train an agent with agent.{name}={given}; give"
                f" agent.{name}={wanted}, or algorithm=usf"
            )
    if threads is not None:
        raise ConfigError(
            f"algorithm={algorithm} takes steps from replay, and optim.kind=a3c_rmsprop makes an update per"
            " environment of a batch; give optim=adam, or algorithm=usf"
        )
