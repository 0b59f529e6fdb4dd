"""Progress line of a training or an evaluation: frames, speed, success, time left."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from types import TracebackType
from typing import TYPE_CHECKING

from vusfa.errors import printable

if TYPE_CHECKING:
    from rich.console import Console
    from rich.live import Live

__all__ = ["EvaluationProgress", "ProgressLine", "describe"]


class ProgressLine:
    """Progress line, rewritten in place on a terminal, printed at intervals to a file or a pipe.

    Args:
        total: frames at which the training ends, or another total.
        console: where to write; standard error by default, so that results can be piped.
        every: seconds between lines when the output is not a terminal.
        clock: gives the time in seconds.
        unit: what is counted.
    """

    def __init__(
        self,
        total: int,
        console: Console | None = None,
        every: float = 10.0,
        clock: Callable[[], float] = time.monotonic,
        unit: str = "frames",
    ) -> None:
        from rich.console import Console
        from rich.live import Live
        from rich.text import Text

        self._total = total
        self._unit = unit
        self._console = console or Console(stderr=True)
        # whoever read the line may go away: that ends no training
        self._console.on_broken_pipe = lambda: None  # type: ignore[method-assign]
        self._every = every
        self._clock = clock
        self._recent: deque[tuple[float, int]] = deque(maxlen=200)
        self._success = self._ratio = self._unseen = math.nan
        self._printed = -math.inf
        self._line = ""
        self._live: Live | None = None
        if self._console.is_terminal:
            self._live = Live(
                console=self._console, get_renderable=lambda: Text(self._line), refresh_per_second=4
            )
            self._live.start()

    def rates(self, metrics: Mapping[str, float], validated: bool = False) -> None:
        """Set success and length ratio from a line of the log; NaN keeps what is shown.

        Args:
            metrics: of the log.
            validated: show the evaluations during the training, not the episodes that ended.
        """
        trained, unseen = "eval/trained/" if validated else "", "eval/validation/success"
        self._success = _or(metrics.get(f"{trained}success", math.nan), self._success)
        self._ratio = _or(metrics.get(f"{trained}length_ratio", math.nan), self._ratio)
        self._unseen = _or(metrics.get(unseen, math.nan), self._unseen)

    def update(self, frames: int) -> None:
        """Set the number of frames done."""
        now = self._clock()
        if self._recent and now - self._recent[0][0] > 30.0:
            self._recent.popleft()
        self._recent.append((now, frames))
        (then, before) = self._recent[0]
        speed = (frames - before) / (now - then) if now > then else math.nan
        rates = self._success, self._ratio, self._unseen
        line = describe(frames, self._total, speed, *rates, unit=self._unit)
        self._line = printable(line)
        if self._live is None and now - self._printed >= self._every:
            self._print(now)

    def __enter__(self) -> ProgressLine:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Finish, leaving the last line."""
        with suppress(OSError):
            if self._live is not None:
                self._live.stop()
            elif self._line:
                self._print(self._clock())

    def _print(self, now: float) -> None:
        self._printed = now
        with suppress(OSError):
            self._console.print(self._line, soft_wrap=True, highlight=False, markup=False)


class EvaluationProgress:
    """One :class:`ProgressLine` per policy that :func:`vusfa.evaluation.compare` evaluates.

    >>> with EvaluationProgress() as progress:
    ...     result = None  # compare(policies, scenes, "all", progress=progress)
    """

    def __init__(self, console: Console | None = None, every: float = 10.0) -> None:
        self._console = console
        self._every = every
        self._policy: str | None = None
        self._line: ProgressLine | None = None

    def __call__(self, policy: str, done: int, total: int) -> None:
        """Set the number of a policy's episodes done."""
        if policy != self._policy or self._line is None:
            self._close()
            self._policy = policy
            self._line = ProgressLine(total, self._console, self._every, unit=f"episodes of {policy}")
        self._line.update(done)

    def __enter__(self) -> EvaluationProgress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()

    def _close(self) -> None:
        if self._line is not None:
            self._line.close()


def describe(
    frames: int,
    total: int,
    speed: float,
    success: float,
    length_ratio: float,
    unseen: float = math.nan,
    *,
    unit: str = "frames",
) -> str:
    """Format the line; NaN: not known yet.

    >>> describe(250_000, 1_000_000, 5000.0, 0.975, 1.127)
    '250,000 of 1,000,000 frames | 5,000 per second | success 97.5 % | length / shortest 1.13 | 2:30 to go'
    >>> describe(1000, 1000, math.nan, 0.975, math.nan, 0.42)
    '1,000 of 1,000 frames | success 97.5 %, validation goals 42.0 %'
    """
    parts = [f"{frames:,} of {total:,} {unit}"]
    if not math.isnan(speed):
        parts.append(f"{speed:,.0f} per second")
    if not math.isnan(success):
        validation = "" if math.isnan(unseen) else f", validation goals {100 * unseen:.1f} %"
        parts.append(f"success {100 * success:.1f} %{validation}")
    if not math.isnan(length_ratio):
        parts.append(f"length / shortest {length_ratio:.2f}")
    if speed > 0:
        minutes, seconds = divmod(round(max(0, total - frames) / speed), 60)
        hours, minutes = divmod(minutes, 60)
        parts.append((f"{hours}:{minutes:02}" if hours else f"{minutes}") + f":{seconds:02} to go")
    return " | ".join(parts)


def _or(value: float, otherwise: float) -> float:
    return otherwise if math.isnan(value) else value
