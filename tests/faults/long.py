"""The long form of the suites of faults: ``make faults``, which writes docs/reliability.md.

``python tests/faults/long.py --mutations 1000 --kills 100 --minutes 10 --out docs/reliability.md``
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from endings import COLLECTORS, ended, killed_until_done, logged_frames, start, wait_for
from test_readers import NAMES

from vusfa.files import say, write_text
from vusfa.training import load_checkpoint

PAGE = """# Reliability

What is done to files and trainings on purpose, and what came of it. `make faults` does it again and writes
this page; a quick form is in `make test` (`tests/faults`). A *fault* is a traceback, a crash, a hang (more
than 10 seconds of computing), more than a gigabyte of memory beyond the file's size, or lost learning.

This page is from {mutations:,} damaged files, {kills} kills, {disks} full disks and a soak of {minutes:g}
minutes, with seed {seed}, on {date}.

## Damaged files

Half of the files are damaged as bytes, half within their format, so that the damage gets past checksums and
parsers.

| reader | damaged files | read | refused in one line | faults | slowest, s |
|---|---:|---:|---:|---:|---:|
{readers}

Files that are *read* are damaged where it changes nothing, or hold other valid content. A checkpoint that
is read is resumed and trained on.

## Trainings

| what is done | how often | what must hold | faults |
|---|---:|---|---:|
{endings}

## What is refused when

- *Pictures of a scene.* Opening a scene decodes one. `check` and `fetch` of `vusfa scenes` first
  look at the header and the end of every picture, so that one that is cut off, of another size or no
  picture is found in seconds, wherever it lies. Then they decode as many, evenly spaced, as a few seconds
  suffice for: all in a room of common size. Where that is not all, `check` says how many, and
  `check --all` decodes every one, however long it takes.
- *Features* are read, checked and written some rows at a time and take the memory of float32. Where that
  is more than 768 MiB beyond the file's size (float16, compressed), the scene is refused; stored as
  float32 it is read.
- *Devices.* `agent.to("cuda")`, `loss.to("cuda")` and `env.to("cuda")` without CUDA raise torch's own
  error, which says what is missing; a setting or an argument `device` raises ours.
- *Weights & Biases on a full disk.* A tracker that fails is left behind with a warning; where the
  checkpoint has no place either, the run ends with one line, exit code 1 and the checkpoint before
  (`tests/faults/test_endings.py` fills a disk in memory). Offline, W&B copies every checkpoint for `wandb
  sync`: such runs want a larger `checkpoint_every`.
"""


def damaged_files(count: int, seed: int) -> Iterator[tuple[str, int]]:
    """A row of the table and the number of faults per reader."""
    worker, cases = Path(__file__).with_name("worker.py"), -(-count // len(NAMES))
    for name in NAMES:
        command = [sys.executable, str(worker), str(seed), str(cases), name]
        done = subprocess.run(command, capture_output=True, text=True)
        found = json.loads(done.stdout) if done.returncode == 0 else None
        if found is None:
            say(f"{name}: died at {done.stderr[-2000:]}")
            yield f"| {name} | {cases} | | | died | |", 1
            continue
        for case, what in found["faults"]:
            say(f"{name}, case {case}: {what}")
        numbers = found["read"], found["refused"], len(found["faults"]), f"{found['slowest']:.1f}"
        yield f"| {name} | {cases} | {' | '.join(map(str, numbers))} |", len(found["faults"])


def killed(folder: Path, kind: str, kills: int, seed: int) -> int:
    """Faults of a training that is killed and begun again."""
    try:
        killed_until_done(folder / kind, kind, kills, seed)
    except (AssertionError, TimeoutError, ValueError) as error:
        say(f"{kind}: {error}")
        return 1
    return 0


def full_disks(folder: Path, count: int) -> int:
    """Faults of trainings whose files cannot grow past a limit, from nothing to a whole checkpoint."""
    path, faults = folder / "disk" / "checkpoint.pt", 0
    assert ended(start(path.parent, "total_frames=24")) == 0
    whole, size = path.read_bytes(), path.stat().st_size
    for part in range(count):
        limit = 4096 + (size - 8192) * part // count  # the log's lines fit, the checkpoint never does
        process = start(
            path.parent,
            "total_frames=480",
            "resume=auto",
            prepare=lambda limit=limit: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
        )
        code, text = ended(process), (folder / "disk.txt").read_text()
        kept = {place.name for place in path.parent.iterdir()} <= {path.name, "config.json", "metrics.csv"}
        if code != 1 or "Traceback" in text or path.read_bytes() != whole or not kept:
            say(f"a limit of {limit} bytes: code {code}, {text[-2000:]}")
            faults += 1
    return faults


def soak(folder: Path, minutes: float, seed: int) -> tuple[str, int]:
    """A training of so many minutes with replay: its memory and descriptors may not grow."""
    process = start(
        folder / "soak",
        "algorithm=hindsight",
        "hindsight.capacity=6000",
        "total_frames=1000000000",
        f"seed={seed}",
    )
    wait_for(folder / "soak" / "checkpoint.pt", process)
    begun, samples = time.monotonic(), []
    while time.monotonic() - begun < 60 * minutes:
        time.sleep(min(5.0, 6 * minutes))
        pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
        samples.append((pages * os.sysconf("SC_PAGE_SIZE") / 2**20, len(os.listdir(f"/proc/{process}/fd"))))
    os.kill(process, signal.SIGTERM)
    code = ended(process)
    frames = load_checkpoint(folder / "soak" / "checkpoint.pt")["frames"]
    logged = logged_frames(folder / "soak")
    early, late = samples[len(samples) // 4], samples[-1]
    grown, files = late[0] - early[0], late[1] - early[1]
    faults = int(code != 143) + int(grown > 50) + int(files > 0) + int(logged != sorted(set(logged)))
    return (
        f"{frames // 24:,} updates and checkpoints; memory grew by {grown:.1f} MB, descriptors by {files}",
        faults,
    )


def main() -> int:
    """Does all of it, and writes the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mutations", type=int, default=1000)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--disks", type=int, default=10)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("docs/reliability.md"))
    given = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    with tempfile.TemporaryDirectory() as temporary:
        folder, endings, total = Path(temporary), [], 0
        each = -(-given.kills // len(COLLECTORS))
        for kind in COLLECTORS:
            faults = killed(folder, kind, each, given.seed)
            words = "checkpoint whole, no learning lost, every line of the log once, no process left"
            endings.append(
                f"| `kill -9` at a random moment, collector={kind} | {each} | {words} | {faults} |"
            )
            total += faults
        faults = full_disks(folder, given.disks)
        words = "one line, exit code 1, the checkpoint before as it was, no temporary file left"
        endings.append(f"| disk full while a run is resumed | {given.disks} | {words} | {faults} |")
        found, more = soak(folder, given.minutes, given.seed)
        endings.append(f"| soak with replay, {given.minutes:g} minutes | 1 | {found} | {more} |")
        total += faults + more
    rows = list(damaged_files(given.mutations, given.seed))
    total += sum(faults for _, faults in rows)
    numbers = {
        **vars(given),
        "date": time.strftime("%Y-%m-%d"),
        "mutations": -(-given.mutations // len(NAMES)) * len(NAMES),
        "kills": each * len(COLLECTORS),
    }
    write_text(
        given.out,
        PAGE.format(readers="\n".join(row for row, _ in rows), endings="\n".join(endings), **numbers),
    )
    say(f"{given.out}: {total} faults")
    return min(total, 1)


if __name__ == "__main__":
    sys.exit(main())
