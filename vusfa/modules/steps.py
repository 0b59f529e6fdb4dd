"""Steps that an agent's actor and critic are made of, and the actor."""

from __future__ import annotations

from typing import Any

from tensordict.nn import ProbabilisticTensorDictSequential
from tensordict.nn import TensorDictModule as Step
from torchrl.modules import LSTMModule

from vusfa.errors import ConfigError
from vusfa.scenes import check_home

__all__ = ["Actor", "AtHome", "Moved", "Observing", "Remembering", "Step"]

_OF_MEMORY = "give the environment the transforms of agent.make_env_transforms()"


class AtHome:
    """A policy to which TorchRL's collectors introduce themselves."""

    def register_collector(self, collector: Any) -> None:
        """Raise a ConfigError where the environment is over other scenes than the agent's."""
        check_home(self, collector.env)


class Actor(AtHome, ProbabilisticTensorDictSequential):
    """The policy with every entry that a loss may read."""


class _SaysWhatIsMissing:
    """A step whose error names the mend where the tensordict lacks an entry."""

    mend: str

    def forward(self, *args: Any, **entries: Any) -> Any:
        """As without it."""
        try:
            return super().forward(*args, **entries)  # type: ignore[misc]
        except KeyError as error:
            raise ConfigError(f"the agent reads {self.in_keys}; {self.mend} ({error.args[0]})") from error  # type: ignore[attr-defined]


class Observing(_SaysWhatIsMissing, Step):
    """The step that reads observations."""

    mend = (
        "TargetNavEnv sends ids; for an agent with observation='features' or 'pixels' append the transform"
        " vusfa.envs.SceneObservation(scenes, kind) to it"
    )


class Moved(_SaysWhatIsMissing, Step):
    """The step that reads the action before."""

    mend = _OF_MEMORY


class Remembering(_SaysWhatIsMissing, LSTMModule):
    """The recurrent step."""

    mend = _OF_MEMORY
