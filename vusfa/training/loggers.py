"""Loggers of a training: a CSV file, TensorBoard, Weights & Biases, behind one protocol.

TorchRL's loggers (:mod:`torchrl.record.loggers`) were looked at and left: its CSVLogger writes one file per
scalar and appends on resuming, where ours is one table whose later rows are taken out first, so that the
file of a resumed run is that of an uninterrupted one; its TensorboardLogger and WandbLogger have neither
tables nor checkpoints as artifacts, encode films with moviepy, and log a resumed run's rows twice.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol

from vusfa.errors import ConfigError, ResultError, VusfaError
from vusfa.files import cannot_write, check_file, say, write_csv, write_json
from vusfa.limits import MAX_LOG_BYTES, one_line
from vusfa.reading import open_regular
from vusfa.training.trackers import TensorBoardLogger, WandbLogger

__all__ = ["CSVLogger", "Logger", "Loggers", "make_loggers"]

_AWAY = "move it away, and the run begins another"


class Logger(Protocol):
    """Receiver of metrics, checkpoints, tables and media.

    Attributes:
        shows_media: whether :meth:`log_media` does anything.
    """

    shows_media: bool

    def log_metrics(self, metrics: Mapping[str, float], frames: int) -> None:
        """Log a row of numbers after ``frames`` frames; NaN: a rate over no episode."""

    def log_checkpoint(self, path: Path, frames: int, is_best: bool = False) -> None:
        """Log a checkpoint, which is written; ``is_best``: it has the best score so far."""

    def log_table(self, name: str, rows: Sequence[Mapping[str, Any]], frames: int) -> None:
        """Log a table of results, such as the summary of an evaluation."""

    def log_media(self, media: Mapping[str, bytes], frames: int) -> None:
        """Log pictures (PNG) and films (GIF) by name."""

    def close(self, exit_code: int = 0) -> None:
        """Finish: nothing follows."""


class CSVLogger:
    """CSV files: ``metrics.csv`` with one row per call, ``NAME.csv`` per table; and ``config.json``.

    Rows are appended. Rows later than ``resume_frames`` (the run continued after its last checkpoint, then
    died) are removed first: the file of a resumed run equals that of an uninterrupted one.

    Args:
        folder: of the files.
        config: written to ``config.json``.
        resume_frames: frames of the checkpoint that the run continues from; None for a new run.

    >>> import tempfile
    >>> folder = tempfile.mkdtemp()
    >>> log = CSVLogger(folder, {"seed": 1})
    >>> log.log_metrics({"loss": 0.5, "success": math.nan}, frames=100)
    >>> log.close()
    >>> (Path(folder) / "metrics.csv").read_text()
    'frames,loss,success\\n100,0.5,\\n'
    """

    shows_media = False

    def __init__(
        self, folder: str | Path, config: Mapping[str, Any], resume_frames: int | None = None
    ) -> None:
        self.folder = Path(folder)
        self._config = dict(config)
        self._file = self.folder / "metrics.csv"
        self._resume_frames = resume_frames
        self._columns: list[str] | None = None
        self._begun = False
        if resume_frames is not None and check_file(self._file).exists():
            for _ in self._kept():  # what cannot be read shows before any work
                pass

    def _begin(self) -> None:
        """Create the files at the first call: a training that cannot begin leaves none."""
        if self._begun:
            return
        self._begun = True
        write_json(self.folder / "config.json", self._config)
        if self._columns:
            write_csv(self._file, self._kept(), self._columns)
        else:
            self._file.unlink(missing_ok=True)

    def _kept(self) -> Iterator[dict[str, str]]:
        """Rows of the file up to the frames of the checkpoint, one at a time."""
        number = 1
        try:
            with open_regular(self._file, MAX_LOG_BYTES) as binary:
                reader = csv.reader(io.TextIOWrapper(binary, encoding="utf-8", newline=""))
                names = next(reader, None)
                if names is None:
                    return
                place = names.index("frames")
                # once it was written again, its names are :func:`~vusfa.errors.printable`
                self._columns, last = self._columns or names, self._resume_frames
                for fields in reader:
                    number = reader.line_num
                    is_whole = len(fields) >= len(names)  # else cut off in the writing
                    if is_whole and (last is None or int(fields[place] or 0) <= last):
                        yield dict(zip(self._columns, fields, strict=False))
        except (OSError, ValueError, csv.Error) as fault:
            raise ResultError(
                f"{self._file}: cannot be read, row {number} ({one_line(fault)}); {_AWAY}"
            ) from fault

    def log_metrics(self, metrics: Mapping[str, float], frames: int) -> None:
        """Append one row; a column that earlier rows do not have is empty there.

        Raises:
            ResultError: the file cannot be written, or is gone.
        """
        self._begin()
        row = {"frames": frames, **metrics}
        if self._columns is not None and not self._file.is_file():
            raise ResultError(f"{self._file}: removed or renamed since the run began; its folder must stay")
        if self._columns is not None and set(row) - set(self._columns):
            self._resume_frames, columns = None, list(dict.fromkeys([*self._columns, *row]))
            write_csv(self._file, self._kept(), columns)
            self._columns = columns
        try:
            with open(self._file, "a", newline="", encoding="utf-8") as file:
                writer = csv.DictWriter(file, self._columns or list(row), lineterminator="\n")
                if self._columns is None:
                    writer.writeheader()
                writer.writerow(
                    {k: "" if isinstance(v, float) and math.isnan(v) else v for k, v in row.items()}
                )
        except OSError as error:
            raise cannot_write(self._file, error) from error
        self._columns = self._columns or list(row)

    def log_checkpoint(self, path: Path, frames: int, is_best: bool = False) -> None:
        """Nothing to do: the file itself is the record."""
        self._begin()

    def log_media(self, media: Mapping[str, bytes], frames: int) -> None:
        """Nothing to do: a table has no pictures."""

    def log_table(self, name: str, rows: Sequence[Mapping[str, Any]], frames: int) -> None:
        """Write ``NAME.csv``."""
        self._begin()
        write_csv(self.folder / f"{name}.csv", rows)

    def close(self, exit_code: int = 0) -> None:
        """Nothing to do: no file is open."""


class Loggers:
    """Several loggers as one. As a context manager it closes them on exit.

    Attributes:
        exit_code: passed to ``close``; 1 after an exception.
        shows_media: whether any of them does.
    """

    def __init__(self, loggers: Sequence[Logger]) -> None:
        self.loggers = tuple(loggers)
        self.exit_code = 0
        self.shows_media = any(logger.shows_media for logger in loggers)

    def __enter__(self) -> Loggers:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close(self.exit_code if error is None else 1)

    def log_metrics(self, metrics: Mapping[str, float], frames: int) -> None:
        """See :class:`Logger`."""
        self._tell("log_metrics", metrics, frames)

    def log_checkpoint(self, path: Path, frames: int, is_best: bool = False) -> None:
        """See :class:`Logger`."""
        self._tell("log_checkpoint", path, frames, is_best)

    def log_table(self, name: str, rows: Sequence[Mapping[str, Any]], frames: int) -> None:
        """See :class:`Logger`."""
        self._tell("log_table", name, rows, frames)

    def log_media(self, media: Mapping[str, bytes], frames: int) -> None:
        """See :class:`Logger`."""
        self._tell("log_media", media, frames)

    def close(self, exit_code: int = 0) -> None:
        """See :class:`Logger`."""
        self._tell("close", exit_code)

    def _tell(self, method: str, *arguments: Any) -> None:
        """Tells each logger; a tracker whose disk or network fails is left behind, the run goes on."""
        for logger in self.loggers:
            try:
                getattr(logger, method)(*arguments)
            except VusfaError:
                raise
            except (OSError, RuntimeError, TimeoutError) as error:
                name, reason = type(logger).__name__, " ".join(str(error).split())
                say(f"warning: {name} has failed ({reason}); the run goes on without it")
                self.loggers = tuple(other for other in self.loggers if other is not logger)


def make_loggers(
    kinds: Sequence[str],
    folder: str | Path,
    config: Mapping[str, Any],
    *,
    run_id: str,
    resume_frames: int | None = None,
    project: str = "vusfa",
    mode: str | None = None,
    name: str | None = None,
    entity: str | None = None,
    group: str | None = None,
    tags: Sequence[str] = (),
) -> Loggers:
    """Loggers by name: ``csv``, ``tensorboard``, ``wandb``.

    Args:
        kinds: names.
        folder: of their files.
        config: the run's configuration, plain data.
        run_id: the run's id, the same when it is resumed.
        resume_frames: frames of the checkpoint that the run continues from; None for a new run.
        project, mode, name, entity, group, tags: of :class:`WandbLogger`.

    Raises:
        ConfigError: unknown kind, its library is not installed, or wandb cannot begin.
    """
    makers: dict[str, Callable[[], Logger]] = {
        "csv": lambda: CSVLogger(folder, config, resume_frames),
        "tensorboard": lambda: TensorBoardLogger(Path(folder) / "tensorboard", config, resume_frames),
        "wandb": lambda: WandbLogger(folder, config, run_id, project, mode, name, entity, group, tags),
    }
    for kind in kinds:
        if kind not in makers:
            raise ConfigError(f"logger.kinds holds {kind!r}; it may hold {', '.join(makers)}")
    loggers = []
    for kind in sorted(kinds, key="wandb".__ne__):  # wandb first: it may refuse, and then nothing is made yet
        try:
            loggers.append(makers[kind]())
        except ImportError as error:
            raise ConfigError(f"logger {kind} needs {error.name}; pip install 'vusfa[recipes]'") from error
    return Loggers(loggers)
