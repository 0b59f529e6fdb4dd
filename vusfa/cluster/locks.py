"""Locks on files, one holder at a time; a lock ends with its process, however that ends."""

from __future__ import annotations

import fcntl
import os
import socket
from contextlib import suppress
from pathlib import Path
from types import TracebackType

__all__ = ["FileLock", "LockedError"]


class LockedError(Exception):
    """Another process holds the lock.

    Attributes:
        owner: that process in words, ``"process 12"``; of another machine ``"process 12 of HOST"``.
    """

    def __init__(self, owner: str) -> None:
        super().__init__(owner)
        self.owner = owner


class FileLock:
    """Exclusive lock on a file (``flock``), a context manager.

    On a file system that several machines share it excludes processes of all of them, where that file system
    has locks (NFS 4, Lustre with ``-o flock``); one without locks refuses nobody.

    Args:
        path: the file, which is created for the lock and removed with it.
        wait: wait for the holder instead of raising.

    Raises:
        LockedError: another process holds it, in :meth:`acquire` and on entry.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with FileLock(Path(folder) / "lock"):
    ...         os.listdir(folder)
    ...     os.listdir(folder)
    ['lock']
    []
    """

    def __init__(self, path: str | Path, wait: bool = False) -> None:
        self._path, self._wait = Path(path), wait
        self._file: int | None = None

    def acquire(self) -> None:
        """Take the lock; see the class for errors."""
        while not self._try():
            pass  # its holder has just ended and removed it

    def release(self) -> None:
        """Give the lock back, and remove the file; nothing if it is not held."""
        if self._file is not None:
            with suppress(OSError):
                self._path.unlink()
            os.close(self._file)
            self._file = None

    def __enter__(self) -> FileLock:
        self.acquire()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()

    def _try(self) -> bool:
        file = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (0 if self._wait else fcntl.LOCK_NB))
        except BlockingIOError as error:
            owner = _read_owner(file)
            os.close(file)
            raise LockedError(owner) from error
        except OSError:
            pass  # a file system without locks
        except BaseException:
            os.close(file)
            raise
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file), os.stat(self._path)):
                os.ftruncate(file, 0)
                os.write(file, f"{os.getpid()} {socket.gethostname()}".encode())
                self._file = file
                return True
        os.close(file)
        return False


def _read_owner(file: int) -> str:
    process, _, host = os.read(file, 300).decode("ascii", "replace").partition(" ")
    return f"process {process}" + (f" of {host}" if host not in ("", socket.gethostname()) else "")
