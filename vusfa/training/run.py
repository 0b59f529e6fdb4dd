"""A training from its first update to its last, or to what ends it before."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from tensordict import TensorDictBase

from vusfa.errors import ResultError, VusfaError, WorkerError
from vusfa.training.loggers import Logger
from vusfa.training.progress import ProgressLine
from vusfa.training.signals import StopOnSignal
from vusfa.training.trainer import Trainer

__all__ = ["run_training"]


def run_training(
    trainer: Trainer,
    checkpoint: Path,
    loggers: Logger,
    stop: StopOnSignal,
    progress: ProgressLine,
    converged: Callable[[], bool] | None = None,
) -> None:
    """Updates until ``total_frames``, convergence or a signal, with lines of the log and checkpoints.

    Args:
        trainer: new, or resumed.
        checkpoint: file, written at intervals and at the end.
        loggers: get metrics and checkpoints.
        stop: looked at after each update.
        progress: the live line.
        converged: asked every ``early_stopping.every`` frames whether the training may end.

    Raises:
        WorkerError, ResultError: a worker has died, or the system does not take a file. What was learned is
            saved if that is possible, and the message says where.
    """
    with trainer.collecting() as batches:
        try:
            _run(trainer, batches, checkpoint, loggers, stop, progress, converged)
        except (WorkerError, ResultError) as error:
            if not (stop.received and isinstance(error, WorkerError)):
                raise _with_whereabouts(error, trainer, checkpoint) from error
            loggers.log_checkpoint(trainer.save(checkpoint), trainer.frames)  # the signal was theirs, too


def _run(
    trainer: Trainer,
    batches: Iterator[TensorDictBase],
    checkpoint: Path,
    loggers: Logger,
    stop: StopOnSignal,
    progress: ProgressLine,
    converged: Callable[[], bool] | None,
) -> None:
    total, log_every = trainer.settings["total_frames"], trainer.settings["log_every"]
    checkpoint_every = trainer.settings["checkpoint_every"]
    every, ended = trainer.settings["early_stopping"]["every"] if converged else total, False
    while trainer.frames < total and not stop.received and not ended:
        before = trainer.frames
        trainer.update(batches)
        progress.update(trainer.frames)
        ended = trainer.frames >= total  # a short training is logged, too
        if converged is not None and not ended and before // every < trainer.frames // every:
            ended = converged()
        if ended or before // log_every < trainer.frames // log_every:
            metrics = trainer.metrics()
            loggers.log_metrics(metrics, trainer.frames)
            progress.rates(metrics["success"], metrics["length_ratio"])
        if before // checkpoint_every < trainer.frames // checkpoint_every:
            loggers.log_checkpoint(trainer.save(checkpoint), trainer.frames)
    loggers.log_checkpoint(trainer.save(checkpoint), trainer.frames)


def _with_whereabouts(error: VusfaError, trainer: Trainer, checkpoint: Path) -> VusfaError:
    try:
        trainer.save(checkpoint)
        return type(error)(f"{error}; all {trainer.frames:,} frames are in {checkpoint}: resume it")
    except VusfaError:
        kept = f"{checkpoint} is as it was" if checkpoint.is_file() else "there is no checkpoint yet"
        return type(error)(f"{error}; {kept}")
