"""The live line of a training: frames, rate, success, length over shortest path, time to go."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console
    from rich.live import Live

__all__ = ["ProgressLine", "describe"]


class ProgressLine:
    """One line that renews itself on a terminal; elsewhere (a file, a pipe) a new line now and then.

    Args:
        total: frames at which the training ends.
        console: where to write; standard error by default, so that results can be piped.
        every: seconds between lines when the output is not a terminal.
        clock: gives the time in seconds.
    """

    def __init__(
        self,
        total: int,
        console: Console | None = None,
        every: float = 10.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        from rich.console import Console
        from rich.live import Live
        from rich.text import Text

        self._total = total
        self._console = console or Console(stderr=True)
        self._every = every
        self._clock = clock
        self._recent: deque[tuple[float, int]] = deque(maxlen=200)
        self._success = self._ratio = math.nan
        self._printed = -math.inf
        self._line = ""
        self._live: Live | None = None
        if self._console.is_terminal:
            self._live = Live(
                console=self._console, get_renderable=lambda: Text(self._line), refresh_per_second=4
            )
            self._live.start()

    def rates(self, success: float, length_ratio: float) -> None:
        """What the episodes came to lately; NaN keeps what is shown."""
        self._success = self._success if math.isnan(success) else success
        self._ratio = self._ratio if math.isnan(length_ratio) else length_ratio

    def update(self, frames: int) -> None:
        """So many frames have been trained on."""
        now = self._clock()
        if self._recent and now - self._recent[0][0] > 30.0:
            self._recent.popleft()
        self._recent.append((now, frames))
        (then, before) = self._recent[0]
        speed = (frames - before) / (now - then) if now > then else math.nan
        self._line = describe(frames, self._total, speed, self._success, self._ratio)
        if self._live is None and now - self._printed >= self._every:
            self._print(now)

    def __enter__(self) -> ProgressLine:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Leave the last line standing."""
        if self._live is not None:
            self._live.stop()
        elif self._line:
            self._print(self._clock())

    def _print(self, now: float) -> None:
        self._printed = now
        self._console.print(self._line, soft_wrap=True, highlight=False)


def describe(frames: int, total: int, speed: float, success: float, length_ratio: float) -> str:
    """The line itself; NaN for what is not known yet.

    >>> describe(250_000, 1_000_000, 5000.0, 0.975, 1.127)
    '250,000 of 1,000,000 frames | 5,000 a second | success 97.5 % | length / shortest 1.13 | 2:30 to go'
    """
    parts = [f"{frames:,} of {total:,} frames"]
    if not math.isnan(speed):
        parts.append(f"{speed:,.0f} a second")
    if not math.isnan(success):
        parts.append(f"success {100 * success:.1f} %")
    if not math.isnan(length_ratio):
        parts.append(f"length / shortest {length_ratio:.2f}")
    if speed > 0:
        minutes, seconds = divmod(round(max(0, total - frames) / speed), 60)
        hours, minutes = divmod(minutes, 60)
        parts.append((f"{hours}:{minutes:02}" if hours else f"{minutes}") + f":{seconds:02} to go")
    return " | ".join(parts)
