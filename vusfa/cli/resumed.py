"""Progress of work that resumes an earlier run."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

from rich.console import Console

from vusfa.cli.progress import progress

__all__ = ["resumed"]


@contextmanager
def resumed(what: str, unit: str, console: Console | None = None) -> Iterator[Callable[[int, int], None]]:
    """Show the progress of work that reports ``(done, total)``; rate and time to go are those of this run.

    Args:
        what: the work, such as "encoding".
        unit: name of the units, such as "pictures"; "B" for bytes.
        console: where to write; standard error by default.

    Yields:
        ``report(done, total)``; a first ``done`` above 0 is that of an earlier run, a ``done`` below the last
        one starts again. A total of 0 is unknown.

    >>> with resumed("adding", "numbers", Console(quiet=True)) as report:
    ...     report(2, 4)
    ...     report(4, 4)
    """
    with ExitStack() as stack:
        advance: Callable[..., None] = lambda n: None  # noqa: E731
        before = -1

        def report(done: int, total: int) -> None:
            nonlocal advance, before
            if before < 0 or done < before:
                stack.close()  # the last bar, if the work was started again
                name = f"{what} (some was there already)" if done else what
                advance = stack.enter_context(progress(name, max(total - done, 0), unit, console))
            else:
                advance(done - before)
            before = done

        yield report
