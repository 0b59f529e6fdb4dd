"""Freed memory is used again instead of being asked for anew."""

from __future__ import annotations

import subprocess
import sys

import pytest

from vusfa.training.memory import keep_memory

FAULTS = """
import resource, sys, torch
from vusfa.training.memory import keep_memory
if sys.argv[1] == "keep":
    assert keep_memory()
def once():
    torch.ones(4_000_000).add(1.0)
for _ in range(3):
    once()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(10):
    once()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(not keep_memory(), reason="the C library is not glibc")
def test_pages_are_not_asked_for_again() -> None:
    faults = {
        how: int(subprocess.run([sys.executable, "-c", FAULTS, how], capture_output=True, check=True).stdout)
        for how in ("keep", "leave")
    }
    # twenty blocks of 16 MB are asked for in turn; one or two that are kept may still be new
    assert faults["keep"] < faults["leave"] / 4
