"""Facts of a run for its results: model, settings, machine."""

from __future__ import annotations

import os
import platform
import subprocess
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from vusfa.training.precision import precision_name, resolve_autocast
from vusfa.training.setup import row_name

__all__ = ["machine_facts", "run_facts", "versions"]


def machine_facts() -> dict[str, Any]:
    """Processor, cores, Python, the versions of the libraries that compute, and the commit of a checkout.

    >>> sorted(machine_facts())
    ['commit', 'cores', 'gpu', 'processor', 'python', 'versions']
    """
    return {
        "commit": _commit(),
        "processor": _processor(),
        "cores": os.cpu_count(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "python": platform.python_version(),
        "versions": versions(),
    }


def versions() -> dict[str, str]:
    """Versions of this package and of the libraries that compute.

    >>> list(versions())
    ['vusfa', 'torch', 'torchrl', 'tensordict']
    """
    # torch's builds for GPUs have "+cu130" in their own version, and not in that of their package
    found = {name: version(name) for name in ("vusfa", "torch", "torchrl", "tensordict")}
    return found | {"torch": str(torch.__version__)}


def run_facts(state: Mapping[str, Any], overrides: Sequence[str] = ()) -> dict[str, Any]:
    """Model, seed, settings, goals, frames and seconds of a checkpoint; and this machine.

    Args:
        state: as :func:`~vusfa.training.load_agent` returns it.
        overrides: settings that the command gave.
    """
    config = state["config"]
    return {
        "model": config["agent"]["model"],
        "architecture": config["agent"]["architecture"],
        "row": row_name(config),
        "seed": config["seed"],
        "overrides": list(overrides),
        "scenes": list(state["scenes"]["names"]),
        "scenes_fingerprint": state["scenes"]["fingerprint"],
        "trained_goals": state["goals"].tolist(),
        "frames": int(state["frames"]),
        "updates": int(state["updates"]),
        "training_s": round(float(state["seconds"]), 1),
        "threads": config["threads"],
        "precision": precision_name(resolve_autocast(config["autocast"], config["device"])),
        **machine_facts(),
    }


def _commit() -> str | None:
    """Commit that is checked out where the package lies; None for an installed one."""
    root = Path(__file__).parents[2]
    if not (root / ".git").exists():
        return None
    try:
        command = ["git", "-C", str(root), "rev-parse", "HEAD"]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None


def _processor() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as lines:
            return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()
