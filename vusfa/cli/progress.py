"""Progress of a command: items done, rate, time to go."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn
from rich.text import Text

__all__ = ["progress", "time_to_go"]

_EVERY = 10.0  # seconds between two lines where the output is not a terminal
_BRIEF = 2.0  # seconds of work that print no line there


@contextmanager
def progress(
    what: str, total: float, unit: str = "", console: Console | None = None
) -> Iterator[Callable[..., None]]:
    """Show the progress of some work on stderr: a bar on a terminal, elsewhere a line every ten seconds.

    Args:
        what: the work, such as "reading pictures".
        total: number of units.
        unit: name of the units, such as "pictures"; "B" for bytes, which are shown as MB.
        console: where to write; standard error by default, so that results can be piped.

    Yields:
        ``advance(n=1)``, to be called when ``n`` more are done.

    >>> with progress("adding", 3, "numbers", Console(quiet=True)) as advance:
    ...     for number in range(3):
    ...         advance()
    """
    console = console or Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), _State(unit))
    began = printed = time.monotonic()
    done = 0.0
    # Without a terminal rich would print the last line only.
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(what, total=total)

        def advance(n: float = 1) -> None:
            nonlocal done, printed
            done += n
            bar.advance(task, n)
            now = time.monotonic()
            at_last = done >= total and now - began >= _BRIEF
            if not console.is_terminal and (now - printed >= _EVERY or at_last):
                printed = now
                rate = done / (now - began) if now > began else math.nan
                console.print(
                    f"{what}: {_describe(done, total, rate, unit)}", soft_wrap=True, highlight=False
                )

        yield advance


class _State(ProgressColumn):
    def __init__(self, unit: str) -> None:
        super().__init__()
        self._unit = unit

    def render(self, task: Task) -> Text:
        """Text to the right of the bar."""
        speed = task.finished_speed if task.finished else task.speed
        rate = math.nan if speed is None else speed
        return Text(_describe(task.completed, task.total or 0, rate, self._unit))


def _describe(done: float, total: float, rate: float, unit: str) -> str:
    """
    >>> _describe(50, 200, 2.5, "pictures")
    '50 of 200 pictures | 2.5 per second | 1:00 to go'
    """
    if unit == "B":
        text = f"{done / 1e6:.1f} of {total / 1e6:.1f} MB"
        pace = f"{rate / 1e6:.1f} MB per second"
    else:
        text = f"{done:.0f} of {total:.0f} {unit}".rstrip()
        pace = f"{rate:.{0 if rate >= 10 else 1}f} per second"
    if not rate > 0:
        return text
    left = total - done
    return f"{text} | {pace}" + (f" | {time_to_go(left / rate)} to go" if left > 0 else "")


def time_to_go(seconds: float) -> str:
    """
    >>> time_to_go(59.6), time_to_go(3725)
    ('1:00', '1:02:05')
    """
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return (f"{hours}:{minutes:02}" if hours else f"{minutes}") + f":{rest:02}"
