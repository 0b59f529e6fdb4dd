"""Zero-shot evaluation of a checkpoint: ``vusfa evaluate``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Literal

import torch

from vusfa.envs.dynamics import MAX_STEPS
from vusfa.evaluation import compare, print_summary
from vusfa.experiments.manifest import BUNDLED_MANIFEST, read_manifest
from vusfa.experiments.measure import evaluation_policy, evaluation_precision
from vusfa.files import check_folder
from vusfa.scenes import SceneSet
from vusfa.training import (
    EvaluationProgress,
    checkpoint_file,
    load_agent,
    make_observation,
    rebuild_agent,
    row_name,
    set_threads,
)

__all__ = ["zero_shot"]


def zero_shot(
    checkpoint: Path,
    *,
    scenes: list[str] | None = None,
    episodes: int = 10,
    max_steps: int = MAX_STEPS,
    goals: str = "all",
    manifest: str | None = None,
    greedy: bool = False,
    unreachable: Literal["skip", "fail"] = "skip",
    seed: int = 0,
    device: str = "cpu",
    threads: int = 1,
    out: Path | None = None,
) -> None:
    """Evaluate a checkpoint towards every state of its scenes.

    Trained and unseen goals are separate tables, beside the random walk, the untrained network and the
    shortest path. zero_shot.csv, zero_shot.json and zero_shot_episodes.csv are written beside the checkpoint.

    Args:
        checkpoint: the file, or the folder of a run.
        scenes: bundled names and files, in order, if they have moved since the training.
        episodes: per goal.
        max_steps: limit of actions per episode.
        goals: all, paper, random:5 (per scene), or a manifest (.yaml).
        greedy: take the most probable action instead of sampling.
        manifest: of the episodes, bundled (Table 1) or a file (.npz); it replaces episodes, goals,
            unreachable and the seed of the actions.
        unreachable: pairs of start and goal without a path: skip leaves them out, fail counts them as
            failures.
        seed: of starts, actions and the untrained network.
        device: where to compute.
        threads: processor threads; more than 1 pays on an idle machine only.
        out: where to write, without suffix; zero_shot beside the checkpoint by default.
    """
    set_threads(threads)
    checkpoint = checkpoint_file(checkpoint)
    stem = out or checkpoint.with_name("zero_shot")
    check_folder(stem.parent, "out")
    rooms = None if scenes is None else SceneSet.open(scenes)
    agent, world, state = load_agent(checkpoint, rooms, device=device)
    walks = (
        None if manifest is None else read_manifest(BUNDLED_MANIFEST if manifest == "bundled" else manifest)
    )
    torch.manual_seed(seed)
    untrained = rebuild_agent(agent.config, world).to(device)
    policies = {row_name(state["config"]): agent, "untrained": untrained}
    every = world if goals == "all" else None
    try:
        with EvaluationProgress() as progress, evaluation_precision(agent, state["config"]):
            result = compare(
                {name: evaluation_policy(policy, every) for name, policy in policies.items()},
                world,
                goals,
                trained=state["goals"],
                progress=progress,
                episodes_per_goal=episodes,
                max_steps=max_steps,
                history=agent.config["history"],
                observe=make_observation(agent, world),
                sample=not greedy,
                unreachable=unreachable,
                seed=seed if walks is None else walks.seed,
                episodes=None if walks is None else walks.episodes(world),
            )
    except KeyboardInterrupt as interrupt:
        raise KeyboardInterrupt("interrupted; nothing has been written") from interrupt
    result.settings["manifest"] = manifest
    print_summary(result.rows, note=result.note)
    for path in result.save(stem):
        print(path)
    print(f"next: vusfa report {checkpoint.parent}, vusfa film {checkpoint.parent}", file=sys.stderr)
