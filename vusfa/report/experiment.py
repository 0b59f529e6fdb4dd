"""Runs that were evaluated on the same episodes, as one long table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import pandas as pd
import torch
from torch import Tensor

from vusfa.errors import ResultError
from vusfa.evaluation.baselines import RANDOM_WALK, SHORTEST_PATH, shortest_paths
from vusfa.evaluation.exact import ExactGoals, exact_goals, uniform_probabilities
from vusfa.evaluation.long_table import distance_to_trained, episode_rows, exact_rows, join_tables
from vusfa.evaluation.statistics import Sums
from vusfa.experiments.runs import Run, no_results, read_runs
from vusfa.limits import listing
from vusfa.modules.config import MODELS
from vusfa.scenes import SceneSet

__all__ = ["Experiment", "read_experiment"]

_FIRST = ("untrained", *MODELS)


@dataclass(frozen=True, eq=False)
class Experiment:
    """Models whose runs hold the same episodes.

    Attributes:
        runs: by the model's label, in order of seed.
        scenes: the world.
        table: the long table of all runs and of the baselines, whose mode is ``exact``.
        scene, goal: (G,) int64, the goals: index of the scene, state id within it.
        trained: (G,) bool, whether it is a trained goal.
        distance_to_trained: (G,) int64, actions from the nearest trained goal, -1 where there is none.
    """

    runs: Mapping[str, Sequence[Run]]
    scenes: SceneSet
    table: pd.DataFrame
    scene: Tensor
    goal: Tensor
    trained: Tensor
    distance_to_trained: Tensor

    @cached_property
    def _groups(self) -> dict[tuple[str, str, str], pd.DataFrame]:
        by = ["model", "mode", "metric"]
        return {key: part for key, part in self.table.groupby(by, observed=True, sort=True)}

    def seeds(self, label: str) -> list[int]:
        """Seeds of a model's runs, in order."""
        return [run.seed for run in self.runs[label]]

    def sums(self, label: str, mode: str, seeds: Sequence[int] | None = None) -> dict[str, Sums]:
        """Numerators and denominators of a model's metrics per seed and goal, (K, G) each.

        Args:
            label: of a model or of a baseline, which has one row, in any mode.
            mode: ``sampled``, ``greedy``, or ``exact`` where the runs have it; empty for runs that were not
                evaluated in it.
            seeds: those to take; all by default. The baselines repeat their row.
        """
        baseline = label in (RANDOM_WALK, SHORTEST_PATH)
        every = [-1] if baseline else self.seeds(label)
        rows = (
            [0] * len(seeds or [0])
            if baseline
            else [i for i, seed in enumerate(every) if seeds is None or seed in seeds]
        )
        found, shape = {}, (len(every), len(self.goal))
        for (model, of_mode, metric), part in self._groups.items():
            if model == label and (baseline or of_mode == mode) and len(part) == shape[0] * shape[1] and rows:
                over, under = (torch.tensor(part[name].to_numpy()) for name in ("numerator", "denominator"))
                found[metric] = Sums(over.view(shape)[rows], under.view(shape)[rows])
        return found


def read_experiment(root: str | Path, names: Sequence[str], scenes: SceneSet | None = None) -> Experiment:
    """Read the runs of experiments that share their episodes.

    Args:
        root: folder of results.
        names: of the experiments.
        scenes: the world; the scenes that the runs name by default.

    Raises:
        ResultError: there is no run, one is damaged, or one has other episodes; the scenes are others.
    """
    runs = [run for name in names for run in read_runs(root, name) if run.episodes]
    if not runs:
        raise no_results(root, *names, command="vusfa table1")
    first = next(iter(runs[0].episodes.values()))
    for run in runs:
        for mode, table in run.episodes.items():
            same = all(
                torch.equal(getattr(table, column), getattr(first, column))
                for column in ("scene", "goal", "start", "trained")
            )
            if not same or table.scene_names != first.scene_names:
                raise ResultError(
                    f"{Path(root) / run.experiment / run.name}: the episodes of {mode} are not those of"
                    f" {runs[0].name}; give experiments of one manifest and the same trained goals"
                )
    scenes = SceneSet.open(list(runs[0].info["scenes"])) if scenes is None else scenes
    evaluated = runs[0].info.get("scenes_fingerprint", scenes.fingerprint)
    if evaluated != scenes.fingerprint:
        where = Path(root) / runs[0].experiment / runs[0].name
        raise ResultError(
            f"{where}: of other scenes (fingerprint {evaluated[:12]}, and"
            f" {listing(scenes.names)} have {scenes.fingerprint[:12]}); give those of its evaluation"
        )
    groups: dict[str, list[Run]] = {}
    for run in sorted(runs, key=_order):
        group = groups.setdefault(run.label, [])
        if group and group[-1].seed == run.seed:
            one, two = (f"{found.experiment}/{found.name}" for found in (group[-1], run))
            raise ResultError(
                f"{root}: {one} and {two} are both seed {run.seed} of {run.label}; show them apart"
            )
        group.append(run)
    shortest = episode_rows(shortest_paths(first), SHORTEST_PATH, mode="exact")
    goals = shortest[["scene", "goal", "trained"]].drop_duplicates()
    walk = exact_rows(_random_walk(scenes), goals, scenes.names, RANDOM_WALK)
    tables = [run.rows(goals) for group in groups.values() for run in group]
    number = {name: index for index, name in enumerate(first.scene_names)}
    scene = torch.tensor([number[name] for name in goals.scene])
    goal, trained = (torch.tensor(goals[name].to_numpy()) for name in ("goal", "trained"))
    distance = distance_to_trained(scenes, scene, goal, trained)
    return Experiment(groups, scenes, join_tables([*tables, walk, shortest]), scene, goal, trained, distance)


@lru_cache(maxsize=1)
def _random_walk(scenes: SceneSet) -> ExactGoals:
    """Exact random walk, cached for several tables of the same rooms."""
    return exact_goals(uniform_probabilities(scenes.num_actions), scenes)


def _order(run: Run) -> tuple[int, str, int]:
    model = str(run.info.get("model", ""))
    rank = _FIRST.index(model) if model in _FIRST else len(_FIRST)
    return (rank if run.label == model else len(_FIRST) + 1, run.label, run.seed)
