"""A training's whole state in one file, written whole or not at all.

The file holds tensors and plain data only, so that it is read with ``torch.load(weights_only=True)``: opening
a checkpoint runs no code, wherever it comes from. Its entries:

=========================  ==================================================================================
``format``                 version of this layout
``frames``, ``updates``    how far the training has come; the learning rate is a function of the frames
``seconds``                time spent
``agent_config``           what :func:`vusfa.modules.make_agent` needs besides the scenes
``agent``                  the agent's ``state_dict``
``scenes``                 what was given as scenes, their names, and the set's fingerprint
``goals``                  (G,) global ids of the goals trained on
``config``, ``overrides``  the recipe's resolved configuration and the command line that made it
``optimiser``, ``loss``    their states; the loss's without the networks, hence multiplier and coefficients
``collector``              environments and the frame they stand at (:mod:`vusfa.training.collectors`)
``meter``                  sums of the episodes since the last line of the log
``rng``                    random states: torch, CUDA, numpy, Python
``run_id``                 what the loggers call the run
=========================  ==================================================================================
"""

from __future__ import annotations

import os
import random
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from vusfa.errors import CheckpointError
from vusfa.files import replacing
from vusfa.scenes import SceneSet

__all__ = [
    "FORMAT",
    "check_scenes",
    "check_setting",
    "load_checkpoint",
    "random_state",
    "restore_random_state",
    "save_checkpoint",
]

FORMAT = 1
_ENTRIES = ("agent_config", "agent", "scenes", "goals", "frames")


def save_checkpoint(path: str | Path, state: Mapping[str, Any]) -> Path:
    """Write a checkpoint atomically.

    Args:
        path: where to; replaced if it exists.
        state: the entries of this module's table, ``format`` aside.

    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> state = {"agent_config": {}, "agent": {}, "scenes": {}, "goals": torch.tensor([1]), "frames": 5}
    >>> load_checkpoint(save_checkpoint(folder / "a.pt", state))["frames"]
    5
    """
    with replacing(path) as unfinished:
        torch.save({"format": FORMAT, **state}, unfinished)
    return Path(path)


def load_checkpoint(path: str | Path, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Read a checkpoint; no code in it is run.

    Args:
        path: a file that :func:`save_checkpoint` wrote.
        device: where its tensors go.

    Raises:
        CheckpointError: there is no such file, it is damaged, or it is no checkpoint of this package.
    """
    path = Path(path)
    if not os.path.isfile(path):  # Path.is_file raises in a folder that may not be looked into
        raise CheckpointError(
            f"{path}: no such checkpoint; recipes/train.py writes them as RUN/checkpoint.pt"
        )
    try:
        state = torch.load(path, map_location=device, weights_only=True)
    except Exception as error:  # of other files the unpickler raises anything, an IndexError for one
        raise CheckpointError(
            f"{path}: not a whole checkpoint ({path.stat().st_size} bytes), damaged, cut off in copying or"
            " another kind of file; take another"
        ) from error
    missing = [key for key in _ENTRIES if not isinstance(state, dict) or key not in state]
    if missing:
        raise CheckpointError(
            f"{path}: no checkpoint of vusfa ({missing[0]!r} is missing); give one of recipes/train.py"
        )
    if state.get("format") != FORMAT:
        raise CheckpointError(
            f"{path}: checkpoint of format {state.get('format')}, this version reads {FORMAT};"
            " use the version that wrote it"
        )
    return state


def check_setting(path: str | Path, name: str, saved: Any, wanted: Any) -> None:
    """Refuse a checkpoint whose setting differs from the one asked for.

    >>> check_setting("a.pt", "agent.model", "usfa", "vusfa")
    Traceback (most recent call last):
    ...
    vusfa.errors.CheckpointError: a.pt: saved with agent.model=usfa, not vusfa; leave the setting out, or
        start a new run
    """
    if saved != wanted:
        raise CheckpointError(
            f"{path}: saved with {name}={saved}, not {wanted}; leave the setting out, or start a new run"
        )


def check_scenes(path: str | Path, saved: Mapping[str, Any], scenes: SceneSet) -> None:
    """Refuse a checkpoint whose scenes are not these, number for number.

    Raises:
        CheckpointError: other scenes, or scenes of the same names with other content.
    """
    if list(saved["names"]) != list(scenes.names):
        raise CheckpointError(
            f"{path}: trained in {', '.join(saved['names'])}, not in {', '.join(scenes.names)};"
            " give it its own scenes"
        )
    if saved["fingerprint"] != scenes.fingerprint:
        raise CheckpointError(
            f"{path}: its scenes are called {', '.join(scenes.names)}, too, but their graphs or features"
            " have changed since; give it the files that it was trained on"
        )


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


def restore_random_state(state: Mapping[str, Any]) -> None:
    """Put the global random generators back to where :func:`random_state` found them.

    >>> before = random_state()
    >>> first = torch.rand(1), random.random(), np.random.rand()
    >>> restore_random_state(before)
    >>> first == (torch.rand(1), random.random(), np.random.rand())
    True
    """
    torch.set_rng_state(state["torch"].cpu())
    if state["cuda"] and torch.cuda.is_available():
        torch.cuda.set_rng_state_all([generator.cpu() for generator in state["cuda"]])
    version, internal, gauss = state["python"]
    random.setstate((version, tuple(internal), gauss))
    name, keys, position, has_gauss, cached = state["numpy"]
    np.random.set_state((name, keys.cpu().numpy().astype(np.uint32), position, has_gauss, cached))  # noqa: NPY002
