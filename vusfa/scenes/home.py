"""The scenes that an agent is made for, checked wherever it meets scenes.

An agent that reads ids looks features up in its own copy of its scenes' table, and heads per scene are found
by the scene's index. In other scenes of no more states both would give numbers that mean nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

from vusfa.errors import ConfigError
from vusfa.limits import brief
from vusfa.scenes.scene_set import SceneSet

__all__ = ["Home", "check_home", "check_scenes"]


def check_scenes(scenes: Any) -> None:
    """Check that an argument ``scenes`` is a :class:`~vusfa.scenes.SceneSet`.

    >>> check_scenes(["bathroom"])
    Traceback (most recent call last):
    ...
    vusfa.errors.ConfigError: scenes is ['bathroom']; give a SceneSet, such as SceneSet.open(['bathroom'])
    """
    if not isinstance(scenes, SceneSet):
        raise ConfigError(f"scenes is {brief(scenes)}; give a SceneSet, such as SceneSet.open(['bathroom'])")


class Home(NamedTuple):
    """What an agent takes for granted of the scenes that it acts in.

    Attributes:
        names: of the scenes, in the order of their ids.
        fingerprint: of the set.
        num_actions: A.
        feature_size: F; None for an agent that reads pictures.
        reads_ids: whether it looks up what it sees by the ids of states.
        heads_per_scene: whether the scene's index chooses weights.
    """

    names: tuple[str, ...]
    fingerprint: str
    num_actions: int
    feature_size: int | None
    reads_ids: bool
    heads_per_scene: bool

    def check(self, scenes: SceneSet) -> None:
        """Check that the agent can act in these scenes.

        Raises:
            ConfigError: it was made for others.

        >>> Home(("attic",), "f", 4, None, True, True).check(SceneSet.bundled(["bathroom"]))
        Traceback (most recent call last):
        ...
        vusfa.errors.ConfigError: scenes are ['bathroom'], and the agent was made for ['attic']; give it ...
        """
        own, given = list(self.names), list(scenes.names)
        numbers = [("actions", self.num_actions, scenes.num_actions)]
        if self.feature_size is not None:
            numbers.append(("features per picture", self.feature_size, scenes.feature_size))
        for what, expected, found in numbers:
            if expected != found:
                raise ConfigError(
                    f"scenes {brief(given)} have {found} {what}, and the agent was made for {expected}; give"
                    f" it scenes made as its own, {brief(own)}"
                )
        if (self.reads_ids or self.heads_per_scene) and own != given:
            raise ConfigError(
                f"scenes are {brief(given)}, and the agent was made for {brief(own)}; {self._mend}"
            )
        if self.reads_ids and self.fingerprint != scenes.fingerprint:
            raise ConfigError(
                f"scenes {brief(given)} are called as the agent's, but their graphs or features are others;"
                f" {self._mend}"
            )

    @property
    def _mend(self) -> str:
        if self.heads_per_scene:
            return "give it its own scenes, or train one with shared_heads=True for these"
        return "give it its own scenes, or take it to these with vusfa.modules.transplant(agent, scenes)"


def check_home(policy: Any, scenes: Any) -> None:
    """Check that the agents in a policy can act in these scenes.

    Args:
        policy: an agent, a policy made of one, or anything else, which is not judged.
        scenes: a :class:`~vusfa.scenes.SceneSet`, or an environment over one; others are not judged.

    Raises:
        ConfigError: the agent was made for other scenes.
    """
    world = scenes if isinstance(scenes, SceneSet) else getattr(scenes, "scenes", None)
    if isinstance(world, SceneSet):
        for home in set(_homes(policy)):
            home.check(world)


def _homes(policy: Any) -> Iterator[Home]:
    modules = getattr(policy, "modules", None)
    for module in modules() if callable(modules) else ():
        home = getattr(module, "home", None)
        if isinstance(home, Home):
            yield home
