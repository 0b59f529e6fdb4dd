"""The loop of a training: updates, lines of the log, checkpoints, and an orderly end."""

from __future__ import annotations

import copy
import math
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from tensordict import TensorDictBase

from vusfa.errors import RankError, ResultError, VusfaError, WorkerError
from vusfa.files import replacing, write_npz
from vusfa.training.folder import BEST, EPISODES
from vusfa.training.loggers import Logger
from vusfa.training.progress import ProgressLine
from vusfa.training.signals import StopOnSignal
from vusfa.training.trainer import Trainer

__all__ = ["SCORE", "Validate", "run_training"]

#: The metric by which the best checkpoint is chosen; more is better.
SCORE = "eval/validation/spl"

#: Evaluation during a training, called at every line of the log with whether it is the last: metrics, the
#: same names each time, NaN where none was due. All ranks call it and get the same.
#: :class:`vusfa.experiments.validation.Validation` is one.
Validate = Callable[[bool], Mapping[str, float]]


def run_training(
    trainer: Trainer,
    checkpoint: Path,
    loggers: Logger,
    stop: StopOnSignal,
    progress: ProgressLine,
    converged: Callable[[], bool] | None = None,
    validate: Validate | None = None,
) -> None:
    """Update until ``total_frames``, convergence or a signal, with lines of the log and checkpoints.

    The ranks of a data-parallel training all call this, and end after the same update.

    Args:
        trainer: new, or resumed.
        checkpoint: file, written at intervals, where :data:`SCORE` is the best so far, and at the end;
            ``best.pt`` beside it is a copy of the best, and ``episodes.npz`` has what is too much for columns
            of the log, :meth:`~vusfa.training.metrics.EpisodeMeter.table`.
        loggers: receive metrics and checkpoints.
        stop: checked after each update.
        progress: the live line.
        converged: called every ``early_stopping.every`` frames; whether the training may end, the same on all
            ranks.
        validate: its metrics join those of the log.

    Raises:
        WorkerError, ResultError: a worker has died, or the system does not take a file. What was learned is
            saved if that is possible, and the message says where.
    """
    with trainer.collecting() as batches:
        try:
            _run(trainer, batches, checkpoint, loggers, stop, progress, converged, validate)
        except (WorkerError, ResultError) as error:
            if not (stop.received and isinstance(error, WorkerError)) or isinstance(error, RankError):
                raise _with_whereabouts(error, trainer, checkpoint, loggers) from error
            loggers.log_checkpoint(trainer.save(checkpoint), trainer.frames)  # the signal was theirs, too


def _run(
    trainer: Trainer,
    batches: Iterator[TensorDictBase],
    checkpoint: Path,
    loggers: Logger,
    stop: StopOnSignal,
    progress: ProgressLine,
    converged: Callable[[], bool] | None,
    validate: Validate | None,
) -> None:
    total, log_every = trainer.settings["total_frames"], trainer.settings["log_every"]
    checkpoint_every = trainer.settings["checkpoint_every"]
    saved, ranks = -1, trainer.ranks
    ranks.signal = lambda: stop.received
    every, ended = trainer.settings["early_stopping"]["every"] if converged else total, False
    while trainer.frames < total and not ranks.stopped and not ended:
        before = trainer.frames
        trainer.update(batches)
        if ranks.size > 1:  # the signal may have been another rank's
            stop.received = ranks.stopped or stop.received
        progress.update(trainer.frames)
        ended = trainer.frames >= total  # a short training is logged, too
        if converged is not None and not ended and before // every < trainer.frames // every:
            with trainer.whole():
                ended = converged()
        is_best = False
        if ended or before // log_every < trainer.frames // log_every:
            validated: Mapping[str, float] = {}
            if validate is not None:
                with trainer.whole():
                    validated = validate(ended)
            metrics = trainer.metrics() | dict(validated)
            loggers.log_metrics(metrics, trainer.frames)
            progress.rates(metrics, validated=validate is not None)
            is_best = metrics.get(SCORE, math.nan) > trainer.validation["best"]
        if is_best or before // checkpoint_every < trainer.frames // checkpoint_every:
            if is_best:
                trainer.validation["best"] = metrics[SCORE]
            _save(trainer, checkpoint, loggers, is_best)
            saved = trainer.frames
    if saved != trainer.frames:
        _save(trainer, checkpoint, loggers)


def _save(trainer: Trainer, checkpoint: Path, loggers: Logger, is_best: bool = False) -> None:
    trainer.save(checkpoint)
    if not trainer.ranks.is_first:
        return
    if trainer.episodes.is_aggregated:
        write_npz(checkpoint.with_name(EPISODES), trainer.episodes.table())
    if is_best:
        with replacing(checkpoint.with_name(BEST)) as unfinished:
            shutil.copyfile(checkpoint, unfinished)
    loggers.log_checkpoint(checkpoint, trainer.frames, is_best)


def _with_whereabouts(error: VusfaError, trainer: Trainer, checkpoint: Path, loggers: Logger) -> VusfaError:
    kept = f"resume from {checkpoint}" if checkpoint.is_file() else "there is no checkpoint yet"
    if trainer.ranks.is_first:
        with suppress(VusfaError):
            loggers.log_checkpoint(trainer.save(checkpoint), trainer.frames)
            kept = f"all {trainer.frames:,} frames are in {checkpoint}: resume it"
    whole = copy.copy(error)
    whole.args = (f"{error}; {kept}",)
    return whole
