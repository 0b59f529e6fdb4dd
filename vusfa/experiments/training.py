"""Training and evaluation of an agent: ``vusfa train`` and the recipes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf

from vusfa.conf.compose import compose
from vusfa.conf.schema import register_schema
from vusfa.evaluation import Comparison, check_comparison, compare, print_summary
from vusfa.files import say
from vusfa.training import (
    EvaluationProgress,
    ProgressLine,
    RunFolder,
    StopOnSignal,
    Trainer,
    make_loggers,
    make_trainer,
    row_name,
    run_training,
    set_threads,
)
from vusfa.training.folder import AUTO, CHECKPOINT, found_checkpoint

__all__ = ["Trained", "compose_settings", "train"]


class Trained(NamedTuple):
    """Result of :func:`train`.

    Attributes:
        trainer: with the trained agent.
        comparison: its evaluation, or None.
        exit_code: 0, or 128 and the number of the signal that ended the training.
    """

    trainer: Trainer
    comparison: Comparison | None
    exit_code: int


def compose_settings(overrides: Sequence[str]) -> DictConfig:
    """Settings of a training, composed from overrides as by ``vusfa train``, and resolved."""
    register_schema()
    settings = compose(overrides=overrides)
    OmegaConf.resolve(settings)
    return settings


def train(settings: Mapping[str, Any], overrides: Sequence[str] = ()) -> Trained:
    """Trains, and leaves metrics, a checkpoint and an evaluation in ``settings["folder"]`` (that of the
    trainer's settings where the caller's are null).

    Args:
        settings: as in vusfa/conf/train.yaml, resolved.
        overrides: their command line, recorded in checkpoints.

    Raises:
        VusfaError: settings that make no sense, or a checkpoint that does not fit them.
        WorkerError, ResultError: see :func:`vusfa.training.run_training`.
    """
    plain: dict[str, Any] = _plain(settings)
    plain = {"overwrite": False, "resume": None, "name": "run", **plain}
    if plain["resume"] == AUTO:
        plain["resume"] = found_checkpoint(plain["folder"])
    set_threads(plain["threads"])
    folder = RunFolder(plain["folder"], plain)
    trainer = make_trainer(plain, overrides)
    if trainer.note is not None:
        say(trainer.note)
    evaluated = plain["evaluation"]["goals"]
    if evaluated:
        check_comparison(trainer.scenes, **_evaluation(trainer))
    if plain["resume"]:
        for change in trainer.resume(plain["resume"]):
            say(f"resumed with {change}")
    with ExitStack() as stack:
        stack.enter_context(folder)
        plain["folder"] = str(folder.path)
        loggers = stack.enter_context(
            make_loggers(
                folder=folder.path,
                config=plain,
                run_id=trainer.run_id,
                resume_frames=trainer.frames if plain["resume"] else None,
                **plain["logger"],
            )
        )
        with StopOnSignal() as stop, ProgressLine(plain["total_frames"]) as progress:
            run_training(trainer, folder.path / CHECKPOINT, loggers, stop, progress)
        loggers.exit_code = stop.exit_code
        comparison = None
        if evaluated and not stop.received:
            comparison = _evaluate(trainer)
            comparison.save(folder.path / "evaluation")
            loggers.log_table("evaluation", comparison.rows, trainer.frames)
            with suppress(BrokenPipeError):
                print_summary(comparison.rows, note=comparison.note)
    return Trained(trainer, comparison, stop.exit_code)


def _evaluation(trainer: Trainer) -> dict[str, Any]:
    """Goals and numbers of the evaluation."""
    chosen = dict(trainer.settings["evaluation"])
    return {**chosen, "goals": trainer.goals if chosen["goals"] == "trained" else chosen["goals"]}


def _evaluate(trainer: Trainer) -> Comparison:
    with EvaluationProgress() as progress:
        return compare(
            {row_name(trainer.settings): trainer.actor},
            trainer.scenes,
            trained=trainer.goals,
            progress=progress,
            history=trainer.agent.config["history"],
            observe=trainer.observation,
            **_evaluation(trainer),
        )


def _plain(value: Any) -> Any:
    """Mappings and sequences, such as OmegaConf's, as dicts and lists."""
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(item) for item in value]
    return value
