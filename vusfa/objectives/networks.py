"""Run an actor and a critic on the same rows: modules that both hold run once.

An actor and a critic over one trunk hold the very same module objects. Both run module by module, and the
critic takes over what a module wrote in the actor, where it would run *on the very same tensors*. Nothing is
assumed about names or order.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any, TypeAlias, cast

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

from vusfa.limits import brief
from vusfa.modules.unique import gather, unique_rows

__all__ = [
    "ends_in_distribution",
    "entry",
    "flatten",
    "run_actor_critic",
    "run_critic",
    "select_inputs",
    "unique_inputs",
    "use_params",
]

#: Module and input tensors, by their ids, to these tensors and what the module wrote.
_Calls: TypeAlias = dict[tuple[int, ...], tuple[list[Any], dict[NestedKey, Any]]]
#: Share of distinct rows up to which computing each once is worth the sorting.
WORTH = 0.75


def run_actor_critic(
    actor: nn.Module, critic: nn.Module, inputs: TensorDictBase, index: Tensor | None = None
) -> tuple[Distribution, TensorDictBase]:
    """The action's distribution, and everything that the critic writes.

    Args:
        actor: has ``get_dist``, as TorchRL's ``ProbabilisticActor`` and every probabilistic sequence.
        critic: a tensordict module.
        inputs: of both, any batch shape; see :func:`select_inputs`. Not written.
        index: (\\*B,), each row's place among distinct inputs, see :func:`unique_inputs`; for actors of which
            :func:`ends_in_distribution` is true.

    Returns:
        the distribution, with the batch shape of the inputs or of the index; and the critic's tensordict.
    """
    actor_steps, critic_steps = _actor_modules(actor), flatten(critic)
    if not actor_steps:
        distribution = actor.get_dist(_select(inputs, actor.in_keys))  # type: ignore[operator]
        return distribution, run_critic(critic, inputs)
    calls: _Calls = {}
    acted = _run(actor_steps, _select(inputs, actor.in_keys), calls)
    judged = _run(critic_steps, _select(inputs, critic.in_keys), calls)
    last = _modules(cast(TensorDictSequential, actor))[-1]
    if index is not None:
        acted = TensorDict({key: gather(acted.get(key), index) for key in last.in_keys}, index.shape)
    return cast(ProbabilisticTensorDictModule, last).get_dist(acted), judged


def _run(modules: list[TensorDictModuleBase], tensordict: TensorDictBase, calls: _Calls) -> TensorDictBase:
    """Run modules one after the other; one that ``calls`` has on the same tensors is not run again."""
    for module in modules:
        if not module.in_keys or not module.out_keys:
            tensordict = module(tensordict)
            continue
        inputs = [tensordict.get(key, None) for key in module.in_keys]
        call = (id(module), *map(id, inputs))
        if call not in calls:
            tensordict = module(tensordict)
            # the inputs are kept beside the outputs: an id is only unique while its object lives
            calls[call] = inputs, {key: tensordict.get(key, None) for key in module.out_keys}
            continue
        for key, value in calls[call][1].items():
            if value is not None:
                tensordict.set(key, value)
    return tensordict


def run_critic(critic: nn.Module, inputs: TensorDictBase) -> TensorDictBase:
    """Everything that a critic writes, hidden by it or not; the inputs are not written."""
    judged = _select(inputs, critic.in_keys)
    for module in flatten(critic):
        judged = module(judged)
    return judged


def unique_inputs(inputs: TensorDictBase) -> tuple[TensorDictBase, Tensor] | None:
    """The distinct rows (D,) of a tensordict of ids (\\*B,), and an index (\\*B,) into them.

    None where an entry is not one whole number per row, or more than three quarters of the rows are distinct.

    >>> import torch
    >>> ids = {"state": torch.tensor([[4], [7], [4], [4]]), "goal": torch.tensor([1, 1, 1, 0])}
    >>> rows, index = unique_inputs(TensorDict(ids, [4]))
    >>> rows["state"].flatten().tolist(), rows["goal"].tolist(), index.tolist()
    ([4, 4, 7], [0, 1, 1], [1, 2, 1, 0])
    >>> unique_inputs(TensorDict({"state": torch.rand(4, 1)}, [4])) is None
    True
    """
    number, batch = inputs.numel(), inputs.batch_dims
    columns = dict(sorted(inputs.items(True, True), key=lambda item: str(item[0])))
    if not columns or any(x.is_floating_point() or x.numel() != number for x in columns.values()):
        return None
    unique = unique_rows(*(column.reshape(inputs.shape) for column in columns.values()))
    distinct = len(unique.columns[0])
    if distinct > WORTH * number:
        return None
    shapes = (column.shape[batch:] for column in columns.values())
    rows = {
        key: ids.to(column.dtype).view(distinct, *shape)
        for (key, column), ids, shape in zip(columns.items(), unique.columns, shapes, strict=True)
    }
    return TensorDict(rows, [distinct]), unique.inverse


def select_inputs(tensordict: TensorDictBase, *keys: NestedKey) -> TensorDictBase:
    """A dense shallow copy with those of the given entries that exist.

    Lazy stacks make a new tensor at each access; from this copy actor and critic read the same objects.
    """
    selected = _select(tensordict, keys)
    return selected if isinstance(selected, TensorDict) else selected.contiguous()


@contextlib.contextmanager
def use_params(module: nn.Module, params: TensorDictBase) -> Iterator[None]:
    """Let a module run with other parameters; its own come back however the block ends.

    (``with params.to_module(module)`` leaves them in place after an error, and turns a ``KeyboardInterrupt``
    into a ``RuntimeError``.)

    >>> import torch
    >>> layer = torch.nn.Linear(1, 1, bias=False)
    >>> with use_params(layer, TensorDict({"weight": torch.tensor([[3.0]])}, [])):
    ...     layer(torch.ones(1)).item()
    3.0
    """
    swapped = params.to_module(module, preserve_module_state=False)
    swapped.__enter__()
    try:
        yield
    finally:
        swapped.__exit__(None, None, None)


def entry(owner: object, tensordict: TensorDictBase, key: NestedKey, hint: str = "") -> Any:
    """An entry; where it is missing, a ``KeyError`` names the owner's class, the entry, and ``hint``."""
    value = tensordict.get(key, None)
    if value is None:
        names = brief(sorted(str(name) for name in tensordict.keys()))
        raise KeyError(
            f"{type(owner).__name__}: the input has no {key!r}; it has {names}" + (hint and f"; {hint}")
        )
    return value


