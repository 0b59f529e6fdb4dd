"""Agents in changed renderings of their rooms: ``vusfa robustness``."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from vusfa.errors import ConfigError, SceneError
from vusfa.evaluation import Episodes, evaluate, print_summary, random_walk_summary, shortest_paths, summary
from vusfa.evaluation.baselines import SHORTEST_PATH
from vusfa.evaluation.exact import exact_goals, uniform_probabilities
from vusfa.evaluation.long_table import MEAN_OF_STATES
from vusfa.experiments.measure import evaluation_policy, evaluation_precision
from vusfa.experiments.runs import Run, check_run_name, write_run
from vusfa.files import check_folder
from vusfa.limits import brief
from vusfa.modules import Agent
from vusfa.scenes import SceneSet
from vusfa.scenes.validation import check_same_graph
from vusfa.training import (
    EvaluationProgress,
    checkpoint_file,
    load_agent,
    make_observation,
    rebuild_agent,
    run_facts,
    set_threads,
)

__all__ = ["UNCHANGED", "changed_rooms", "in_changed_rooms", "robustness"]

#: The rooms with the features that the agent was trained with, of several crops the first.
UNCHANGED = "unchanged"
_GREEDY = "-greedy"


def changed_rooms(scenes: SceneSet, source: Path) -> SceneSet:
    """Another rendering of each scene, in the same order.

    Args:
        scenes: the agent's.
        source: folder of scene files, found by their scenes' names, or the file of a single scene.

    Raises:
        SceneError: a room is missing, or has another graph or other features than the agent's.
    """
    found = {scene.name: scene for scene in SceneSet.open([source]).scenes}
    for scene in scenes.scenes:
        if scene.name not in found:
            raise SceneError(
                f"{source}: has no scene {scene.name!r}, in which the agent was trained; it has"
                f" {', '.join(found)}"
            )
        changed = found[scene.name]
        check_same_graph(scene, changed)
        if changed.feature_size != scene.feature_size:
            raise SceneError(
                f"{changed.path}: has {changed.feature_size} features, and the agent reads"
                f" {scene.feature_size}; encode it with the network of the agent's scenes"
            )
    return SceneSet(found[name] for name in scenes.names)


def in_changed_rooms(agent: Agent, scenes: SceneSet) -> Agent:
    """A copy of an agent with the same weights, whose rooms look as in ``scenes``, in evaluation mode.

    Features are normalized by mean and deviation of the training, which are among the weights.
    """
    moved = rebuild_agent(agent.config, scenes)
    moved.load_state_dict(agent.state_dict())
    return moved.eval()


def robustness(
    checkpoint: Path,
    changes: list[Path],
    *,
    name: str = "plain",
    episodes: int = 10,
    seed: int = 0,
    threads: int = 1,
    results: Path = Path("results"),
) -> None:
    """Evaluate an agent in its rooms and in other renderings of them, without any further training.

    Every state is a goal, in the rooms as the agent knows them and in each change; actions are sampled, and
    then the likeliest. The goal's picture is of the changed room, too. Results go to
    RESULTS/robustness/NAME-SEED, SEED that of the training; ``vusfa tables robustness`` prints the table of
    all agents, with intervals over seeds.

    Args:
        checkpoint: the file, or the folder of a run.
        changes: folders of scene files, one folder per change, named after it; the files' scenes have the
            names and graphs of the agent's.
        name: of the results, before the seed, and of the agent in the table.
        episodes: to every goal.
        seed: of starts and actions.
        threads: processor threads.
        results: where results are written.
    """
    set_threads(threads)
    if episodes < 1:
        raise ConfigError(f"episodes is {episodes}; give 1 or more")
    check_folder(results / "robustness", "results")
    names = _change_names(changes)
    agent, own, state = load_agent(checkpoint_file(checkpoint))
    check_run_name(f"{name}-{state['config']['seed']}")  # before the work
    worlds = {UNCHANGED: own, **{n: changed_rooms(own, path) for n, path in zip(names, changes, strict=True)}}
    tables: dict[str, Episodes] = {}
    with EvaluationProgress() as progress, evaluation_precision(agent, state["config"]):
        for change, world in worlds.items():
            moved = agent if world is own else in_changed_rooms(agent, world)
            policy = evaluation_policy(moved, world)
            for mode in (change, change + _GREEDY):
                tables[mode] = evaluate(
                    policy,
                    world,
                    trained=state["goals"],
                    episodes_per_goal=episodes,
                    sample=mode == change,
                    history=agent.config["history"],
                    observe=make_observation(moved, world),
                    seed=seed,
                    progress=partial(progress, mode),
                )
    task = state["config"]["env"]
    said = [f"env.{key}={task[key]}" for key in ("crop", "crop_dropout") if key in task]
    facts = run_facts(state, said)
    info = {**facts, "row": name, "changes": list(worlds), "changed": _variations(worlds)}
    walk = exact_goals(uniform_probabilities(own.num_actions), own)
    print(write_run(results, Run("robustness", f"{name}-{facts['seed']}", info, tables, walk)))
    rows = [row for mode, table in tables.items() for row in summary(table, mode)]
    table = tables[UNCHANGED]
    goals = (table.goal + own.offsets[table.scene]).unique()
    rows += random_walk_summary(own, goals, state["goals"])
    rows += summary(shortest_paths(table), SHORTEST_PATH)
    print_summary([row for row in rows if own.num_scenes == 1 or row["scene"] == MEAN_OF_STATES])
    print(f"vusfa tables robustness --results {results} shows all seeds with intervals", file=sys.stderr)


def _change_names(changes: Sequence[Path]) -> list[str]:
    """Names of folders, or of files without suffix."""
    names = [path.name if path.is_dir() else path.stem for path in changes]
    for name, path in zip(names, changes, strict=True):
        reserved = name in (UNCHANGED, "exact") or name.endswith(_GREEDY)
        if reserved or not name.replace("-", "_").isidentifier():
            raise ConfigError(
                f"{path}: a change cannot be called {brief(name)}; rename it, in letters and digits"
            )
        if names.count(name) > 1:
            raise ConfigError(f"{path}: two changes are called {brief(name)}; rename one")
    return names


def _variations(worlds: Mapping[str, SceneSet]) -> dict[str, Any]:
    """What the files say of each change."""
    said = {name: {s.attributes.get("variation") for s in world.scenes} for name, world in worlds.items()}
    return {name: sorted(str(text) for text in texts if text) for name, texts in said.items() if any(texts)}
