"""Loggers to experiment trackers: TensorBoard and Weights & Biases; each needs its library.

Both group panels by what stands before the first ``/`` of a name: ``train``, ``eval``, ``scene``, ``goal``.
"""

from __future__ import annotations

import io
import math
import os
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from PIL import Image

from vusfa.conf.settings import flat
from vusfa.errors import ConfigError
from vusfa.limits import brief
from vusfa.training.facts import versions

__all__ = ["TensorBoardLogger", "WandbLogger", "sweep_run_id"]


class TensorBoardLogger:
    """TensorBoard run: scalars, pictures and films, and configuration and tables as text. Needs
    ``tensorboard``.

    Args:
        folder: the run's folder.
        config: shown under "text".
        resume_frames: frames of the checkpoint that the run continues from; what the earlier files hold of
            later frames, TensorBoard leaves out.
    """

    shows_media = True

    def __init__(
        self, folder: str | Path, config: Mapping[str, Any], resume_frames: int | None = None
    ) -> None:
        from torch.utils.tensorboard import SummaryWriter

        later = None if resume_frames is None else resume_frames + 1
        self._writer: Any = SummaryWriter(str(folder), purge_step=later)
        lines = [{"setting": key, "value": value} for key, value in flat(config).items()]
        self._writer.add_text("config", _markdown(lines))

    def log_metrics(self, metrics: Mapping[str, float], frames: int) -> None:
        """Log every number except NaN, which TensorBoard would draw."""
        for key, value in _in_panels(metrics).items():
            self._writer.add_scalar(key, value, frames)

    def log_checkpoint(self, path: Path, frames: int, is_best: bool = False) -> None:
        """Log its path as text."""
        self._writer.add_text("checkpoint", f"{path}{' (best so far)' if is_best else ''}", frames)

    def log_table(self, name: str, rows: Sequence[Mapping[str, Any]], frames: int) -> None:
        """Log the rows as text."""
        self._writer.add_text(name, _markdown(rows), frames)

    def log_media(self, media: Mapping[str, bytes], frames: int) -> None:
        """Log pictures and films as images; the writer's own ``add_video`` would need moviepy."""
        from tensorboard.compat.proto.summary_pb2 import Summary

        for name, data in media.items():
            width, height = Image.open(io.BytesIO(data)).size
            image = Summary.Image(width=width, height=height, colorspace=3, encoded_image_string=data)
            summary = Summary(value=[Summary.Value(tag=name, image=image)])
            self._writer.file_writer.add_summary(summary, frames)

    def close(self, exit_code: int = 0) -> None:
        """Flush and close the file."""
        self._writer.close()


