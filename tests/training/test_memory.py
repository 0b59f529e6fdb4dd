"""Freed memory is used again instead of being asked for anew."""

from __future__ import annotations

import ctypes
import json
import subprocess
import sys

import pytest

from vusfa.training import memory

# what the C library counts of its own blocks: how large they are does not hang on pages or on other programs
PROGRAM = """
import ctypes, json, runpy, sys
keep_memory = runpy.run_path(sys.argv[2])["keep_memory"]
library = ctypes.CDLL(None)
names = "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks keepcost".split()
class Info(ctypes.Structure):
    _fields_ = [(name, ctypes.c_size_t) for name in names]
library.mallinfo2.restype = Info
if sys.argv[1] == "keep":
    assert keep_memory()
before = library.mallinfo2()
block = bytearray(30_000_000)
held = library.mallinfo2()
del block
freed = library.mallinfo2()
print(json.dumps({
    "apart": held.hblkhd - before.hblkhd,
    "held": held.arena + held.hblkhd - before.arena - before.hblkhd,
    "kept": freed.arena + freed.hblkhd - before.arena - before.hblkhd,
}))
"""


def counted(how: str) -> dict[str, int]:
    command = [sys.executable, "-c", PROGRAM, how, memory.__file__]
    return json.loads(subprocess.run(command, capture_output=True, check=True).stdout)


@pytest.mark.skipif(not memory.keep_memory(), reason="the C library is not glibc")
@pytest.mark.skipif(
    not hasattr(ctypes.CDLL(None), "mallinfo2"), reason="glibc before 2.33 counts its blocks in 32 bits"
)
def test_a_freed_block_stays_with_the_process() -> None:
    kept, left = counted("keep"), counted("leave")
    block = 30_000_000
    # as it comes, the library has the system map 30 MB apart, and gives them back at once ...
    assert left["apart"] >= block
    assert left["kept"] < block
    # ... and asked to keep them it takes them from its heap, where they stay
    assert kept["apart"] == 0
    assert kept["held"] > block / 2  # what was free at the heap's end is taken first
    assert kept["kept"] == kept["held"]
