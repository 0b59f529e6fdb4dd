"""Doing once what a module does at every call, while its weights stand still.

An update collects thousands of steps and computes its loss with the same weights. What depends on the weights
and the world alone (codes of all states, weights as autocast wants them) is then computed once.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn

__all__ = ["Freezable", "for_autocast", "frozen"]


class Freezable(nn.Module, ABC):
    """A module that can do beforehand what it would do at every call while its weights stand still; see
    :func:`frozen`."""

    @abstractmethod
    def freeze(self, grad: bool = False, goals: Tensor | None = None) -> None:
        """Does it now, for calls until :meth:`thaw`.

        Args:
            grad: calls with gradients are served, too; otherwise these do everything anew.
            goals: (G,) ids of the only states that will be goals; None for all.
        """

    @abstractmethod
    def thaw(self) -> None:
        """Uses the weights as they are again."""


@contextmanager
def frozen(module: nn.Module, grad: bool = False, goals: Tensor | None = None) -> Iterator[None]:
    """Within it, every siamese encoder in ``module`` looks up what it encoded on the way in, and weights that
    autocast would convert at every call are converted once.

    The weights must not change meanwhile. Other modules are left as they are, so any policy may be passed.

    Args:
        module: an agent, or any part of one.
        grad: what is looked up carries gradients to the weights, where gradients are on: for an update, which
            then encodes the world once for collecting and for the loss. Otherwise calls with gradients encode
            anew.
        goals: (G,) ids of the only states that will be goals, which are then the only ones to be encoded as
            such; None for all of the world.

    >>> from vusfa.modules import make_agent
    >>> from vusfa.scenes import SceneSet
    >>> agent = make_agent("usfa", scenes=SceneSet.bundled(["bathroom"]))
    >>> with frozen(agent), torch.no_grad():
    ...     state, goal = agent.encoder(torch.zeros(3, 4, dtype=torch.int64), torch.arange(3))
    """
    parts = [part for part in module.modules() if isinstance(part, Freezable)]
    try:
        for part in parts:
            part.freeze(grad, goals)
        yield
    finally:
        for part in parts:
            part.thaw()


def for_autocast(tensor: Tensor) -> Tensor:
    """A tensor as autocast would convert it for a product, where it is on; else as it is.

    >>> with torch.autocast("cpu", torch.bfloat16):
    ...     for_autocast(torch.zeros(2)).dtype
    torch.bfloat16
    """
    device = tensor.device.type
    return tensor.to(torch.get_autocast_dtype(device)) if torch.is_autocast_enabled(device) else tensor