def flatten(module: nn.Module) -> list[TensorDictModuleBase]:
    """The modules that a sequence runs, in order, those of sequences within it included.

    A sequence that does more than run its modules (it hides some of their keys, writes to another tensordict,
    tolerates missing keys, samples in the middle, or has a ``forward`` of its own) is one module.

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
    children = _modules(module)
    plain = (
        type(module).forward in (TensorDictSequential.forward, ProbabilisticTensorDictSequential.forward)
        and not module.partial_tolerant
        and {key for child in children for key in child.out_keys} <= set(module.out_keys)
        and not module._forward_hooks
        and not module._forward_pre_hooks
        and module.inplace in (None, True)
        and not any(_is_probabilistic(child) for child in children)
    )
    if not plain:
        return [module]
    return [leaf for child in children for leaf in flatten(child)]


def ends_in_distribution(actor: nn.Module) -> bool:
    """Whether an actor is modules one after the other and one distribution at their end."""
    return bool(_actor_modules(actor))


def _select(tensordict: TensorDictBase, keys: object) -> TensorDictBase:
    return tensordict.select(*keys, strict=False)  # type: ignore[misc]


def _is_probabilistic(module: nn.Module) -> bool:
    return isinstance(module, ProbabilisticTensorDictModule | ProbabilisticTensorDictSequential)


def _modules(sequence: TensorDictSequential) -> list[TensorDictModuleBase]:
    modules = sequence.module
    return list(modules.values() if isinstance(modules, nn.ModuleDict) else modules)


def _actor_modules(actor: nn.Module) -> list[TensorDictModuleBase]:
    """The modules before the actor's only distribution; none where the actor is built otherwise."""
    if not isinstance(actor, ProbabilisticTensorDictSequential) or actor.return_composite:
        return []
    *body, last = _modules(actor)
    ordinary = (
        isinstance(last, ProbabilisticTensorDictModule)
        and not any(_is_probabilistic(module) for module in body)
        and not actor.partial_tolerant
        and type(actor).get_dist is ProbabilisticTensorDictSequential.get_dist
    )
    return [leaf for module in body for leaf in flatten(module)] if ordinary else []
