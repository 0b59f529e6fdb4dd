"""Zero-shot evaluation of checkpoints: ``vusfa evaluate``."""

from __future__ import annotations

import os
import shlex
import sys
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch

from vusfa.cluster.cells import Cell, run_cells
from vusfa.envs.dynamics import MAX_STEPS
from vusfa.errors import ConfigError
from vusfa.evaluation import compare, print_summary
from vusfa.experiments.manifest import BUNDLED_MANIFEST, read_manifest
from vusfa.experiments.measure import evaluation_policy, evaluation_precision
from vusfa.files import check_file
from vusfa.scenes import SceneSet
from vusfa.training import (
    EvaluationProgress,
    checkpoint_file,
    load_agent,
    load_checkpoint,
    make_observation,
    rebuild_agent,
    row_name,
    set_threads,
)

__all__ = ["evaluate_checkpoint", "zero_shot"]


def zero_shot(
    checkpoint: list[Path],
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
    again: bool = True,
    launcher: str = "serial",
    launcher_options: list[str] = [],  # noqa: B006
) -> None:
    """Evaluate checkpoints towards every state of their scenes.

    Trained and unseen goals are separate tables, beside the random walk, the untrained network and the
    shortest path. zero_shot.csv, .json and zero_shot_episodes.csv are written beside each checkpoint.

    Args:
        checkpoint: files, or folders of runs.
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
        again: false skips a checkpoint that has an evaluation.
        launcher, launcher_options: what runs the cells: serial, local, slurm or ray (docs/cluster.md).
    """
    given = [checkpoint] if isinstance(checkpoint, str | Path) else checkpoint  # one, from Python
    if out is not None and len(given) > 1:
        raise ConfigError(
            f"out is '{out}', one place for {len(given)} evaluations; give one checkpoint, or no out"
        )
    files = [checkpoint_file(each) for each in given]
    how: dict[str, Any] = {"scenes": scenes, "episodes": episodes, "max_steps": max_steps, "goals": goals}
    how |= {"manifest": manifest, "greedy": greedy, "unreachable": unreachable}
    how |= {"seed": seed, "device": device, "threads": threads}
    places = {file: out or file.with_name("zero_shot") for file in files}
    for stem in places.values():
        check_file(stem.with_name(f"{stem.name}_episodes.csv"), "out")
    for lost in (file for file in files if not os.path.exists(file)):
        load_checkpoint(lost)  # says what is wrong, before any work
    cells = [
        Cell(stem.with_name(f"{stem.name}_episodes.csv"), partial(evaluate_checkpoint, file, stem, **how))
        for file, stem in places.items()
    ]
    run_cells(cells, launcher, launcher_options, again)


def evaluate_checkpoint(checkpoint: Path, stem: Path, **how: Any) -> str:
    """Evaluate one checkpoint, print its table, write it to ``STEM.csv`` and so on, and return the paths.

    Args:
        checkpoint: the file.
        stem: where to write, without suffix.
        how: arguments of :func:`zero_shot` by name.
    """
    scenes, manifest, seed, device = (how[name] for name in ("scenes", "manifest", "seed", "device"))
    episodes, max_steps, goals = (how[name] for name in ("episodes", "max_steps", "goals"))
    greedy, unreachable, threads = (how[name] for name in ("greedy", "unreachable", "threads"))
    set_threads(threads)
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
    run = shlex.quote(str(checkpoint.parent))
    print(f"next: vusfa report {run}, vusfa film {run}", file=sys.stderr)
    return "\n".join(map(str, result.save(stem)))
