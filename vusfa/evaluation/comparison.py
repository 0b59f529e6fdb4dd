"""Policies and the baselines on the same episodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from vusfa.envs.dynamics import MAX_STEPS
from vusfa.envs.goals import resolve_goals
from vusfa.errors import ConfigError, GoalError
from vusfa.evaluation.baselines import SHORTEST_PATH, shortest_paths
from vusfa.evaluation.episodes import Episodes
from vusfa.evaluation.navigation import evaluate
from vusfa.evaluation.starts import Unreachable, episode_starts
from vusfa.evaluation.summary import count_pairs, random_walk_summary, summary
from vusfa.files import write_csv, write_json
from vusfa.limits import MAX_EPISODE_STEPS, MAX_EPISODES, brief
from vusfa.scenes import SceneSet

__all__ = ["Comparison", "check_comparison", "compare"]


@dataclass(frozen=True)
class Comparison:
    """Results of :func:`compare`.

    Attributes:
        episodes: those of the first policy.
        rows: summaries of all policies, see :func:`vusfa.evaluation.summary`.
        settings: of the evaluation; plain data.
        note: how unreachable pairs of start and goal count.
    """

    episodes: Episodes
    rows: list[dict[str, Any]]
    settings: dict[str, Any]
    note: str

    def save(self, stem: str | Path) -> list[Path]:
        """Write ``STEM.csv`` (the summary), ``STEM.json`` (summary and settings) and ``STEM_episodes.csv``,
        atomically.

        Returns:
            the three paths.
        """
        stem = Path(stem)
        return [
            write_csv(stem.with_name(f"{stem.name}.csv"), self.rows),
            write_json(
                stem.with_name(f"{stem.name}.json"),
                {"settings": self.settings, "note": self.note, "rows": self.rows},
            ),
            self.episodes.write_csv(stem.with_name(f"{stem.name}_episodes.csv")),
        ]


def check_comparison(
    scenes: SceneSet,
    goals: Any,
    *,
    episodes_per_goal: int = 10,
    max_steps: int = MAX_STEPS,
    unreachable: Unreachable = "skip",
    **settings: Any,
) -> None:
    """Raise the errors of :func:`compare` early, before a long training.

    Args:
        scenes, goals, episodes_per_goal, max_steps, unreachable: of :func:`compare`.
        settings: its other arguments, which cannot be wrong here.

    Raises:
        GoalError: a goal does not exist, or no goal can be reached.
        ConfigError: a number below 1.

    >>> check_comparison(SceneSet.bundled(["bathroom"]), "all", max_steps=0)
    Traceback (most recent call last):
    ...
    vusfa.errors.ConfigError: evaluation: max_steps is 0; it must be 1 or more
    """
    for name, value in (("episodes_per_goal", episodes_per_goal), ("max_steps", max_steps)):
        if value < 1:
            raise ConfigError(f"evaluation: {name} is {value}; it must be 1 or more")
    if max_steps > MAX_EPISODE_STEPS:
        raise ConfigError(f"evaluation: max_steps is {max_steps}; give at most {MAX_EPISODE_STEPS:,}")
    try:
        ids = resolve_goals(scenes, goals)
        episode_starts(scenes, ids, 1, unreachable=unreachable, generator=torch.Generator())
    except GoalError as error:
        raise GoalError(f"evaluation: {error}") from error
    if len(ids) * episodes_per_goal > MAX_EPISODES:
        raise ConfigError(
            f"evaluation: episodes_per_goal is {brief(episodes_per_goal)} for {len(ids)} goals; give at most"
            f" {MAX_EPISODES:,} episodes in all"
        )


def compare(
    policies: Mapping[str, TensorDictModuleBase | Episodes],
    scenes: SceneSet,
    goals: Any,
    *,
    trained: Tensor,
    within: Sequence[int] = (500, 100),
    progress: Callable[[str, int, int], None] | None = None,
    **settings: Any,
) -> Comparison:
    """Evaluate policies on the same episodes, beside the random walk and the shortest path.

    Args:
        policies: by name; the episodes of the first are kept. In place of one its episodes, walked before.
        scenes: the world.
        goals: global state ids, or whatever :func:`vusfa.envs.goals.resolve_goals` takes.
        trained: global ids of the goals that the first policy was trained on.
        within: limits of actions to report success for.
        progress: called with (policy, finished episodes, all episodes).
        settings: of :func:`vusfa.evaluation.evaluate`. With ``episodes``, the goals are theirs.

    Raises:
        GoalError: a goal does not exist, or no goal can be reached.
    """
    given = settings.get("episodes")
    goal_ids = resolve_goals(scenes, goals) if given is None else given[1].unique()
    rows: list[dict[str, Any]] = []
    tables: list[Episodes] = []
    for name, policy in policies.items():
        named_progress = None if progress is None else _named(progress, name)
        table = policy
        if not isinstance(table, Episodes):
            table = evaluate(table, scenes, goal_ids, trained=trained, progress=named_progress, **settings)
        rows += summary(table, name, within)
        tables.append(table)
    unreachable = settings.get("unreachable", "skip")
    limit = tables[0].max_steps
    rows += random_walk_summary(scenes, goal_ids, trained, limit, within, unreachable)
    rows += summary(shortest_paths(tables[0]), SHORTEST_PATH, within)
    plain = {key: value for key, value in settings.items() if key not in ("observe", "episodes")}
    named = goals if isinstance(goals, str) and given is None else goal_ids.tolist()
    plain |= {"scenes": list(scenes.names), "goals": named}
    return Comparison(tables[0], rows, plain, count_pairs(scenes.scenes, unreachable))


def _named(progress: Callable[[str, int, int], None], name: str) -> Callable[[int, int], None]:
    return lambda finished, total: progress(name, finished, total)
