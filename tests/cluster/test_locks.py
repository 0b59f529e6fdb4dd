"""Locks on files: one holder, and none once its process is dead."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from vusfa.cluster.locks import FileLock, LockedError

HOLDER = """
import sys, time
from vusfa.cluster.locks import FileLock
with FileLock(sys.argv[1]):
    print("held", flush=True)
    time.sleep(60)
"""


def test_one_holder_at_a_time(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    with FileLock(path):
        with pytest.raises(LockedError) as error, FileLock(path):
            pass
        assert error.value.owner == f"process {os.getpid()}"
    with FileLock(path):
        assert path.exists()
    assert not path.exists()


def test_the_holder_of_another_machine_is_named_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with FileLock(tmp_path / "lock"):
        monkeypatch.setattr("vusfa.cluster.locks.socket.gethostname", lambda: "elsewhere")
        with pytest.raises(LockedError, match=rf"^process {os.getpid()} of .+"), FileLock(tmp_path / "lock"):
            pass


def test_a_lock_ends_with_its_process(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    holder = subprocess.Popen([sys.executable, "-c", HOLDER, str(path)], stdout=subprocess.PIPE)
    try:
        assert holder.stdout is not None
        holder.stdout.readline()
        with pytest.raises(LockedError, match=rf"^process {holder.pid}$"), FileLock(path):
            pass
        holder.kill()
        with FileLock(path, wait=True):
            assert path.read_text().startswith(f"{os.getpid()} ")
    finally:
        holder.kill()
        holder.wait()
        holder.stdout.close()


def test_a_file_system_without_locks_refuses_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def flock(file: int, operation: int) -> None:
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr("vusfa.cluster.locks.fcntl.flock", flock)
    with FileLock(tmp_path / "lock"), FileLock(tmp_path / "lock"):
        assert (tmp_path / "lock").exists()
