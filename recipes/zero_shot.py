"""Every state a goal: python recipes/zero_shot.py runs/.../checkpoint.pt

As the paper's Table 1: for every state of every scene as a goal, 10 episodes from random starts, 500 steps,
sampled actions. Trained and unseen goals apart, beside the random walk, the untrained network and the
shortest path. The tables go to the terminal; zero_shot.csv, zero_shot.json and zero_shot_episodes.csv beside
the checkpoint.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Literal

import torch
import tyro

from vusfa.errors import VusfaError
from vusfa.evaluation import compare, print_summary
from vusfa.experiments.manifest import BUNDLED_MANIFEST, read_manifest
from vusfa.experiments.measure import evaluation_policy, evaluation_precision
from vusfa.files import check_folder
from vusfa.training import (
    EvaluationProgress,
    load_agent,
    make_observation,
    rebuild_agent,
    row_name,
    set_threads,
)


def zero_shot(
    checkpoint: Path,
    /,
    *,
    episodes: int = 10,
    max_steps: int = 500,
    goals: str = "all",
    manifest: str | None = None,
    greedy: bool = False,
    unreachable: Literal["skip", "fail"] = "skip",
    seed: int = 0,
    device: str = "cpu",
    threads: int = 1,
    out: Path | None = None,
) -> None:
    """Evaluate a checkpoint of recipes/train.py.

    Args:
        checkpoint: the file.
        episodes: for every goal.
        max_steps: actions allowed in an episode.
        goals: all, paper, random:5 (a scene), or a manifest (.yaml).
        greedy: take the most probable action instead of drawing one.
        manifest: walk the episodes of recipes/table1.py, instead of drawing some: bundled, or a file (.npz).
            Then episodes, goals, unreachable and the seed of the actions are not looked at.
        unreachable: pairs of start and goal without a path: skip leaves them out, fail counts them as
            failures.
        seed: of starts, actions and the untrained network.
        device: where to compute.
        threads: processor threads; more than 1 pays on an idle machine only.
        out: where to write, without suffix; zero_shot beside the checkpoint when not given.
    """
    set_threads(threads)
    stem = out or checkpoint.with_name("zero_shot")
    check_folder(stem.parent, "out")
    agent, scenes, state = load_agent(checkpoint, device=device)
    walks = (
        None if manifest is None else read_manifest(BUNDLED_MANIFEST if manifest == "bundled" else manifest)
    )
    torch.manual_seed(seed)
    untrained = rebuild_agent(agent.config, scenes).to(device)
    policies = {row_name(state["config"]): agent, "untrained": untrained}
    every = scenes if goals == "all" else None
    with EvaluationProgress() as progress, evaluation_precision(agent, state["config"]):
        result = compare(
            {name: evaluation_policy(policy, every) for name, policy in policies.items()},
            scenes,
            goals,
            trained=state["goals"],
            progress=progress,
            episodes_per_goal=episodes,
            max_steps=max_steps,
            history=agent.config["history"],
            observe=make_observation(agent, scenes),
            sample=not greedy,
            unreachable=unreachable,
            seed=seed if walks is None else walks.seed,
            episodes=None if walks is None else walks.episodes(scenes),
        )
    result.settings["manifest"] = manifest
    print_summary(result.rows, note=result.note)
    for path in result.save(stem):
        print(path)


if __name__ == "__main__":
    try:
        tyro.cli(zero_shot)
    except VusfaError as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        print("error: interrupted; nothing has been written", file=sys.stderr)
        sys.exit(130)
