"""Ctrl-C, SIGTERM and SIGHUP end a training after the current update."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from types import FrameType, TracebackType
from typing import Any

__all__ = ["STOPPING", "StopOnSignal", "signals_held"]

#: Signals that end a training.
STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


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
        for number in STOPPING:
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


@contextmanager
def signals_held() -> Iterator[Callable[[], None]]:
    """Context in which signals that end a training wait; its function raises what one that has come asks for.

    They are blocked in this thread, and so in the processes that it starts. Another thread may receive one;
    its handler is then called here, notes it, and sends it again afterwards.

    >>> with signals_held() as end_if_signaled:
    ...     end_if_signaled()  # KeyboardInterrupt or SystemExit, if a signal has come
    """
    noted: list[int] = []
    handlers: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():
        handlers = {number: signal.getsignal(number) for number in STOPPING}
        handlers = {number: now for number, now in handlers.items() if now not in (None, signal.SIG_IGN)}
    for number in handlers:
        signal.signal(number, lambda number, frame: noted.append(number))

    def end_if_signaled() -> None:
        for number in {*noted, *signal.sigpending()}.intersection(STOPPING):
            raise KeyboardInterrupt if number == signal.SIGINT else SystemExit(128 + number)

    resource_tracker.ensure_running()  # which ends by unblocking signals
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, STOPPING)
    try:
        yield end_if_signaled
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        for number in noted:
            signal.raise_signal(number)


def _caused_by_interrupt(error: BaseException | None) -> bool:
    while error is not None:
        if isinstance(error, KeyboardInterrupt) or "KeyboardInterrupt" in str(error):
            return True
        error = error.__cause__ or error.__context__
    return False
