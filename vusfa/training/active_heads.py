"""Heads of active scenes: weights per scene, computed, stepped and kept on the device only while needed.

A :class:`~vusfa.modules.SceneLinear` holds the weights of all scenes in one tensor, and what is done with it
costs as much as all of them: conversions, gradients, their norm, the optimizer's step. :class:`ActiveHeads`
keeps that tensor and the optimizer's moments on the processor, and lends the layers the part that an update
needs.

The difference from training all of them: while a scene is not lent its moments do not decay, and its weights
do not move on by momentum, as with ``torch.optim.SparseAdam``; Adam's bias correction counts all updates.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from vusfa.modules import Agent, SceneLinear
from vusfa.objectives import TFRMSprop

__all__ = ["ActiveHeads"]


class ActiveHeads:
    """The per-scene weights of an agent, of which some are lent to its layers.

    Args:
        agent: with heads per scene.
        optimizer: of its parameters.

    >>> from vusfa.modules import make_agent
    >>> from vusfa.scenes import SceneSet
    >>> agent = make_agent("gvf", scenes=SceneSet.bundled(), hidden_size=8, embedding_size=8)
    >>> heads = ActiveHeads(agent, torch.optim.Adam(agent.parameters()))
    >>> heads.load(torch.tensor([1, 3]))
    >>> agent.value.linear.weight.shape
    torch.Size([2, 1, 8])
    >>> with heads.whole():
    ...     agent.value.linear.weight.shape
    torch.Size([4, 1, 8])
    """

    def __init__(self, agent: Agent, optimizer: torch.optim.Optimizer) -> None:
        self._layers = [module for module in agent.modules() if isinstance(module, SceneLinear)]
        self._params = [param for layer in self._layers for param in (layer.weight, layer.bias)]
        self._agent, self._optimizer, self._num_scenes = agent, optimizer, agent.num_scenes
        self._weights: list[Tensor] = []  # of all scenes, while some are lent
        self._moments: dict[tuple[int, str], Tensor] = {}
        self._loaded: Tensor | None = None

    def load(self, scenes: Tensor, exactly: bool = False) -> None:
        """Lend the weights of at least these scenes (n,), ascending, or of exactly these."""
        loaded = self._loaded
        if loaded is not None and (
            torch.equal(scenes, loaded) if exactly else torch.isin(scenes, loaded).all()
        ):
            return
        self._store()
        if not self._weights:
            self._weights = [param.data.cpu() for param in self._params]
        for param, weights in zip(self._params, self._weights, strict=True):
            param.data, param.grad = weights[scenes].to(param.device), None
            for name, moments in self._of(param).items():
                self._optimizer.state[param][name] = moments[scenes].to(param.device)
        slots = torch.full((self._num_scenes,), 1 << 40)
        slots[scenes] = torch.arange(len(scenes))
        self._loaded = scenes
        self._lend(slots.to(self._params[0].device), len(scenes))

    def gather(self) -> None:
        """Take everything back: layers and optimizer have what belongs to all scenes again."""
        if self._loaded is None:
            return
        self._store()
        for param, weights in zip(self._params, self._weights, strict=True):
            device = param.device
            param.data, param.grad = weights.to(device), None
            for name, moments in self._of(param).items():
                self._optimizer.state[param][name] = moments.to(device)
        self._weights, self._moments, self._loaded = [], {}, None
        self._lend(None, self._num_scenes)

    @contextmanager
    def whole(self) -> Iterator[None]:
        """Context in which nothing is lent, for checkpoints and evaluations."""
        loaded = self._loaded
        self.gather()
        try:
            yield
        finally:
            if loaded is not None:
                self.load(loaded)

    def _lend(self, slots: Tensor | None, number: int) -> None:
        self._agent.scene_slots, self._agent.num_scenes = slots, number
        for layer in self._layers:
            layer.slots, layer.num_scenes = slots, number

    def _store(self) -> None:
        """Take back what is lent, and what the optimizer has beside it."""
        if self._loaded is None:
            if not self._weights:  # all of it is still in the layers
                for param in self._params:
                    for name, value in self._per_scene(param):
                        self._moments[id(param), name] = value.cpu()
            return
        for param, weights in zip(self._params, self._weights, strict=True):
            weights[self._loaded] = param.data.cpu()
            for name, value in self._per_scene(param):
                key = id(param), name
                if key not in self._moments:
                    self._moments[key] = self._fresh(weights)
                self._moments[key][self._loaded] = value.cpu()

    def _per_scene(self, param: nn.Parameter) -> Iterator[tuple[str, Tensor]]:
        """The optimizer's tensors of a parameter's shape."""
        state: dict[str, Any] = self._optimizer.state.get(param, {})
        return ((name, value) for name, value in state.items() if getattr(value, "shape", ()) == param.shape)

    def _of(self, param: nn.Parameter) -> dict[str, Tensor]:
        return {name: value for (owner, name), value in self._moments.items() if owner == id(param)}

    def _fresh(self, weights: Tensor) -> Tensor:
        """What the optimizer begins with."""
        if isinstance(self._optimizer, TFRMSprop):
            return torch.full_like(weights, self._optimizer.param_groups[0]["initial_accumulator"])
        # NumPy's zeros take no memory and no time until a scene is stored; torch's are written at once
        return torch.from_numpy(np.zeros(tuple(weights.shape), weights.numpy().dtype))
