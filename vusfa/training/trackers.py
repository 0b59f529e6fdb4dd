"""Loggers to experiment trackers: TensorBoard and Weights & Biases; each needs its library."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from vusfa.conf.settings import flat
from vusfa.errors import ConfigError

__all__ = ["TensorBoardLogger", "WandbLogger"]


class TensorBoardLogger:
    """TensorBoard run: scalars, and configuration and tables as text. Needs ``tensorboard``.

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
        """Log every number except NaN, which TensorBoard would draw."""
        for key, value in metrics.items():
            if not math.isnan(value):
                self._writer.add_scalar(key, value, frames)

    def log_checkpoint(self, path: Path, frames: int) -> None:
        """Log its path as text."""
        self._writer.add_text("checkpoint", str(path), frames)

    def log_table(self, name: str, rows: Sequence[Mapping[str, Any]], frames: int) -> None:
        """Log the rows as text."""
        self._writer.add_text(name, _markdown(rows), frames)

    def close(self, exit_code: int = 0) -> None:
        """Flush and close the file."""
        self._writer.close()


class WandbLogger:
    """Weights & Biases run: configuration, metrics, checkpoints as artifacts, tables. Needs ``wandb``.

    Without a network, ``mode="offline"`` keeps everything in ``folder`` (``wandb sync`` sends it later), or
    ``mode="disabled"`` does nothing.

    Args:
        folder: of wandb's files.
        config: the run's configuration.
        run_id: the run's id; one that exists already is continued.
        project: wandb's project.
        mode: ``"online"``, ``"offline"`` or ``"disabled"``; None for the environment's ``WANDB_MODE``, online
            without.
        name: the run's name; wandb makes one up without.
    """

    def __init__(
        self,
        folder: str | Path,
        config: Mapping[str, Any],
        run_id: str,
        project: str = "vusfa",
        mode: str | None = None,
        name: str | None = None,
    ) -> None:
        import wandb

        modes = ("online", "offline", "disabled")
        if mode is not None and mode not in modes:
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
        """Log every number except NaN."""
        self.run.log({"frames": frames, **{k: v for k, v in metrics.items() if not math.isnan(v)}})

    def log_checkpoint(self, path: Path, frames: int) -> None:
        """Log the file as a version of the artifact ``checkpoint-RUN``, of type "model"."""
        artifact = self._wandb.Artifact(
            f"checkpoint-{self.run.id}", type="model", metadata={"frames": frames}
        )
        artifact.add_file(str(path))
        self.run.log_artifact(artifact)

    def log_table(self, name: str, rows: Sequence[Mapping[str, Any]], frames: int) -> None:
        """Log a wandb table."""
        columns: list[Any] = list(rows[0]) if rows else []
        data = [[None if _is_nan(row[key]) else row[key] for key in columns] for row in rows]
        self.run.log({"frames": frames, name: self._wandb.Table(columns=columns, data=data)})

    def close(self, exit_code: int = 0) -> None:
        """End the run and wait until its files are written or sent."""
        self.run.finish(exit_code=exit_code)


def _markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    if not rows:
        return ""
    lines = [list(rows[0]), ["---"] * len(rows[0]), *([f"{value}" for value in row.values()] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _take_back(made: Sequence[Path]) -> None:
    """Remove the first folder with its content, and the outer ones if they are empty."""
    for place in made[:1]:
        shutil.rmtree(place, ignore_errors=True)
    for place in made[1:]:
        with suppress(OSError):
            place.rmdir()


def _is_nan(value: Any) -> bool:
    return isinstance(value, float) and math.isnan(value)
