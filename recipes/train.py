"""Trains one of the four models: python recipes/train.py agent.model=vusfa scenes=[bathroom]

Settings are in recipes/conf/train.yaml and the folders beside it. The run's folder gets metrics.csv and
checkpoint.pt, and at the end evaluation.csv, .json and evaluation_episodes.csv. To go on: python
recipes/train.py resume=RUN/checkpoint.pt
"""

from __future__ import annotations

import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from vusfa.envs import resolve_goals
from vusfa.evaluation import Comparison, check_comparison, compare, print_summary
from vusfa.evaluation.files import check_folder
from vusfa.modules import make_agent
from vusfa.scenes import SceneSet
from vusfa.training import (
    EvaluationProgress,
    ProgressLine,
    Session,
    StopOnSignal,
    annealed,
    check_goals_dealt,
    descend,
    make_collector,
    make_env,
    make_loggers,
    make_loss,
    make_observation,
    make_optimiser,
    scene_sources,
    set_threads,
    torch_device,
    total_loss,
)
from vusfa.training.launch import launch


def train(cfg: DictConfig, overrides: list[str]) -> tuple[Session, Comparison | None, int]:
    """Trains, and leaves a checkpoint and an evaluation in ``cfg.folder``.

    Args:
        cfg: settings, as in recipes/conf/train.yaml.
        overrides: the command line that made them, for whoever resumes.

    Returns:
        the session, its evaluation, if there was any, and the exit code: 0, or 130 or 143 when a signal ended
        it.
    """
    set_threads(cfg.threads)
    torch.manual_seed(cfg.seed)
    device, checkpoint = torch_device(cfg.device), check_folder(cfg.folder, "folder") / "checkpoint.pt"
    plain: dict[str, Any] = OmegaConf.to_container(cfg, resolve=True)  # type: ignore[assignment]
    optim = plain["optim"]
    half = partial(torch.autocast, device.type, torch.bfloat16, enabled=cfg.autocast)

    # The world, the agent, and what it learns by.
    scenes = SceneSet.open(cfg.scenes)
    goals = resolve_goals(scenes, plain["env"]["goals"])
    check_goals_dealt(len(goals), cfg.collector.num_envs, cfg.env.goal_sampling)
    measured = dict(plain["evaluation"])
    wanted = measured.pop("goals")
    wanted = goals if wanted == "trained" else wanted
    if cfg.evaluation.goals:
        check_comparison(scenes, wanted, **measured)
    agent = make_agent(scenes=scenes, **{k: v for k, v in plain["agent"].items() if v is not None}).to(device)
    actor, critic = agent.get_policy_operator(out_keys=["action"]), agent.get_value_operator()
    loss, _, multiplier = make_loss(
        actor, critic, entropy_coeff=plain["entropy"]["start"], **plain["objective"]
    )
    optimiser = make_optimiser(
        agent.parameters(), optim["kind"], optim["lr"], optim["max_grad_norm"], **optim["options"]
    )

    # What is saved, who walks, and who is told.
    settings = {"config": plain, "overrides": overrides, "sources": scene_sources(cfg.scenes)}
    session = Session(scenes, goals, agent, loss.to(device), optimiser, settings)
    if cfg.resume:
        for change in session.resume(cfg.resume):
            print(f"resumed with {change}", file=sys.stderr)
    history, task = agent.config["history"], {**plain["env"], "goals": goals}
    observation = make_observation(agent, scenes, task.pop("crop"))
    transforms = [*([observation] if observation is not None else []), *agent.make_env_transforms()]
    env = partial(make_env, scenes, transforms, history=history, device=device, **task)
    collector = partial(
        make_collector, make_env=env, policy=actor, seed=cfg.seed, autocast=cfg.autocast, **plain["collector"]
    )
    resumed = session.frames if cfg.resume else None
    tell = make_loggers(
        folder=cfg.folder, config=plain, run_id=session.run_id, resume_frames=resumed, **plain["logger"]
    )

    with tell as loggers:
        progress = ProgressLine(cfg.total_frames)
        with StopOnSignal() as stop, session.collecting(collector) as batches, progress:
            while session.frames < cfg.total_frames and not stop.received:
                began, before = time.monotonic(), session.frames
                lr = annealed(before, optim["lr"], optim["horizon"])
                loss.entropy_coeff = annealed(before, **plain["entropy"])
                with session.encoded_once(half):
                    with half():
                        batch = next(batches)
                    with half():  # another one: autocast keeps weights that it converted without gradients
                        terms = loss(batch)
                norm = descend(optimiser, total_loss(loss, terms), lr, optim["max_grad_norm"])
                if multiplier is not None:
                    multiplier.step()

                session.count(batch, {**terms, "grad_norm": norm}, time.monotonic() - began)
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
            options = {**measured, "history": history, "observe": observation}
            with EvaluationProgress() as told:
                policies = {agent.config["model"]: actor}
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
    launch(main, Path(__file__).parent / "conf", "train")
