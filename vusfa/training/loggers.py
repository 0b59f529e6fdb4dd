"""Where numbers go: a CSV file, TensorBoard, Weights & Biases. Each of them a few lines behind one
protocol."""

from __future__ import annotations

import csv
import math
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol

from vusfa.conf.settings import flat
from vusfa.errors import ConfigError
from vusfa.files import write_csv, write_json

__all__ = ["CSVLogger", "Logger", "Loggers", "TensorBoardLogger", "WandbLogger", "make_loggers"]


class Logger(Protocol):
    """What a training tells of itself."""

    def log_metrics(self, metrics: Mapping[str, float], frames: int) -> None:
        """Numbers after so many frames; NaN stands for a rate over nothing."""

    def log_checkpoint(self, path: Path, frames: int) -> None:
        """A checkpoint has been written."""

    def log_table(self, name: str, rows: Sequence[Mapping[str, Any]], frames: int) -> None:
        """A table of results, such as an evaluation's summary."""

    def close(self, exit_code: int = 0) -> None:
        """Nothing more comes."""


class CSVLogger:
    """``metrics.csv`` with one row a call, ``NAME.csv`` for every table, ``config.json``; needs nothing
    installed.

    Rows are appended as they come. Where the file has later rows than ``resume_frames`` (the run went on
    after its last checkpoint, then died), these are taken out first: a resumed run's file is that of a run
    without interruption.

    Args:
        folder: where to.
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

    def __init__(
        self, folder: str | Path, config: Mapping[str, Any], resume_frames: int | None = None
    ) -> None:
        self.folder = Path(folder)
        self._config = dict(config)
        self._file = self.folder / "metrics.csv"
        self._resume_frames = resume_frames
        self._columns: list[str] | None = None
        self._begun = False

    def _begin(self) -> None:
        """Only now, so that a training that cannot begin leaves nothing behind."""
        if self._begun:
            return
        self._begun = True
        write_json(self.folder / "config.json", self._config)
        if self._resume_frames is None:
            self._file.unlink(missing_ok=True)
        elif self._file.is_file():
            with open(self._file, newline="", encoding="utf-8") as file:
                reader = csv.DictReader(file)
                kept = [row for row in reader if _frames(row) <= self._resume_frames]
                self._columns = list(reader.fieldnames or ()) or None
            write_csv(self._file, kept, self._columns)

    def log_metrics(self, metrics: Mapping[str, float], frames: int) -> None:
        """Append one row; the first one decides on the columns."""
        self._begin()
        row = {"frames": frames, **metrics}
        new = self._columns is None
        self._columns = self._columns or list(row)
        if set(row) - set(self._columns):
            raise ValueError(f"metrics.csv has no column {sorted(set(row) - set(self._columns))[0]!r}")
        with open(self._file, "a", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, self._columns, lineterminator="\n")
            if new:
                writer.writeheader()
            writer.writerow({k: "" if isinstance(v, float) and math.isnan(v) else v for k, v in row.items()})

    def log_checkpoint(self, path: Path, frames: int) -> None:
        """The file itself is the record."""
        self._begin()

    def log_table(self, name: str, rows: Sequence[Mapping[str, Any]], frames: int) -> None:
        """Write ``NAME.csv``."""
        self._begin()
        write_csv(self.folder / f"{name}.csv", rows)

    def close(self, exit_code: int = 0) -> None:
        """Nothing is open."""


class TensorBoardLogger:
    """Scalars, the configuration and the tables (as text) in a TensorBoard run; needs ``tensorboard``.

    Args:
        folder: the run's folder.
        config: shown under "text".
    """

    def __init__(self, folder: str | Path, config: Mapping[str, Any]) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self._writer = SummaryWriter(str(folder))
        lines = [{"setting": key, "value": value} for key, value in flat(config).items()]
        self._writer.add_text("config", _markdown(lines))

    def log_metrics(self, metrics: Mapping[str, float], frames: int) -> None:
        """Every number but NaN, which TensorBoard would draw."""
        for key, value in metrics.items():
            if not math.isnan(value):
                self._writer.add_scalar(key, value, frames)

    def log_checkpoint(self, path: Path, frames: int) -> None:
        """Its path, as text."""
        self._writer.add_text("checkpoint", str(path), frames)

    def log_table(self, name: str, rows: Sequence[Mapping[str, Any]], frames: int) -> None:
        """As text."""
        self._writer.add_text(name, _markdown(rows), frames)

    def close(self, exit_code: int = 0) -> None:
        """Write what is left and close the file."""
        self._writer.close()


class WandbLogger:
    """A run at Weights & Biases: configuration, metrics, checkpoints as artifacts, tables; needs ``wandb``.

    Without a network, ``mode="offline"`` keeps everything in ``folder`` (``wandb sync`` sends it later), or
    ``mode="disabled"`` does nothing.

    Args:
        folder: where wandb keeps its files.
        config: the run's configuration.
        run_id: the run's id; one that exists already is continued.
        project: wandb's project.
        mode: ``"online"``, ``"offline"`` or ``"disabled"``.
        name: the run's name; wandb makes one up without.
    """

    def __init__(
        self,
        folder: str | Path,
        config: Mapping[str, Any],
        run_id: str,
        project: str = "vusfa",
        mode: str = "online",
        name: str | None = None,
    ) -> None:
        import wandb

        modes = ("online", "offline", "disabled")
        if mode not in modes:
            raise ConfigError(f"logger.mode is {mode!r}; it must be one of {', '.join(modes)}")
        files = Path(folder) / "wandb"
        missing = [place for place in (files, *files.parents) if not place.exists()]
        Path(folder).mkdir(parents=True, exist_ok=True)  # wandb writes elsewhere where there is no folder
        # Artifacts wait in a staging folder to be sent. By default that is in HOME; keep a run's files
        # together.
        os.environ.setdefault("WANDB_DATA_DIR", str(Path(folder).resolve()))
        self._wandb = wandb
        try:
            self.run = wandb.init(
                dir=str(folder),
                config=dict(config),
                project=project,
                mode=mode,  # type: ignore[arg-type]
                name=name,
                id=run_id,
                resume="allow",
                settings=wandb.Settings(silent=True),
            )
        except Exception as error:  # no key, no network, a project's name that it does not like
            _take_back(missing)
            reason = " ".join(str(error).split())
            raise ConfigError(
                f"logger wandb cannot begin ({reason}); run 'wandb login', or give logger.mode=offline"
            ) from error
        self.run.define_metric("*", step_metric="frames")

    def log_metrics(self, metrics: Mapping[str, float], frames: int) -> None:
        """Every number but NaN."""
        self.run.log({"frames": frames, **{k: v for k, v in metrics.items() if not math.isnan(v)}})

    def log_checkpoint(self, path: Path, frames: int) -> None:
        """The file as a version of the artifact ``checkpoint-RUN``, of type "model"."""
        artifact = self._wandb.Artifact(
            f"checkpoint-{self.run.id}", type="model", metadata={"frames": frames}
        )
        artifact.add_file(str(path))
        self.run.log_artifact(artifact)

    def log_table(self, name: str, rows: Sequence[Mapping[str, Any]], frames: int) -> None:
        """A wandb table."""
        columns: list[Any] = list(rows[0]) if rows else []
        data = [[None if _is_nan(row[key]) else row[key] for key in columns] for row in rows]
        self.run.log({"frames": frames, name: self._wandb.Table(columns=columns, data=data)})

    def close(self, exit_code: int = 0) -> None:
        """End the run and wait until its files are written or sent."""
        self.run.finish(exit_code=exit_code)


class Loggers:
    """Several loggers as one; whatever happens is told to each. As a context, closes them on the way out.

    Attributes:
        exit_code: what to close them with; an exception closes them with 1.
    """

    def __init__(self, loggers: Sequence[Logger]) -> None:
        self.loggers = tuple(loggers)
        self.exit_code = 0

    def __enter__(self) -> Loggers:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close(self.exit_code if error is None else 1)

    def log_metrics(self, metrics: Mapping[str, float], frames: int) -> None:
        """See :class:`Logger`."""
        for logger in self.loggers:
            logger.log_metrics(metrics, frames)

    def log_checkpoint(self, path: Path, frames: int) -> None:
        """See :class:`Logger`."""
        for logger in self.loggers:
            logger.log_checkpoint(path, frames)

    def log_table(self, name: str, rows: Sequence[Mapping[str, Any]], frames: int) -> None:
        """See :class:`Logger`."""
        for logger in self.loggers:
            logger.log_table(name, rows, frames)

    def close(self, exit_code: int = 0) -> None:
        """See :class:`Logger`."""
        for logger in self.loggers:
            logger.close(exit_code)


def make_loggers(
    kinds: Sequence[str],
    folder: str | Path,
    config: Mapping[str, Any],
    *,
    run_id: str,
    resume_frames: int | None = None,
    project: str = "vusfa",
    mode: str = "online",
    name: str | None = None,
) -> Loggers:
    """Loggers by name: any of ``csv``, ``tensorboard`` and ``wandb``.

    Args:
        kinds: which ones.
        folder: where their files go.
        config: the run's configuration, plain data.
        run_id: the run's id, the same when it is resumed.
        resume_frames: frames of the checkpoint that the run continues from; None for a new run.
        project, mode, name: of :class:`WandbLogger`.

    Raises:
        ConfigError: unknown kind, its library is not installed, or wandb cannot begin.
    """
    makers: dict[str, Callable[[], Logger]] = {
        "csv": lambda: CSVLogger(folder, config, resume_frames),
        "tensorboard": lambda: TensorBoardLogger(Path(folder) / "tensorboard", config),
        "wandb": lambda: WandbLogger(folder, config, run_id, project, mode, name),
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


def _markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    if not rows:
        return ""
    lines = [list(rows[0]), ["---"] * len(rows[0]), *([f"{value}" for value in row.values()] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _frames(row: Mapping[str, str | None]) -> int:
    """Frames of a row of ``metrics.csv``; a row that was cut off in the writing counts as later than all."""
    complete = None not in row.values()
    return int(row["frames"] or 0) if complete else 1 << 62


def _take_back(made: Sequence[Path]) -> None:
    """Remove folders, the innermost first, with what is in it; an outer one only if nothing else is."""
    for place in made[:1]:
        shutil.rmtree(place, ignore_errors=True)
    for place in made[1:]:
        with suppress(OSError):
            place.rmdir()


def _is_nan(value: Any) -> bool:
    return isinstance(value, float) and math.isnan(value)
