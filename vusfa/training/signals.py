"""Ctrl-C, SIGTERM and SIGHUP end a training after the current update."""

from __future__ import annotations

import signal
import threading
from types import FrameType, TracebackType
from typing import Any

__all__ = ["StopOnSignal"]

_STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopOnSignal:
    """Context manager: the first SIGINT, SIGTERM or SIGHUP is recorded; a second one acts at once.

    A hang-up that is ignored (``nohup``) stays ignored. Outside the main thread nothing is recorded.

    Attributes:
        received: number of the signal, or None.

    >>> import os
    >>> with StopOnSignal() as stop:
    ...     os.kill(os.getpid(), signal.SIGTERM)
    ...     stop.received, stop.exit_code
    (15, 143)
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self._before: dict[int, Any] = {}

    @property
    def exit_code(self) -> int:
        """Exit code as a shell reports it: 128 plus the signal's number; 0 without a signal."""
        return 128 + self.received if self.received is not None else 0

    def __enter__(self) -> StopOnSignal:
        if threading.current_thread() is not threading.main_thread():  # only that one may set handlers
            return self
        for number in _STOPPING:
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._restore()
        # within autograd, or a library's callback, a second Ctrl-C comes out as an error of theirs
        if isinstance(error, Exception) and _caused_by_interrupt(error):
            raise KeyboardInterrupt from error

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.received = number
        self._restore()

    def _restore(self) -> None:
        while self._before:
            number, handler = self._before.popitem()
            signal.signal(number, handler)


def _caused_by_interrupt(error: BaseException | None) -> bool:
    while error is not None:
        if isinstance(error, KeyboardInterrupt) or "KeyboardInterrupt" in str(error):
            return True
        error = error.__cause__ or error.__context__
    return False
