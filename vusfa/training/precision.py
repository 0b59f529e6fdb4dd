"""Whether products in bfloat16 are faster than in float32 on this machine.

bfloat16 pays only where the hardware multiplies it. Elsewhere a library converts every element in software:
on a processor with AVX2 alone a product takes about ten times as long as in float32.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from functools import cache
from typing import Literal

import torch
from torch import Tensor

from vusfa.errors import ConfigError

__all__ = ["describe_autocast", "precision_name", "resolve_autocast"]

#: Rows, inputs and outputs of the product that is measured: a small batch through one of the paper's layers.
PRODUCT = (256, 512, 512)
#: How much faster the product must be, because autocast converts weights and activations besides.
GAIN = 1.5
REPEATS = 5


def resolve_autocast(setting: bool | Literal["auto"], device: torch.device | str = "cpu") -> bool:
    """Resolve the setting ``autocast`` to true or false.

    ``"auto"`` means bfloat16 where the hardware has units for it and, on a processor, a product of the
    network's size is faster with them. That is measured once per process, in a few milliseconds.

    Args:
        setting: true, false or ``"auto"``.
        device: where the agent computes.

    Raises:
        ConfigError: for any other setting.

    >>> resolve_autocast(False)
    False
    >>> resolve_autocast("off")
    Traceback (most recent call last):
    ...
    vusfa.errors.ConfigError: autocast is 'off'; give true, false or auto
    """
    if isinstance(setting, bool):
        return setting
    if setting != "auto":
        raise ConfigError(f"autocast is {setting!r}; give true, false or auto")
    kind = torch.device(device).type
    if kind == "cuda":
        return torch.cuda.is_available() and torch.cuda.is_bf16_supported(including_emulation=False)
    return kind == "cpu" and _has_bfloat16_units() and _is_faster()


def describe_autocast(enabled: bool, *, decided: bool) -> str:
    """Describe the precision of a run, for its first line.

    Args:
        enabled: whether products are computed in bfloat16.
        decided: by ``autocast=auto``: at the start of the training, which a resumed run keeps.

    >>> describe_autocast(False, decided=False), describe_autocast(True, decided=True)
    ('products in float32', 'products in bfloat16 (autocast=auto)')
    """
    return f"products in {precision_name(enabled)}{' (autocast=auto)' if decided else ''}"


def precision_name(enabled: bool) -> str:
    """Name of the number format of the products."""
    return "bfloat16" if enabled else "float32"


def _has_bfloat16_units() -> bool:
    """Whether the processor has instructions that multiply bfloat16; true where torch cannot tell."""
    capabilities = torch.cpu.get_capabilities()
    flags = [value for name, value in capabilities.items() if "bf16" in name]
    return any(flags) if flags else True


@cache
def _is_faster() -> bool:
    """Whether the product takes less time in bfloat16, by the fastest of a few repeats of each."""
    rows, inputs, outputs = PRODUCT
    single = torch.ones(rows, inputs), torch.ones(inputs, outputs)
    half = single[0].bfloat16(), single[1].bfloat16()
    seconds = [(_seconds(single), _seconds(half)) for _ in range(REPEATS)]
    float32, bfloat16 = (min(column) for column in zip(*seconds[1:], strict=True))  # the first one warms up
    return bfloat16 * GAIN < float32


def _seconds(factors: Iterable[Tensor]) -> float:
    left, right = factors
    with torch.inference_mode():
        began = time.perf_counter()
        left @ right
        return time.perf_counter() - began
