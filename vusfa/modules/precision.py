"""Numeric precision: conversions of autocast, and padding to a few numbers of rows.

A processor compiles a bfloat16 kernel per matrix shape, which takes longer than running it. Where the number
of rows changes from call to call, rows of zeros bring it to one of a few bucket sizes.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

__all__ = ["autocast_copy", "bucket_size", "for_autocast", "full_precision", "is_bucketed", "padded_linear"]


def for_autocast(tensor: Tensor) -> Tensor:
    """A tensor as autocast converts it for a matrix product; unchanged where autocast is off.

    >>> with torch.autocast("cpu", torch.bfloat16):
    ...     for_autocast(torch.zeros(2)).dtype
    torch.bfloat16
    """
    device = tensor.device.type
    return tensor.to(torch.get_autocast_dtype(device)) if torch.is_autocast_enabled(device) else tensor


def full_precision(tensor: Tensor, weight: Tensor) -> Tensor:
    """A layer's output in the weights' own type; under autocast at least float32.

    >>> full_precision(torch.zeros(2), torch.zeros(1, dtype=torch.float64)).dtype
    torch.float64
    """
    if torch.is_autocast_enabled(tensor.device.type):
        return tensor.to(torch.promote_types(weight.dtype, torch.float32))
    return tensor.to(weight.dtype)


def autocast_copy(modules: Sequence[Any]) -> list[Any]:
    """A copy of modules, with weights converted once as autocast does at each call.

    The modules may share submodules. Buffers, and weights that need no conversion, are
    shared with the originals.

    >>> layer = nn.Linear(2, 3)
    >>> with torch.autocast("cpu", torch.bfloat16):
    ...     autocast_copy([layer])[0].bias.dtype
    torch.bfloat16
    """
    memo: dict[int, Tensor] = {}
    for module in modules:
        for weight in module.parameters():
            memo[id(weight)] = nn.Parameter(for_autocast(weight.detach()), requires_grad=False)
        memo.update((id(buffer), buffer) for buffer in module.buffers())
    return copy.deepcopy(list(modules), memo)


def bucket_size(number: int) -> int:
    """The next larger bucket size: 16, 32, ... 256, 288, ..., 512, 576, ..., eight per octave.

    >>> [bucket_size(number) for number in (1, 17, 256, 257, 1025)]
    [16, 32, 256, 288, 1152]
    """
    step = max(16, 1 << max(0, number.bit_length() - 4))
    return number + -number % step


def is_bucketed(rows: Tensor) -> bool:
    """Whether rows (R, ...) should be padded to a bucket size: in bfloat16 on a processor."""
    return not rows.is_cuda and for_autocast(rows).dtype == torch.bfloat16


def padded_linear(rows: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """``torch.nn.functional.linear`` on rows (R, in), padded where :func:`is_bucketed`.

    Rows of zeros add nothing to outputs or gradients. With more dimensions, rows are never padded.

    >>> padded_linear(torch.ones(3, 2), torch.ones(1, 2), torch.ones(1)).flatten()
    tensor([3., 3., 3.])
    """
    number = len(rows) if rows.dim() == 2 and is_bucketed(rows) else 0
    missing = bucket_size(number) - number
    if not missing:
        return functional.linear(rows, weight, bias)
    return functional.linear(functional.pad(rows, (0, 0, 0, missing)), weight, bias)[:number]
