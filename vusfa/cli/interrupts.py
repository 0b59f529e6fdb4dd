"""What ends a command from outside in one line: Ctrl-C while it starts, and memory that is not there."""

from __future__ import annotations

import sys
from types import TracebackType

__all__ = ["out_of_memory", "quiet_interrupts"]


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


def out_of_memory(error: BaseException) -> bool:
    """Whether an exception says that the system or a GPU has no more memory; torch raises RuntimeErrors.

    >>> out_of_memory(MemoryError()), out_of_memory(RuntimeError("shapes differ"))
    (True, False)
    """
    words = ("can't allocate memory", "out of memory", "Cannot allocate memory", "not enough memory")
    said = isinstance(error, RuntimeError) and any(word in str(error) for word in words)
    return isinstance(error, MemoryError) or said
