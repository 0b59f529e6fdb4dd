"""Target-driven visual navigation with universal successor features, as TorchRL components."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vusfa.deprecated import install

if TYPE_CHECKING:
    from vusfa.deploy.agents import TrainedAgent
    from vusfa.scenes import SceneSet

__version__ = "0.2.0"

install()


def load_pretrained(name: str, scenes: SceneSet | None = None) -> TrainedAgent:
    """:func:`vusfa.deploy.load_pretrained`: an agent that comes with the package.

    >>> import vusfa
    >>> agent, rooms, goals, card = vusfa.load_pretrained("gvf")
    >>> rooms.names[agent.num_scenes - 1]
    'living_room'
    """
    from vusfa.deploy import load_pretrained

    return load_pretrained(name, scenes)
