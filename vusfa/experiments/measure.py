"""From checkpoints to a run's results: the choice of a checkpoint, and its evaluation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase

from vusfa.evaluation import Episodes, evaluate
from vusfa.evaluation.exact import (
    ExpectedWalks,
    Probabilities,
    WalksWithin,
    exact_goals,
    join_walks,
    sampled_walks,
    walks_within,
)
from vusfa.evaluation.metrics import get_metric
from vusfa.evaluation.navigation import acting
from vusfa.evaluation.parts import evaluate_parts, parts_of
from vusfa.experiments.manifest import BUNDLED_MANIFEST, Manifest, make_manifest, read_manifest
from vusfa.experiments.runs import Run
from vusfa.modules import Agent, InferencePolicy, TabularPolicy
from vusfa.scenes import SceneSet
from vusfa.training import Trainer, load_agent, make_observation
from vusfa.training.facts import run_facts
from vusfa.training.precision import resolve_autocast
from vusfa.training.progress import EvaluationProgress

__all__ = [
    "choose_checkpoint",
    "evaluation_policy",
    "evaluation_precision",
    "manifest_for",
    "measure_checkpoint",
    "measure_goals",
    "walk_manifest",
]

MODES = ("sampled", "greedy")


def manifest_for(scenes: SceneSet, trained: torch.Tensor, path: Path | None = None) -> Manifest:
    """The manifest in ``path``; by default that of the bundled rooms, or for other rooms a new one, see
    :func:`~vusfa.experiments.manifest.make_manifest`."""
    manifest = read_manifest(path or BUNDLED_MANIFEST)
    return manifest if path or manifest.fingerprint == scenes.fingerprint else make_manifest(scenes, trained)


def choose_checkpoint(checkpoints: Sequence[Path], manifest: Path | None = None) -> dict[Path, float]:
    """SPL of checkpoints over the episodes to the validation goals, actions sampled.

    Args:
        checkpoints: of one training.
        manifest: see :func:`manifest_for`.

    Returns:
        SPL by checkpoint, the best first, the earlier one of equals.
    """
    scores = {}
    for path in checkpoints:
        agent, scenes, state = load_agent(path)
        episodes = manifest_for(scenes, state["goals"], manifest)
        policy = evaluation_policy(agent)  # goals are few: no table of all of them
        with evaluation_precision(agent, state["config"]):
            table = walk_manifest(
                agent, scenes, episodes, state["goals"], path.stem, validation=True, policy=policy
            )
        scores[path] = get_metric("spl").value(table)
    return dict(sorted(scores.items(), key=lambda item: -item[1]))


def evaluation_policy(agent: Agent, scenes: SceneSet | None = None) -> TensorDictModuleBase:
    """Policy for the evaluation of an agent: the same actions as its actor's, computed faster.

    Args:
        agent: with its present weights.
        scenes: given where every state will be a goal; a one-frame agent then becomes a table, unless the
            scenes are opened lazily, and so evaluated one after the other.

    >>> from vusfa.modules import TabularPolicy, make_agent
    >>> rooms = SceneSet.bundled(["bathroom"])
    >>> agent = make_agent("gvf", scenes=rooms, history=1, hidden_size=8)
    >>> type(evaluation_policy(agent)).__name__, type(evaluation_policy(agent, rooms)).__name__
    ('InferencePolicy', 'TabularPolicy')
    """
    if scenes is not None and agent.is_tabular and not scenes.is_lazy:
        return TabularPolicy(agent, scenes)
    return InferencePolicy(agent)


def evaluation_precision(agent: Agent, config: Mapping[str, Any]) -> AbstractContextManager[Any]:
    """Autocast of an evaluation: bfloat16 as in the training for an agent of several frames; float32 for any
    other, whose table is computed once.

    Args:
        agent: of the checkpoint.
        config: the checkpoint's settings.
    """
    device = next(agent.parameters()).device
    on = resolve_autocast(config["autocast"], device) and not agent.is_tabular
    return torch.autocast(device.type, torch.bfloat16, enabled=on)


def measure_checkpoint(
    checkpoint: Path, experiment: str, name: str, overrides: Sequence[str] = (), manifest: Path | None = None
) -> Run:
    """A run's results: the manifest's episodes with sampled and with greedy actions, and the exact table of a
    one-frame agent.

    Args:
        checkpoint: of vusfa train.
        experiment, name: of the run.
        overrides: of the training's command line.
        manifest: see :func:`manifest_for`.
    """
    agent, scenes, state = load_agent(checkpoint)
    episodes, trained = manifest_for(scenes, state["goals"], manifest), state["goals"]
    policy = evaluation_policy(agent, scenes)
    with evaluation_precision(agent, state["config"]):
        tables = {
            mode: walk_manifest(
                agent, scenes, episodes, trained, f"{name}, {mode}", mode == "sampled", policy=policy
            )
            for mode in MODES
        }
    exact = None
    if isinstance(policy, TabularPolicy):
        exact = exact_goals(policy.probabilities, scenes)
    elif agent.is_tabular:
        exact = exact_goals(probabilities_by_scene(agent, scenes), scenes)
    info = {**run_facts(state, overrides), "checkpoint": checkpoint.name}
    return Run(experiment, name, info, tables, exact)


def measure_goals(
    trainer: Trainer, goals: torch.Tensor, *, episodes_per_goal: int, max_steps: int
) -> ExpectedWalks:
    """How an agent in training reaches goals, actions sampled; weights and random states stay as they are.

    The ranks of a data-parallel training all call this, and share the goals out.

    Args:
        trainer: of the agent.
        goals: (G,) global ids, scene by scene.
        episodes_per_goal: for an agent of several frames, from the same starts each time; one-frame agents
            that read ids are measured exactly.
        max_steps: limit of actions per episode.
    """
    agent, ranks, device = trainer.agent, trainer.ranks, next(trainer.agent.parameters()).device
    scenes = trainer.scenes.to(device)
    parts = parts_of(scenes, goals, episodes_per_goal)
    if agent.is_tabular:
        exact = [_exactly(agent, scenes, part, max_steps) for part in parts[ranks.own_parts]]
        found = ranks.collect(exact)
        return ranks.first(lambda: join_walks(found, scenes))
    with evaluation_precision(agent, trainer.settings):
        tables = evaluate_parts(
            InferencePolicy(agent),
            scenes,
            parts,
            ranks.own_parts,
            episodes_per_goal=episodes_per_goal,
            max_steps=max_steps,
            history=agent.config["history"],
            observe=trainer.observation,
        )
    walked = ranks.collect(tables)
    return ranks.first(lambda: sampled_walks(Episodes.joined(walked), scenes, goals))


def _exactly(agent: Agent, scenes: SceneSet, goals: torch.Tensor, max_steps: int) -> WalksWithin:
    with acting(agent, scenes):
        table = TabularPolicy(agent, scenes, goals)
    return walks_within(
        lambda *ids: table.probabilities(*(each.to(scenes.device) for each in ids)).cpu(),
        scenes,
        goals,
        max_steps,
    )


def probabilities_by_scene(agent: Agent, scenes: SceneSet) -> Probabilities:
    """Probabilities of a one-frame agent's actions, of which the table of one scene at a time is kept.

    Args:
        agent: as it is now.
        scenes: on its device.
    """
    latest: dict[int, TabularPolicy] = {}

    def probabilities(state: torch.Tensor, goal: torch.Tensor, scene: torch.Tensor) -> torch.Tensor:
        index = int(scene[0])
        if index not in latest:
            latest.clear()
            goals = torch.arange(int(scenes.offsets[index]), int(scenes.offsets[index + 1]))
            latest[index] = TabularPolicy(agent, scenes, goals)
        ids = (each.to(scenes.device) for each in (state, goal, scene))
        return latest[index].probabilities(*ids).cpu()

    return probabilities


def walk_manifest(
    agent: Agent,
    scenes: SceneSet,
    manifest: Manifest,
    trained: torch.Tensor,
    title: str,
    sample: bool = True,
    validation: bool = False,
    policy: TensorDictModuleBase | None = None,
) -> Episodes:
    """Evaluate an agent on a manifest's episodes.

    Args:
        agent, scenes, manifest: of the evaluation.
        trained: global ids of the trained goals.
        title: of the progress line.
        sample: sample actions, or take the most probable ones.
        validation: the episodes for the choice of checkpoints, instead of those to report.
        policy: :func:`evaluation_policy` by default.
    """
    with EvaluationProgress() as progress:
        return evaluate(
            evaluation_policy(agent) if policy is None else policy,
            scenes,
            episodes=manifest.episodes(scenes, validation),
            trained=trained,
            sample=sample,
            seed=manifest.seed,
            history=agent.config["history"],
            observe=make_observation(agent, scenes),
            progress=lambda done, total: progress(title, done, total),
        )
