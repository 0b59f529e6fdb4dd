"""Damages files and lets their readers read them, within limits of memory and time.

``worker.py SEED CASES [READER...]`` writes one line of JSON per reader: how many files were read, how many
were refused with an error of this package, and what else happened, with the number of the case that makes it
again.
"""

from __future__ import annotations

import contextlib
import faulthandler
import json
import os
import random
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path
from typing import Any

from mutate import mutations
from readers import READERS, Reader

from vusfa.errors import VusfaError

MEMORY, SECONDS = 1 << 30, 10  # of computing; six times that of waiting


class TooLongError(BaseException):
    """The reader took more than :data:`SECONDS`."""


def too_long(*_: Any) -> None:
    raise TooLongError


def limit_memory(size: int) -> None:
    """Allow a gigabyte beyond what the process has and the file's size."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * os.sysconf("SC_PAGE_SIZE") + MEMORY + size
    resource.setrlimit(resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))


def run(name: str, reader: Reader, seed: int, cases: int) -> dict[str, Any]:
    """Let a reader read ``cases`` damaged files."""
    result: dict[str, Any] = {"reader": name, "read": 0, "refused": 0, "slowest": 0.0, "faults": []}
    for case in range(cases):
        with tempfile.TemporaryDirectory() as folder:
            path = reader.make(Path(folder))
            sound = path.read_bytes()
            damaged = next(mutations(sound, random.Random(f"{name} {seed} {case}"), reader.kind))
            path.write_bytes(damaged)
            limit_memory(len(damaged))
            print(f"{name} {seed} {case}", file=sys.stderr, flush=True)  # the last line before a crash
            begun = time.monotonic()
            signal.setitimer(signal.ITIMER_PROF, SECONDS)
            signal.setitimer(signal.ITIMER_REAL, 6 * SECONDS)
            try:
                reader.read(path)
                result["read"] += 1
            except VusfaError as error:
                result["refused"] += 1
                if len(str(error)) > 20_000:
                    result["faults"].append([case, f"a message of {len(str(error))} characters"])
            except BaseException as error:
                where = traceback.format_exception(error)
                result["faults"].append([case, "".join(where[-3:])[-1500:]])
            finally:
                signal.setitimer(signal.ITIMER_PROF, 0)
                signal.setitimer(signal.ITIMER_REAL, 0)
            result["slowest"] = max(result["slowest"], round(time.monotonic() - begun, 2))
    return result


def main() -> None:
    """Run all readers, or those that are named."""
    faulthandler.enable()
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGALRM, too_long)
    signal.signal(signal.SIGPROF, too_long)
    seed, cases, names = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3:] or list(READERS)
    with contextlib.suppress(BrokenPipeError):
        for name in names:
            print(json.dumps(run(name, READERS[name], seed, cases)), flush=True)


if __name__ == "__main__":
    main()
