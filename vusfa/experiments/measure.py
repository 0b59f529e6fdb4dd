"""From checkpoints to a run's results: which checkpoint counts, and its evaluation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase

from vusfa.evaluation import Episodes, evaluate
from vusfa.evaluation.exact import exact_goals
from vusfa.evaluation.metrics import get_metric
from vusfa.experiments.manifest import BUNDLED_MANIFEST, Manifest, make_manifest, read_manifest
from vusfa.experiments.runs import Run
from vusfa.modules import Agent, InferencePolicy, TabularPolicy
from vusfa.scenes import SceneSet
from vusfa.training import load_agent, make_observation
from vusfa.training.facts import run_facts
from vusfa.training.precision import resolve_autocast
from vusfa.training.progress import EvaluationProgress

__all__ = [
    "choose_checkpoint",
    "evaluation_policy",
    "evaluation_precision",
    "manifest_for",
    "measure_checkpoint",
    "walk_manifest",
]

MODES = ("sampled", "greedy")


def manifest_for(scenes: SceneSet, trained: torch.Tensor, path: Path | None = None) -> Manifest:
    """The named manifest of episodes; when none is named the bundled rooms' own, or for other rooms one made
    by :func:`~vusfa.experiments.manifest.make_manifest`."""
    manifest = read_manifest(path or BUNDLED_MANIFEST)
    return manifest if path or manifest.fingerprint == scenes.fingerprint else make_manifest(scenes, trained)


def choose_checkpoint(checkpoints: Sequence[Path], manifest: Path | None = None) -> dict[Path, float]:
    """SPL over the episodes to the validation goals, actions drawn; the rule is to take the best, the earlier
    one of equals.

    Args:
        checkpoints: of one training.
        manifest: see :func:`manifest_for`.

    Returns:
        each one's, best first.
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
    """What acts for an agent in an evaluation: the same actions as its actor's, for less.

    Args:
        agent: as it now is.
        scenes: where every state is going to be a goal; an agent of one frame is then written down as a
            table.

    >>> from vusfa.modules import TabularPolicy, make_agent
    >>> rooms = SceneSet.bundled(["bathroom"])
    >>> agent = make_agent("gvf", scenes=rooms, history=1, hidden_size=8)
    >>> type(evaluation_policy(agent)).__name__, type(evaluation_policy(agent, rooms)).__name__
    ('InferencePolicy', 'TabularPolicy')
    """
    if scenes is not None and agent.is_tabular:
        return TabularPolicy(agent, scenes)
    return InferencePolicy(agent)


def evaluation_precision(agent: Agent, config: Mapping[str, Any]) -> AbstractContextManager[Any]:
    """The context to evaluate in: bfloat16 as the agent's training was asked for it, for an agent that sees
    several frames, whose every step has to be computed; float32 for any other.

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
    """A run's results: the manifest's episodes with actions drawn and with the likeliest ones, and the
    exact table where the agent sees one frame.

    Args:
        checkpoint: of recipes/train.py.
        experiment, name: of the run.
        overrides: what the training was started with.
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
    exact = exact_goals(policy.probabilities, scenes) if isinstance(policy, TabularPolicy) else None
    info = {**run_facts(state, overrides), "checkpoint": checkpoint.name}
    return Run(experiment, name, info, tables, exact)


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
    """A manifest's episodes, walked by an agent.

    Args:
        agent, scenes: who walks where.
        manifest: of episodes.
        trained: global ids of the goals trained on.
        title: for the line of progress.
        sample: draw actions, or take the likeliest.
        validation: walk the episodes that checkpoints are chosen by, instead of those to report.
        policy: what acts for the agent; its actor when not given.
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
