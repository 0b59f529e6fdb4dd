"""States of the global random generators: torch, CUDA, numpy, Python."""

from __future__ import annotations

import random
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

__all__ = ["check_random_state", "random_state", "restore_random_state"]


def random_state() -> dict[str, Any]:
    """The states of all global random generators, as tensors and plain data."""
    version, internal, gauss = random.getstate()
    name, keys, position, has_gauss, cached = np.random.get_state(legacy=True)  # noqa: NPY002
    return {
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
        "python": [version, list(internal), gauss],
        "numpy": [
            str(name),
            torch.from_numpy(np.asarray(keys).astype(np.int64)),
            int(position),
            int(has_gauss),
            float(cached),
        ],
    }


def restore_random_state(state: Mapping[str, Any] | None) -> None:
    """Put the global random generators back to where :func:`random_state` found them; None leaves them.

    >>> before = random_state()
    >>> first = torch.rand(1), random.random(), np.random.rand()
    >>> restore_random_state(before)
    >>> first == (torch.rand(1), random.random(), np.random.rand())
    True
    """
    if state is None:
        return
    torch.set_rng_state(state["torch"].cpu())
    if state["cuda"] and torch.cuda.is_available():
        torch.cuda.set_rng_state_all([generator.cpu() for generator in state["cuda"]])
    version, internal, gauss = state["python"]
    random.setstate((version, tuple(internal), gauss))
    name, keys, position, has_gauss, cached = state["numpy"]
    if keys.shape != (624,) or not 0 <= position <= 624:  # numpy does not look
        raise ValueError(f"a state of numpy's generator at {position} of {tuple(keys.shape)}")
    np.random.set_state((name, keys.cpu().numpy().astype(np.uint32), position, has_gauss, cached))  # noqa: NPY002


def check_random_state(state: Mapping[str, Any]) -> None:
    """Raise what :func:`restore_random_state` would raise; the generators stay as they are."""
    before = random_state()
    try:
        restore_random_state(state)
    finally:
        restore_random_state(before)
