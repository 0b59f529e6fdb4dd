"""A critic's outputs at every state of a rollout, each state evaluated once.

Bootstrapping needs the critic at the states ``s_0 .. s_{T-1}`` and at the next states, which in a rollout are
the former shifted by one. So the critic runs once, on the T root states and on those next states that are not
the next root: the last of each row, and those of steps that ended an episode.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.modules import set_recurrent_mode

from vusfa.modules.unique import gather
from vusfa.objectives.networks import entry

__all__ = ["check_next", "evaluate_rollout"]


def check_next(owner: object, data: TensorDictBase, critic: nn.Module) -> None:
    """Raise a ``KeyError``, in the owner's name, where ``"next"`` has no input of the critic, as from a
    collector with ``compact_obs=True``: its next values would be those of the root."""
    following = entry(owner, data, "next")
    carried = {unravel_key(key) for key in critic.out_keys}  # type: ignore[union-attr]
    inputs = [
        key
        for key in map(unravel_key, critic.in_keys)  # type: ignore[arg-type]
        if not _is_start_mark(key) and unravel_key(("next", key)) not in carried
    ]
    if inputs and all(following.get(key, None) is None for key in inputs):
        raise KeyError(
            f"{type(owner).__name__}: 'next' has none of {inputs}, which the critic reads; collect with"
            " compact_obs=False"
        )


def _is_start_mark(key: NestedKey) -> bool:
    return (key if isinstance(key, str) else key[-1]) == "is_init"


def evaluate_rollout(
    critic: Callable[[TensorDictBase], TensorDictBase],
    data: TensorDictBase,
    ended: Tensor,
    out_keys: list[NestedKey],
    written: TensorDictBase | None = None,
    index: Tensor | None = None,
) -> tuple[Tensor, list[Tensor]]:
    """A critic's outputs at the root states of a rollout and at its next states.

    Args:
        critic: a tensordict module with ``in_keys``.
        data: ``(*batch, T)``, the critic's inputs at the root and under ``"next"``; what ``"next"`` lacks,
            such as the goal, is the root's.
        ended: ``(*batch, T)``, bool: the next root does not follow from this step.
        out_keys: of the outputs, the value's the first.
        written, index: see :meth:`vusfa.objectives.USFEstimator.forward`.

    Returns:
        the value at the root states, and every output at the next states, ``(*batch, T, ...)``.
    """
    in_keys = [unravel_key(key) for key in critic.in_keys]  # type: ignore[attr-defined]
    root = data.select(*in_keys, strict=False)
    following = data.get("next").select(*in_keys, strict=False)
    outside = ended.clone()
    outside[..., -1] = True
    if any(map(_is_start_mark, in_keys)):
        return _evaluate_sequences(critic, root, following, outside, in_keys, out_keys)

    # one flat batch of the roots, unless they are known, and of next states that are no root
    rows = outside.reshape(-1).nonzero().squeeze(-1)
    steps, shape = outside.numel(), outside.shape
    root = root.reshape(-1)
    ends = _complete(following.reshape(-1)[rows], root[rows], in_keys)
    if written is None:
        outputs = critic(torch.cat([root, ends]))
        values = {key: outputs.get(key) for key in out_keys}
    else:
        outputs = critic(ends)
        values = {}
        for key in out_keys:
            known, end = written.get(key), outputs.get(key)
            values[key] = torch.cat([known.reshape(-1, *end.shape[1:]), end])
    root_rows = torch.arange(steps, device=rows.device) if index is None else index.reshape(-1)
    next_rows = root_rows.roll(-1)
    known_rows = len(values[out_keys[0]]) - len(rows)
    next_rows[rows] = torch.arange(known_rows, known_rows + len(rows), device=rows.device)

    value = values[out_keys[0]]
    at_root = value[:steps].reshape(*shape, -1) if index is None else gather(value, root_rows.view(shape))
    return at_root, [gather(values[key], next_rows.view(shape)) for key in out_keys]


def _evaluate_sequences(
    critic: Callable[[TensorDictBase], TensorDictBase],
    root: TensorDictBase,
    following: TensorDictBase,
    outside: Tensor,
    in_keys: list[NestedKey],
    out_keys: list[NestedKey],
) -> tuple[Tensor, list[Tensor]]:
    """The same for recurrent critics: T+1 states in order, and sequences of one state."""
    time = root.batch_dims - 1
    end = _complete(following[..., -1:], root[..., -1:], in_keys)
    with set_recurrent_mode(True):
        outputs = critic(torch.cat([root, end], time))
    values = [outputs.get(key) for key in out_keys]
    at_root = values[0].narrow(time, 0, outside.shape[-1])
    at_next = [value.narrow(time, 1, outside.shape[-1]) for value in values]
    inside = outside.clone()
    inside[..., -1] = False
    if inside.any():
        with set_recurrent_mode(True):
            ends = critic(_complete(following[inside], root[inside], in_keys).unsqueeze(-1))
        for i, key in enumerate(out_keys):
            at_next[i] = at_next[i].clone()
            at_next[i][inside] = ends.get(key).squeeze(1)
    return at_root, at_next


def _complete(following: TensorDictBase, root: TensorDictBase, in_keys: list[NestedKey]) -> TensorDictBase:
    """Next states with every input: what is missing, or NaN (from a compact collector), is the root's."""
    following = following.copy()
    for key in in_keys:
        at_root, at_next = root.get(key, None), following.get(key, None)
        if at_root is None:
            continue
        if _is_start_mark(key):
            # the step goes on from the root's hidden state, even where the root began an episode
            following.set(key, torch.zeros_like(at_root))
        elif at_next is None:
            following.set(key, at_root)
        elif at_next.is_floating_point():
            following.set(key, torch.where(at_next.isnan(), at_root, at_next))
    return following
