"""Choice of Mitsuba's variant: LLVM if a working library is found, otherwise scalar C++.

LLVM is several times faster, but some versions of it crash (LLVM 15 does with Mitsuba 3.9), so each candidate
first renders a small scene in a process of its own. ``DRJIT_LIBLLVM_PATH`` names one to try first. The scalar
variant's threads hinder each other: two take almost three times as long as one, so that it is given one.
"""

from __future__ import annotations

import glob
import os
import re
import subprocess
import sys
from dataclasses import dataclass
from functools import cache
from typing import Any

from vusfa.errors import ConfigError, SceneError

__all__ = ["Backend", "choose_backend", "cores", "llvm_libraries", "load_mitsuba"]

_VARIABLE = "DRJIT_LIBLLVM_PATH"
_PATTERNS = (
    "/usr/lib/*/libLLVM*.so*",
    "/usr/lib/llvm-*/lib/libLLVM*.so*",
    "/usr/lib64/libLLVM*.so*",
    "/usr/lib64/llvm*/lib/libLLVM*.so*",
    "/usr/local/lib/libLLVM*.so*",
    "/opt/homebrew/opt/llvm*/lib/libLLVM*.dylib",
    "/usr/local/opt/llvm*/lib/libLLVM*.dylib",
)
_TRIAL_SECONDS = 120
_TRIAL = """
import numpy, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
light = {"type": "constant"}
ball = {"type": "sphere", "bsdf": {"type": "diffuse"}}
camera = {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}}
scene = mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "a": light, "b": ball, "c": camera})
assert numpy.isfinite(numpy.array(mi.render(scene, spp=2))).all()
"""


@dataclass(frozen=True)
class Backend:
    """A variant of Mitsuba; ``library`` is the LLVM that it compiles with, None for ``scalar_rgb``."""

    variant: str
    library: str | None = None

    def __str__(self) -> str:
        if self.library is None:
            return f"{self.variant} (without LLVM; LLVM 16 or later is several times faster)"
        return f"{self.variant} ({self.library})"


def _version(path: str) -> int:
    """Major version of LLVM according to a file's name or folder; 0 if neither tells.

    >>> _version("/usr/lib/x86_64-linux-gnu/libLLVM.so.19.1"), _version("/usr/lib/llvm-16/lib/libLLVM.so")
    (19, 16)
    """
    numbers = re.findall(r"libLLVM[-.a-z]*?(\d+)", path) or re.findall(r"llvm@?-?(\d+)", path)
    return int(numbers[0]) if numbers else 0


def llvm_libraries() -> list[str]:
    """Find the LLVM libraries of this machine, newest first; a file with several names counts once."""
    found: dict[str, int] = {}
    for pattern in _PATTERNS:
        for path in glob.glob(pattern):
            real = os.path.realpath(path)
            found[real] = max(found.get(real, 0), _version(real), _version(path))
    newest_first = sorted(found, key=lambda path: (-found[path], path))
    named = os.environ.get(_VARIABLE)
    return ([named] if named else []) + [path for path in newest_first if path != named]


def works(library: str) -> bool:
    """Whether Mitsuba renders with an LLVM library; a separate process tries, since it may crash."""
    try:
        done = subprocess.run(
            [sys.executable, "-c", _TRIAL],
            env={**os.environ, _VARIABLE: library},
            capture_output=True,
            timeout=_TRIAL_SECONDS,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return False
    return done.returncode == 0


@cache
def choose_backend() -> Backend:
    """The fastest variant that works here; determined once per process."""
    for library in llvm_libraries():
        if works(library):
            return Backend("llvm_ad_rgb", library)
    return Backend("scalar_rgb")


def load_mitsuba(backend: Backend, threads: int | None = None) -> Any:
    """Import the module ``mitsuba`` and set its variant.

    Args:
        backend: the variant.
        threads: number of threads that render and denoise in the whole process; by default one per core, or
            one for the scalar variant.

    Raises:
        SceneError: Mitsuba is not installed, or lacks the variant.
        ConfigError: ``threads`` is below 1.
    """
    if threads is not None and threads < 1:
        raise ConfigError(f"threads: {threads} is too few; give 1 or more")
    if backend.library is not None:
        os.environ[_VARIABLE] = backend.library
    try:
        import drjit
        import mitsuba
        import mitsuba_oidn  # noqa: F401  found missing now rather than at the first frame

        mitsuba.set_variant(backend.variant)
    except ImportError as error:
        raise SceneError(
            f"rendering needs some more packages ({error}): pip install 'vusfa[render]'"
        ) from error
    if threads is None:
        threads = 1 if backend.library is None else cores()
    drjit.set_thread_count(threads)  # the denoiser shares this pool
    return mitsuba


def cores() -> int:
    """Processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
