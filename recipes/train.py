"""Trains one of the four models: python recipes/train.py agent.model=vusfa scenes=[bathroom]

Settings are in vusfa/conf/train.yaml and the folders beside it. The run's folder gets metrics.csv and
checkpoint.pt, and at the end evaluation.csv, .json and evaluation_episodes.csv. To go on: python
recipes/train.py resume=RUN/checkpoint.pt
"""

from __future__ import annotations

import sys
import time
from typing import Any

from omegaconf import DictConfig, OmegaConf

from vusfa.conf import FOLDER as CONF
from vusfa.evaluation import Comparison, check_comparison, compare, print_summary
from vusfa.files import check_folder
from vusfa.training import (
    EvaluationProgress,
    ProgressLine,
    Session,
    StopOnSignal,
    make_loggers,
    make_training,
    row_name,
    set_threads,
)
from vusfa.training.launch import launch


def train(cfg: DictConfig, overrides: list[str]) -> tuple[Session, Comparison | None, int]:
    """Trains, and leaves a checkpoint and an evaluation in ``cfg.folder``.

    Args:
        cfg: settings, as in vusfa/conf/train.yaml.
        overrides: the command line that made them, for whoever resumes.

    Returns:
        the session, its evaluation, if there was any, and the exit code: 0, or 130 or 143 when a signal ended
        it.
    """
    set_threads(cfg.threads)
    checkpoint = check_folder(cfg.folder, "folder") / "checkpoint.pt"
    plain: dict[str, Any] = OmegaConf.to_container(cfg, resolve=True)  # type: ignore[assignment]
    training = make_training(plain, overrides)
    session = training.session
    if training.reconstructed is not None:
        share = 100 * training.reconstructed
        print(f"autoencoder: explains {share:.1f} % of the features' variance", file=sys.stderr)
    scenes, goals, agent = session.scenes, session.goals, session.agent
    measured = dict(plain["evaluation"])
    wanted = measured.pop("goals")
    wanted = goals if wanted == "trained" else wanted
    if cfg.evaluation.goals:
        check_comparison(scenes, wanted, **measured)
    if cfg.resume:
        for change in session.resume(cfg.resume):
            print(f"resumed with {change}", file=sys.stderr)
    resumed = session.frames if cfg.resume else None
    tell = make_loggers(
        folder=cfg.folder, config=plain, run_id=session.run_id, resume_frames=resumed, **plain["logger"]
    )

    with tell as loggers:
        progress = ProgressLine(cfg.total_frames)
        with StopOnSignal() as stop, session.collecting(training.make_collector) as batches, progress:
            while session.frames < cfg.total_frames and not stop.received:
                began, before = time.monotonic(), session.frames
                batch, terms = training.update(batches)
                session.count(batch, terms, time.monotonic() - began)
                progress.update(session.frames)
                ended = session.frames >= cfg.total_frames  # a short training is logged, too
                if ended or before // cfg.log_every < session.frames // cfg.log_every:
                    metrics = session.metrics()
                    loggers.log_metrics(metrics, session.frames)
                    progress.rates(metrics["success"], metrics["length_ratio"])
                if before // cfg.checkpoint_every < session.frames // cfg.checkpoint_every:
                    loggers.log_checkpoint(session.save(checkpoint), session.frames)
            loggers.log_checkpoint(session.save(checkpoint), session.frames)
        loggers.exit_code = stop.exit_code

        result = None
        if cfg.evaluation.goals and not stop.received:
            options = {**measured, "history": agent.config["history"], "observe": training.observation}
            with EvaluationProgress() as told:
                policies = {row_name(plain): training.actor}
                result = compare(policies, scenes, wanted, trained=goals, progress=told, **options)
            result.save(checkpoint.with_name("evaluation"))
            loggers.log_table("evaluation", result.rows, session.frames)
            print_summary(result.rows, note=result.note)
    return session, result, stop.exit_code


def main(cfg: DictConfig, overrides: list[str]) -> int:
    """Trains, and says where the results are."""
    _, _, exit_code = train(cfg, overrides)
    print(f"{cfg.folder}/checkpoint.pt", file=sys.stderr)
    return exit_code


if __name__ == "__main__":
    launch(main, CONF, "train")
