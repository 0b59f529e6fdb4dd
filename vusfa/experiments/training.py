"""Training and evaluation of an agent: ``vusfa train`` and the recipes."""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, redirect_stderr, suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf

from vusfa.conf.compose import compose
from vusfa.conf.schema import register_schema
from vusfa.envs import resolve_goals
from vusfa.errors import RankError
from vusfa.evaluation import Comparison, Episodes, check_comparison, compare, print_summary
from vusfa.evaluation.parts import evaluate_parts, parts_of
from vusfa.experiments.measure import measure_goals
from vusfa.experiments.validation import Draw, Validation
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
from vusfa.training.precision import describe_autocast
from vusfa.training.ranks import Ranks
from vusfa.training.rendezvous import joined
from vusfa.training.scene_files import settings_seen_from
from vusfa.training.setup import decide_autocast
from vusfa.training.trackers import sweep_run_id

__all__ = ["Trained", "compose_settings", "train"]


_WORKERS = (
    "collector={kind}: one learner and {num_workers} workers; on as many cores"
    " torchrun --nproc-per-node={num_workers} -m vusfa.cli train collector=single is faster (docs/scaling.md)"
)


class Trained(NamedTuple):
    """The result of :func:`train`.

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


def train(settings: Mapping[str, Any], overrides: Sequence[str] = (), draw: Draw | None = None) -> Trained:
    """Train, and leave metrics, checkpoints and an evaluation in ``settings["folder"]`` (that of the
    trainer's settings where the caller's are null). The last lines say where, and whether a random walk does
    better. Where the environment names several ranks (torchrun), this process is one of them, see
    :mod:`vusfa.training.rendezvous`; the first leaves the files.

    Args:
        settings: as in vusfa/conf/train.yaml, resolved.
        overrides: their command line, recorded in checkpoints.
        draw: makes media for trackers at every evaluation during the training, such as
            :func:`vusfa.report.media.draw_media`.

    Raises:
        VusfaError: settings that make no sense, or a checkpoint that does not fit them.
        WorkerError, ResultError: see :func:`vusfa.training.run_training`.
    """
    plain: dict[str, Any] = _plain(settings)
    plain = {"overwrite": False, "resume": None, "name": "run", **plain}
    if plain["resume"] == AUTO:
        plain["resume"] = found_checkpoint(plain["folder"])
    set_threads(plain["threads"])
    with joined(plain) as ranks, ExitStack() as stack:
        if not ranks.is_first:  # what all find, the first says
            stack.enter_context(redirect_stderr(stack.enter_context(open(os.devnull, "w"))))
        return _train(plain, overrides, draw, ranks)


def _train(plain: dict[str, Any], overrides: Sequence[str], draw: Draw | None, ranks: Ranks) -> Trained:
    with ranks.preparing():
        folder = RunFolder(plain["folder"], plain) if ranks.is_first else None
        decided, plain["autocast"] = plain["autocast"] == "auto", decide_autocast(plain)
    plain["autocast"] = ranks.first(lambda: plain["autocast"])  # machines may differ
    evaluated = plain["evaluation"]["goals"]
    with ranks.preparing():
        trainer = make_trainer(plain, overrides, ranks=ranks)
        if evaluated:
            check_comparison(trainer.scenes, **_evaluation(trainer))
        changes = trainer.resume(plain["resume"]) if plain["resume"] else []
    ranks.equalize(list(trainer.algorithm.parameters()))
    if not plain["resume"] and "wandb" in plain["logger"]["kinds"]:
        trainer.run_id = sweep_run_id() or trainer.run_id
    with ExitStack() as stack:
        if folder is not None:
            plain["folder"] = str(stack.enter_context(folder).path)
        plain["folder"] = ranks.first(lambda: plain["folder"])
        place, log = Path(plain["folder"]), plain["logger"]
        loggers = stack.enter_context(
            make_loggers(
                folder=place,
                config=settings_seen_from(place, plain),
                run_id=trainer.run_id,
                resume_frames=trainer.frames if plain["resume"] else None,
                **(log if ranks.is_first else {**log, "kinds": []}),
            )
        )
        path, validation = place / CHECKPOINT, None
        notes = [] if trainer.note is None else [trainer.note]
        if ranks.size > 1:
            rows = plain["collector"]["num_envs"] // ranks.size
            notes.append(f"{ranks.size} ranks with {rows} environments each")
        if plain["collector"]["kind"] in ("multi_sync", "multi_async"):
            notes.append(_WORKERS.format(**plain["collector"]))
        precision = describe_autocast(plain["autocast"], decided=decided)
        for line in (precision, *notes, *(f"resumed with {change}" for change in changes)):
            say(line)
        with StopOnSignal() as stop, ProgressLine(plain["total_frames"]) as progress:
            stops_early = plain["early_stopping"]["success"] is not None
            converged = partial(_converged, trainer) if stops_early else None
            if plain["evaluation"].get("interval", "auto") is not None:
                validation = Validation(trainer, loggers, draw)
            run_training(trainer, path, loggers, stop, progress, converged, validation)
        loggers.exit_code = stop.exit_code
        stopped = ranks.first(lambda: stop.received)
        comparison = _evaluate(trainer, path) if evaluated and not stopped else None
        if not ranks.is_first:
            return Trained(trainer, None, stop.exit_code)
        if comparison is not None:
            comparison.save(place / "evaluation")
            loggers.log_table("evaluation", comparison.rows, trainer.frames)
            with suppress(BrokenPipeError):
                print_summary(comparison.rows, note=comparison.note)
    run = shlex.quote(str(place))
    say(f"next: vusfa report {run}, vusfa film {run}, vusfa evaluate {run}")
    say(str(path))
    if validation is not None and not stop.received and (advice := validation.advice()):
        say(advice)
    return Trained(trainer, comparison, stop.exit_code)


def _converged(trainer: Trainer) -> bool:
    """Whether enough of the episodes to the trained goals arrive; prints how many."""
    chosen = trainer.settings["early_stopping"]
    limits = {name: chosen[name] for name in ("episodes_per_goal", "max_steps")}
    success = measure_goals(trainer, trainer.goals.unique(), **limits).success.nanmean().item()
    say(
        f"after {trainer.frames:,} frames {100 * success:.1f} % of the episodes to the trained goals arrive"
        f" within {chosen['max_steps']} steps"
    )
    return success >= chosen["success"]


def _evaluation(trainer: Trainer) -> dict[str, Any]:
    """Goals and numbers of the evaluation at the end."""
    chosen = {key: value for key, value in trainer.settings["evaluation"].items() if key != "interval"}
    return {**chosen, "goals": trainer.goals if chosen["goals"] == "trained" else chosen["goals"]}


def _evaluate(trainer: Trainer, checkpoint: Path) -> Comparison | None:
    """The evaluation at the end, shared out among ranks; on rank 0."""
    name, ranks = row_name(trainer.settings), trainer.ranks
    scenes = trainer.scenes.to(next(trainer.agent.parameters()).device)
    chosen = _evaluation(trainer)
    goals = chosen.pop("goals")
    parts = parts_of(scenes, resolve_goals(scenes, goals), chosen["episodes_per_goal"])
    try:
        with EvaluationProgress() as progress:
            own = evaluate_parts(
                trainer.acting,
                scenes,
                parts,
                ranks.own_parts,
                trained=trainer.goals,
                progress=partial(progress, name),
                history=trainer.agent.config["history"],
                observe=trainer.observation,
                **chosen,
            )
            tables = ranks.collect(own)
    except RankError as error:
        error.args = (f"{error}; the agent is in {checkpoint}: evaluate it",)
        raise
    if not ranks.is_first:
        return None
    chosen |= {"history": trainer.agent.config["history"]}
    walked = Episodes.joined(tables)
    return compare({name: walked}, trainer.scenes, goals, trained=trainer.goals, **chosen)


def _plain(value: Any) -> Any:
    """Mappings and sequences, such as OmegaConf's, as dicts and lists."""
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(item) for item in value]
    return value
