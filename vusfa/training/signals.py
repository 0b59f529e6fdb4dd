"""Ctrl-C and SIGTERM end a training after the current update."""

from __future__ import annotations

import signal
from types import FrameType, TracebackType
from typing import Any

__all__ = ["StopOnSignal", "ignore_interrupts"]


class StopOnSignal:
    """Context manager: the first SIGINT or SIGTERM is recorded; a second one acts at once.

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
        """What a shell reports of a process that the signal ended: 128 + its number; 0 without one."""
        return 128 + self.received if self.received is not None else 0

    def __enter__(self) -> StopOnSignal:
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._restore()

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.received = number
        self._restore()

    def _restore(self) -> None:
        while self._before:
            number, handler = self._before.popitem()
            signal.signal(number, handler)


def ignore_interrupts() -> None:
    """Ignore Ctrl-C in a worker process: a terminal sends it to all, and the main process decides."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
