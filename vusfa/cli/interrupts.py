"""Ctrl-C while a command starts: one line instead of the traceback of an import."""

from __future__ import annotations

import sys
from types import TracebackType

__all__ = ["quiet_interrupts"]


def quiet_interrupts() -> None:
    """Report an unhandled interruption in one line; other exceptions keep their traceback."""
    before = sys.excepthook

    def hook(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        cause: BaseException | None = error
        while cause is not None and not isinstance(cause, KeyboardInterrupt):
            cause = cause.__cause__ or cause.__context__  # an import may turn it into an ImportError
        if cause is None:
            before(kind, error, trace)
        else:
            sys.stderr.write("error: interrupted while starting\n")

    sys.excepthook = hook
