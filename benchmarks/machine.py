"""Description of the machine that is measured."""

from __future__ import annotations

import os
import platform
import subprocess
from pathlib import Path
from typing import Any

import psutil
import torch
import torchrl

import vusfa

__all__ = ["AVX2", "describe_machine", "foreign_load"]

#: Environment that limits torch, oneDNN and MKL to AVX2.
AVX2 = {
    "ONEDNN_MAX_CPU_ISA": "AVX2",
    "ATEN_CPU_CAPABILITY": "avx2",
    "MKL_ENABLE_INSTRUCTIONS": "AVX2",
}
_FLAGS = ("avx2", "avx512f", "avx512_bf16", "amx_bf16", "amx_int8")


def describe_machine() -> dict[str, Any]:
    """Processor, memory, accelerator, versions and the commit, as plain data.

    >>> sorted(describe_machine())[:4]
    ['capability', 'commit', 'cores', 'cpu']
    """
    model, flags = _cpu()
    return {
        "cpu": model,
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "cpu_flags": [flag for flag in _FLAGS if flag in flags],
        "memory_gib": round(psutil.virtual_memory().total / 2**30, 1),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "system": platform.platform(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "torchrl": torchrl.__version__,
        "vusfa": vusfa.__version__,
        "commit": _commit(),
        "threads": torch.get_num_threads(),
        "capability": torch.backends.cpu.get_cpu_capability(),
    }


def foreign_load(seconds: float = 1.0) -> float:
    """Load of other programs, in cores; with more than a little of it timings are worthless."""
    own = psutil.Process()
    before = own.cpu_times()
    busy = psutil.cpu_percent(interval=seconds) / 100 * (psutil.cpu_count() or 1)
    after = own.cpu_times()
    mine = (after.user + after.system - before.user - before.system) / seconds
    return max(0.0, busy - mine)


def _cpu() -> tuple[str, set[str]]:
    info = Path("/proc/cpuinfo")
    if not info.exists():
        return platform.processor() or platform.machine(), set()
    lines = dict(line.split(":", 1) for line in info.read_text().splitlines() if ":" in line)
    entries = {key.strip(): value.strip() for key, value in lines.items()}
    return entries.get("model name", platform.machine()), set(entries.get("flags", "").split())


def _commit() -> str | None:
    """The commit of this checkout, with a + where files differ from it; None outside of one."""
    folder = Path(__file__).parent
    try:
        name = subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"], cwd=folder, capture_output=True, text=True, check=True
        ).stdout.strip()
        changed = subprocess.run(
            ["git", "status", "--porcelain", "--untracked-files=no"],
            cwd=folder,
            capture_output=True,
            text=True,
            check=True,
        ).stdout
    except (OSError, subprocess.CalledProcessError):
        return None
    return name + ("+" if changed.strip() else "")
