"""Compact arrays for a page: numbers quantized, then encoded in base 64.

A packed array is a plain dictionary, ``{"type": "u8" | "u16", "shape": [...], "low": a, "high": b, "data":
"..."}``. Levels 0 to 254, or 65534, are spread evenly from ``low`` to ``high``; 255 and 65535 stand for NaN.
Without ``low`` the numbers are integers.
"""

from __future__ import annotations

import base64
from typing import Any

import numpy as np

__all__ = ["pack", "pack_ids", "unpack"]

_TYPES: dict[str, tuple[Any, int]] = {"u8": ("<u1", 254), "u16": ("<u2", 65534)}


def pack(
    values: Any, kind: str = "u8", low: float | None = None, high: float | None = None
) -> dict[str, Any]:
    """Quantize floats to 255 levels (``"u8"``) or 65535 (``"u16"``), evenly from ``low`` to ``high``.

    Args:
        values: any shape; NaN stays NaN, values beyond the ends are clipped.
        kind: ``"u8"`` or ``"u16"``.
        low, high: the ends; the smallest and largest value by default.

    Returns:
        a packed array, see the module.

    >>> packed = pack(np.array([0.0, 0.25, np.nan, 1.0]))
    >>> packed["shape"], unpack(packed).round(3).tolist()
    ([4], [0.0, 0.252, nan, 1.0])
    """
    array = np.asarray(values, dtype=np.float64)
    known = array[np.isfinite(array)]
    low = float(known.min() if known.size else 0.0) if low is None else float(low)
    high = float(known.max() if known.size else 1.0) if high is None else float(high)
    dtype, most = _TYPES[kind]
    span = high - low if high > low else 1.0
    level = np.rint(np.clip((array - low) / span, 0.0, 1.0) * most)
    level[~np.isfinite(array)] = most + 1
    return _packed(kind, level.astype(dtype), {"low": low, "high": high})


def pack_ids(values: Any) -> dict[str, Any]:
    """Pack integers from 0 to 65535.

    >>> unpack(pack_ids([[3, 700]])).tolist()
    [[3, 700]]
    """
    array = np.asarray(values)
    if array.size and (array.min() < 0 or array.max() > 65535):
        raise ValueError(f"ids must lie in 0..65535; they lie in {array.min()}..{array.max()}")
    return _packed("u16", array.astype("<u2"), {})


def unpack(packed: dict[str, Any]) -> np.ndarray:
    """Unpack an array as the page does: float64, or int64 for ids."""
    dtype, most = _TYPES[packed["type"]]
    level = np.frombuffer(base64.b64decode(packed["data"]), dtype).reshape(packed["shape"])
    if "low" not in packed:
        return level.astype(np.int64)
    values = packed["low"] + level / most * (packed["high"] - packed["low"])
    return np.where(level > most, np.nan, values)


def _packed(kind: str, array: np.ndarray, ends: dict[str, float]) -> dict[str, Any]:
    data = base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")
    return {"type": kind, "shape": list(array.shape), **ends, "data": data}
