"""Run an actor and a critic so that what they share runs once.

An actor and a critic over one trunk hold the very same module objects. Run one after the other, they would
encode every state twice. Here both are run module by module, and a module that has already been called *on
the very same tensors* hands out what it returned then. Nothing is assumed about names or order: two networks
that share nothing simply share nothing.
"""

from __future__ import annotations

from typing import cast

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    TensorDictSequential,
)
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.distributions import Distribution

from vusfa.objectives.distinct import spread

__all__ = ["Memory", "ends_in_distribution", "flatten", "run_actor", "run_critic", "select_inputs"]


class Memory:
    """What each module returned for which input tensors, within one forward pass.

    >>> import torch
    >>> from tensordict.nn import TensorDictModule
    >>> calls = []
    >>> double = TensorDictModule(lambda x: (calls.append(1), 2 * x)[1], in_keys=["x"], out_keys=["y"])
    >>> memory, x = Memory(), torch.ones(3)
    >>> first = memory.call(double, TensorDict({"x": x}, [3]))
    >>> second = memory.call(double, TensorDict({"x": x}, [3]))
    >>> first["y"] is second["y"], len(calls)
    (True, 1)
    >>> _ = memory.call(double, TensorDict({"x": x.clone()}, [3]))
    >>> len(calls)
    2
    """

    def __init__(self) -> None:
        # the inputs are kept beside the outputs: an id is only unique while its object lives
        self._calls: dict[tuple[int, ...], tuple[list[object], list[object]]] = {}

    def call(self, module: TensorDictModuleBase, tensordict: TensorDictBase) -> TensorDictBase:
        """Run ``module`` on ``tensordict``, or write what it returned for the same inputs.

        Args:
            module: any tensordict module; one that does not tell its keys is always run.
            tensordict: written in place as far as the module does so.

        Returns:
            the module's tensordict.
        """
        if not module.in_keys or not module.out_keys:
            return module(tensordict)
        inputs = [tensordict.get(key, None) for key in module.in_keys]
        call = (id(module), *map(id, inputs))
        known = self._calls.get(call)
        if known is None:
            tensordict = module(tensordict)
            self._calls[call] = (inputs, [tensordict.get(key, None) for key in module.out_keys])
            return tensordict
        for key, value in zip(module.out_keys, known[1], strict=True):
            if value is not None:
                tensordict.set(key, value)
        return tensordict


def flatten(module: nn.Module) -> list[TensorDictModuleBase]:
    """The modules that a sequence runs, in order, through sequences within it.

    A sequence that does more than run its modules one after the other (it hides some of their keys, writes to
    another tensordict, tolerates missing keys, samples in the middle, or has a ``forward`` of its own) is one
    module.

    >>> import torch
    >>> from tensordict.nn import TensorDictModule as Mod, TensorDictSequential as Seq
    >>> a, b, c = (Mod(torch.nn.Identity(), in_keys=[i], out_keys=[o]) for i, o in ("xy", "yz", "zw"))
    >>> [m.out_keys for m in flatten(Seq(a, Seq(b, c)))]
    [['y'], ['z'], ['w']]
    >>> len(flatten(Seq(a, b).select_out_keys("z")))
    1
    """
    if not isinstance(module, TensorDictSequential):
        return [cast(TensorDictModuleBase, module)]
    children = list(module._module_iter())
    plain = (
        type(module).forward in (TensorDictSequential.forward, ProbabilisticTensorDictSequential.forward)
        and not module.partial_tolerant
        and not module._select_before_return
        and not module._forward_hooks
        and not module._forward_pre_hooks
        and module.inplace in (None, True)
        and not any(_is_probabilistic(child) for child in children)
    )
    if not plain:
        return [module]
    return [leaf for child in children for leaf in flatten(child)]


def run_actor(
    actor: nn.Module, tensordict: TensorDictBase, memory: Memory, index: Tensor | None = None
) -> Distribution:
    """The action's distribution, from a tensordict holding the actor's inputs.

    Args:
        actor: has ``get_dist``, as TorchRL's ``ProbabilisticActor`` and every probabilistic sequence.
        tensordict: any batch shape; intermediate results are written into it.
        memory: of this forward pass.
        index: (\\*B,), rows of the tensordict to take, see :func:`~vusfa.objectives.distinct.distinct_rows`;
            for actors of which :func:`ends_in_distribution` is true.

    Returns:
        the distribution, with the tensordict's batch shape, or the index's.
    """
    modules = _actor_modules(actor)
    if not modules:
        return actor.get_dist(tensordict)  # type: ignore[operator]
    for module in modules:
        tensordict = memory.call(module, tensordict)
    last = _last(actor)
    if index is not None:
        rows = {key: spread(tensordict.get(key), index) for key in last.in_keys}
        tensordict = TensorDict(rows, index.shape)
    return last.get_dist(tensordict)


def ends_in_distribution(actor: nn.Module) -> bool:
    """Whether an actor is modules one after the other and one distribution at their end."""
    return bool(_actor_modules(actor))


def run_critic(critic: nn.Module, tensordict: TensorDictBase, memory: Memory) -> TensorDictBase:
    """Everything that the critic writes, from a tensordict holding its inputs.

    Args:
        critic: a tensordict module.
        tensordict: any batch shape.
        memory: of this forward pass.

    Returns:
        the critic's tensordict.
    """
    for module in flatten(critic):
        tensordict = memory.call(module, tensordict)
    return tensordict


def select_inputs(tensordict: TensorDictBase, *keys: NestedKey) -> TensorDictBase:
    """A dense shallow copy with the given entries, those that exist.

    Lazy stacks make a new tensor at each access; from this copy actor and critic read the same objects.

    >>> import torch
    >>> x = torch.ones(2)
    >>> select_inputs(TensorDict({"x": x, "y": x}, [2]), "x", "z")["x"] is x
    True
    """
    selected = tensordict.select(*keys, strict=False)
    return selected if isinstance(selected, TensorDict) else selected.contiguous()


def _is_probabilistic(module: nn.Module) -> bool:
    return isinstance(module, ProbabilisticTensorDictModule | ProbabilisticTensorDictSequential)


def _last(actor: nn.Module) -> ProbabilisticTensorDictModule:
    return list(actor._module_iter())[-1]  # type: ignore[operator]


def _actor_modules(actor: nn.Module) -> list[TensorDictModuleBase]:
    """The modules before the actor's only distribution; none where the actor is built otherwise."""
    if not isinstance(actor, ProbabilisticTensorDictSequential) or actor.return_composite:
        return []
    *body, last = actor._module_iter()
    ordinary = (
        isinstance(last, ProbabilisticTensorDictModule)
        and not any(_is_probabilistic(module) for module in body)
        and not actor.partial_tolerant
        and type(actor).get_dist is ProbabilisticTensorDictSequential.get_dist
    )
    return [leaf for module in body for leaf in flatten(module)] if ordinary else []