class WandbLogger:
    """Weights & Biases run: configuration, metrics, tables, pictures and films, checkpoints as artifacts.
    Needs ``wandb``.

    All metrics have the frames as their step. Online, rows are sent at once; of a resumed run, those that W&B
    has already are left out. Offline, rows wait for the next checkpoint: a run that is killed has logged what
    its checkpoint holds (but for wandb's last half second), and resuming, which begins another offline folder
    of the same id, goes on from there. ``wandb sync`` joins the folders.

    Args:
        folder: of wandb's files.
        config: the run's configuration; the versions of this package and its libraries are added.
        run_id: the run's id; one that exists already is continued.
        project: wandb's project.
        mode: ``"online"``, ``"offline"`` (``wandb sync`` sends it later) or ``"disabled"``; None for the
            environment's ``WANDB_MODE``, online without.
        name: the run's name; wandb makes one up without.
        entity: user or team; None for wandb's default.
        group: of runs that belong together, such as the seeds of one experiment.
        tags: of the run.

    Raises:
        ConfigError: an unknown mode, no key, no network, or a name that W&B refuses.
    """

    shows_media = True

    def __init__(
        self,
        folder: str | Path,
        config: Mapping[str, Any],
        run_id: str,
        project: str = "vusfa",
        mode: str | None = None,
        name: str | None = None,
        entity: str | None = None,
        group: str | None = None,
        tags: Sequence[str] = (),
    ) -> None:
        import wandb

        modes = ("online", "offline", "disabled")
        if mode is not None and mode not in modes:
            raise ConfigError(f"logger.mode is {mode!r}; it must be one of {', '.join(modes)}")
        if os.environ.get("WANDB_MODE", "online") not in (
            *modes,
            "shared",
            "dryrun",
            "run",
        ):  # wandb reads it whatever it is given
            found = brief(os.environ["WANDB_MODE"])
            raise ConfigError(f"WANDB_MODE is {found}; set it to one of {', '.join(modes)}, or unset it")
        files = Path(folder) / "wandb"
        missing = [place for place in (files, *files.parents) if not place.exists()]
        Path(folder).mkdir(parents=True, exist_ok=True)  # wandb writes elsewhere where there is no folder
        # Artifacts wait in a staging folder to be sent. By default that is in HOME; keep a run's files
        # together.
        os.environ.setdefault("WANDB_DATA_DIR", str(Path(folder).resolve()))
        # By default wandb writes what it was told every 15 seconds, and a killed run loses that.
        os.environ.setdefault("WANDB_X_TRANSACTION_LOG_FLUSH_INTERVAL", "0.5")
        self._wandb = wandb
        try:
            self.run = wandb.init(
                dir=str(folder),
                config={**config, "versions": versions()},
                project=project,
                entity=entity,
                group=group,
                tags=list(tags),
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
        self.run.define_metric("frames", hidden=True)
        self.run.define_metric("*", step_metric="frames")
        self._waiting: dict[int, dict[str, Any]] = {}  # rows by frames
        self._next_step, self._can_resume = 0, False

    def log_metrics(self, metrics: Mapping[str, float], frames: int) -> None:
        """Log every number except NaN."""
        self._wait(frames, _in_panels(metrics))
        if not self.run.offline:
            self._send()

    def log_checkpoint(self, path: Path, frames: int, is_best: bool = False) -> None:
        """Log the file as a version of the artifact ``checkpoint-RUN``, of type "model", with the aliases
        ``latest`` and, if it is so, ``best``."""
        artifact = self._wandb.Artifact(
            f"checkpoint-{self.run.id}", type="model", metadata={"frames": frames}
        )
        artifact.add_file(str(path))
        self._send()
        self._can_resume = True
        self.run.log_artifact(artifact, aliases=["latest", *(["best"] if is_best else [])])

    def log_table(self, name: str, rows: Sequence[Mapping[str, Any]], frames: int) -> None:
        """Log a wandb table."""
        columns: list[Any] = list(rows[0]) if rows else []
        data = [[None if _is_nan(row[key]) else row[key] for key in columns] for row in rows]
        self._wait(frames, {name: self._wandb.Table(columns=columns, data=data)})

    def log_media(self, media: Mapping[str, bytes], frames: int) -> None:
        """Log pictures as ``wandb.Image`` and films as ``wandb.Video``."""
        self._wait(frames, {name: self._medium(data) for name, data in media.items()})

    def close(self, exit_code: int = 0) -> None:
        """End the run and wait until its files are written or sent."""
        if exit_code == 0 or not self._can_resume:  # else the resumed run logs these rows
            self._send()
        self.run.finish(exit_code=exit_code)

    def _wait(self, frames: int, row: dict[str, Any]) -> None:
        self._waiting.setdefault(frames, {"frames": frames}).update(row)

    def _send(self) -> None:
        for frames, row in self._waiting.items():
            if frames >= self.run.starting_step:  # online, that of a resumed run is behind its last row
                self._next_step = max(frames, self._next_step)
                self.run.log(row, step=self._next_step, commit=True)
                self._next_step += 1
        self._waiting.clear()

    def _medium(self, data: bytes) -> Any:
        picture = Image.open(io.BytesIO(data))
        if picture.format == "GIF":
            return self._wandb.Video(io.BytesIO(data), format="gif")
        return self._wandb.Image(picture)


def sweep_run_id() -> str | None:
    """The id that a sweep's agent has given to this process's run; None outside of a sweep."""
    return os.environ.get("WANDB_RUN_ID") if "WANDB_SWEEP_ID" in os.environ else None


def _in_panels(metrics: Mapping[str, float]) -> dict[str, float]:
    """Numbers except NaN, each under a name with a panel.

    >>> _in_panels({"lr": 0.1, "eval/trained/spl": 0.5, "success": math.nan})
    {'train/lr': 0.1, 'eval/trained/spl': 0.5}
    """
    return {
        key if "/" in key else f"train/{key}": value for key, value in metrics.items() if not _is_nan(value)
    }


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
