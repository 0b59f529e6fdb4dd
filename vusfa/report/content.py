"""The content of a report's page as plain data, made from runs."""

from __future__ import annotations

import platform
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch

import vusfa
from vusfa.envs.dynamics import MAX_STEPS
from vusfa.errors import ConfigError
from vusfa.evaluation import get_metric, random_walk
from vusfa.evaluation.baselines import RANDOM_WALK
from vusfa.evaluation.summary import metric_columns
from vusfa.modules import Agent
from vusfa.report.by_goal import distance_rows, goal_rows
from vusfa.report.curves import learning_curves
from vusfa.report.explorer import choose_goals, choose_starts, sampled_walks, state_maps
from vusfa.report.geometry import dart_path, floor_plan
from vusfa.report.grouping import separate_runs
from vusfa.report.packing import pack
from vusfa.report.pictures import thumbnails
from vusfa.report.run_agents import open_agent_of
from vusfa.report.run_scenes import open_scenes
from vusfa.report.runs import LoggedRun
from vusfa.report.tables import baseline_rows, run_rows, seed_rows, summary_rows
from vusfa.scenes import Scene, SceneSet

__all__ = ["Options", "add_pictures", "gather", "goal_limit", "tables"]

Row = dict[str, Any]

_BYTES_A_STATE = 16  # of the maps of one goal, in base 64: value, three components, four probabilities
_SHARE_OF_MAPS = 0.6


@dataclass(frozen=True)
class Options:
    """Options of a page.

    Args:
        title: title of the page.
        within: limits of actions to report success for.
        goals_per_scene: limit of goals per scene in the explorer; None for as many as the page's size allows.
        seeds: runs per model in the explorer, the first ones.
        walks: sampled episodes to each of these goals. Those of agents of one frame are sampled in the page.
        max_steps: limit of actions of these episodes.
        megabytes: size limit of the page.
        command: command that makes the page again.
        scenes: the runs' scenes, if they have moved, see
            :func:`~vusfa.report.run_scenes.open_scenes`.
        tell: called with a line of progress.
    """

    title: str = "What the runs learned"
    within: Sequence[int] = (500, 100)
    goals_per_scene: int | None = None
    seeds: int = 1
    walks: int = 3
    max_steps: int = MAX_STEPS
    megabytes: float = 40.0
    command: str = ""
    scenes: SceneSet | None = None
    tell: Callable[[str], None] = field(default=lambda line: None)


def tables(runs: Sequence[LoggedRun], scenes: Mapping[str, Scene], options: Options) -> dict[str, list[Row]]:
    """The report's tables by name: summary, seeds, distance, goals, runs.

    Args:
        runs: runs of the report.
        scenes: those of :func:`~vusfa.report.run_scenes.open_scenes`.
        options: for ``within``.
    """
    world = SceneSet(scenes.values())
    measured = any(run.references for run in runs)
    beside = [] if measured else baseline_rows(runs, world, options.within)
    seeds = seed_rows(runs, options.within)
    return {
        "summary": summary_rows(runs, options.within, beside, seeds),
        "seeds": seeds,
        "distance": distance_rows(runs, world, options.within),
        "goals": goal_rows(runs, options.within),
        "runs": run_rows(runs),
    }


def goal_limit(states: Sequence[int], agents: int, options: Options) -> int:
    """Goals per scene in the explorer within the size limit of the page.

    Args:
        states: number of states of each scene.
        agents: number of agents in the explorer.
        options: for ``goals_per_scene`` and ``megabytes``.

    >>> goal_limit([176, 404, 680, 452], 1, Options())
    680
    >>> goal_limit([176, 404, 680, 452], 4, Options())
    223
    """
    room = options.megabytes * 1e6 * _SHARE_OF_MAPS / (max(1, agents) * _BYTES_A_STATE)
    most = max(states, default=1)
    asked = most if options.goals_per_scene is None else options.goals_per_scene
    limits = range(1, min(most, asked) + 1)  # the weight grows with the limit
    return max(1, bisect_right(limits, room, key=lambda k: sum(min(k, size) * size for size in states)))


def gather(
    runs: Sequence[LoggedRun], options: Options | None = None, scenes: Mapping[str, Scene] | None = None
) -> tuple[dict[str, Any], dict[str, list[Row]]]:
    """The page's content without pictures (see :func:`add_pictures`).

    Args:
        runs: runs of the report, at least one.
        options: see :class:`Options`.
        scenes: of :func:`~vusfa.report.run_scenes.open_scenes`; opened when not given.

    Returns:
        the content, plain data, and its tables.

    Raises:
        ConfigError: no runs, or runs that do not belong together.
        VusfaError: a scene or a checkpoint cannot be read.
    """
    options = options or Options()
    if not runs:
        raise ConfigError("a report needs at least one run; give the folders of runs of vusfa train")
    scenes = open_scenes(runs, options.scenes) if scenes is None else scenes
    runs, notes = separate_runs(runs)
    for line in [*notes, "tables"]:
        options.tell(line)
    rows = tables(runs, scenes, options)
    labels = list(dict.fromkeys(run.label for run in runs))
    shown = [
        run
        for label in labels
        for run in [run for run in runs if run.label == label and run.checkpoint][: options.seeds]
    ]
    sizes = [scene.num_states for scene in scenes.values()]
    limit, asked = goal_limit(sizes, len(shown), options), options.goals_per_scene or max(sizes, default=1)
    if shown and limit < min(asked, max(sizes)):
        options.tell(f"the explorer has {limit} goals per scene, to limit the size of the page")
    goals = {name: _explored_goals(scene, rows["goals"], limit) for name, scene in scenes.items()}
    options.tell("floor maps")
    content: dict[str, Any] = {
        "title": options.title,
        "command": options.command,
        "notes": notes,
        "versions": {
            "vusfa": vusfa.__version__,
            "torch": torch.__version__,
            "python": platform.python_version(),
        },
        "metrics": _metrics(rows),
        "hardest": _hardest(rows["summary"][0]) if rows["summary"] else None,
        "models": [{"label": label, "seeds": sum(run.label == label for run in runs)} for label in labels],
        "tables": {name: rows[name] for name in ("summary", "seeds", "distance", "runs")},
        "curves": learning_curves(runs),
        "dart": dart_path(),
        "scenes": {name: floor_plan(scene) for name, scene in scenes.items()},
        "maps": _success_maps(rows["goals"], scenes, options.within),
        "goals": goals,
        "goals_asked": asked,
        "goals_limit": limit,
        "agents": [],
    }
    for run in shown:
        options.tell(f"explorer: {run.name}")
        content["agents"].append(_explored(run, scenes, goals, options))
    return content, rows


def _metrics(rows: Mapping[str, Sequence[Row]]) -> list[Row]:
    """Display of each metric on the page, in order; ``exact`` marks those of the floor maps."""
    found = [(name, get_metric(name), False) for name in metric_columns(rows["summary"])]
    logged = dict.fromkeys(name for row in rows["goals"] for name in row if name.startswith("exact_"))
    for name in sorted(logged, key=lambda name: (not name[6:].isdigit(), name)):
        part = name.removeprefix("exact_")
        found.append((name, get_metric(f"success_{part}" if part.isdigit() else part), True))
    return [
        {"name": name, "exact": exact, "share": metric.unit == "%", "digits": metric.digits}
        | {"better": 1 if metric.higher_is_better else -1, "label": metric.label}
        | {"title": f"{metric.title}, exact" if exact else metric.title}
        for name, metric, exact in found
    ]


def add_pictures(content: dict[str, Any], scenes: Mapping[str, Scene], budget: int) -> None:
    """Add small pictures of the scenes to ``content``, those of goals and episodes first.

    Args:
        content: of :func:`gather`; changed in place.
        scenes: of :func:`~vusfa.report.run_scenes.open_scenes`.
        budget: bytes of base 64 of all pictures, divided by the scenes' numbers of states.
    """
    total = sum(scene.num_states for scene in scenes.values() if scene.has_pictures)
    for name, scene in scenes.items():
        walks = [agent["scenes"][name]["walks"] for agent in content["agents"] if name in agent["scenes"]]
        visited = [state for goals in walks for ways in goals or () for way in ways for state in way]
        share = int(budget * scene.num_states / total * 3 / 4) if scene.has_pictures else 0
        content["scenes"][name]["pictures"] = thumbnails(scene, [*content["goals"][name], *visited], share)


def _explored_goals(scene: Scene, rows: Sequence[Row], limit: int) -> list[int]:
    here = [row for row in rows if row["scene"] == scene.name]
    success, weight = torch.zeros(scene.num_states), torch.zeros(scene.num_states)
    for row in here:
        hardest = _hardest(row)
        success[row["goal"]] += row[hardest] * row["num_episodes"]
        weight[row["goal"]] += row["num_episodes"]
    trained = [row["goal"] for row in here if row["trained"]]
    return choose_goals(scene, trained, success / weight if here else None, limit)


def _success_maps(rows: Sequence[Row], scenes: Mapping[str, Scene], within: Sequence[int]) -> list[Row]:
    """Metrics of every state as a goal, packed, per model and scene; the random walk last."""
    found: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        found.setdefault((row["model"], row["scene"]), []).append(row)
    maps: list[Row] = []
    for (label, name), cells in found.items():
        known = dict.fromkeys(key for cell in cells for key in cell)
        names = [key for key in known if key.startswith("exact_") or _is_share(key)]
        columns = {key: torch.full((scenes[name].num_states,), torch.nan) for key in names}
        for cell in cells:
            for key in names:
                columns[key][cell["goal"]] = cell.get(key, torch.nan)
        maps.append(
            {"model": label, "scene": name, "trained": [cell["goal"] for cell in cells if cell["trained"]]}
            | {"episodes": cells[0]["num_episodes"], "seeds": cells[0]["seeds"]}
            | {key: pack(column, "u8", 0.0, 1.0) for key, column in columns.items()}
        )
    for name in dict.fromkeys(scene for _, scene in found):
        every = torch.arange(scenes[name].num_states)
        limits = {int(key[8:]) for key in rows[0] if key[8:].isdigit() and key.startswith("success_")}
        exact = {f"success_{k}": random_walk(scenes[name], every, k) for k in sorted(limits.union(within))}
        exact |= {name.replace("success", "exact"): column for name, column in exact.items()}
        maps.append(
            {"model": RANDOM_WALK, "scene": name, "trained": [], "episodes": 0, "seeds": 0}
            | {key: pack(column, "u8", 0.0, 1.0) for key, column in exact.items()}
        )
    return maps


def _hardest(row: Row) -> str:
    """Name of success within the lowest limit."""
    return [name for name in metric_columns([row]) if name.startswith("success_")][-1]


def _is_share(name: str) -> bool:
    return bool(metric_columns([{name: 0.0}])) and get_metric(name).unit == "%"


def _explored(
    run: LoggedRun, opened: Mapping[str, Scene], goals: Mapping[str, Sequence[int]], options: Options
) -> Row:
    saved = open_agent_of(run, opened)
    agent, scenes = saved.agent, saved.scenes
    tabular, found = agent.is_tabular, {}
    for index, scene in enumerate(scenes.scenes):
        chosen = goals[scene.name]
        maps = state_maps(agent, scenes, index, chosen)
        starts = {goal: choose_starts(scene, goal, options.walks) for goal in chosen}
        found[scene.name] = {
            "value": pack(maps.value, "u8"),
            "probabilities": pack(maps.probabilities, "u16", 0.0, 1.0),
            "components": None if maps.components is None else _symmetric(maps.components),
            "explained": None if maps.explained is None else maps.explained.tolist(),
            "starts": list(starts.values()),
            "walks": None if tabular else _walks(run, agent, scenes, index, starts, options),
        }
    return {
        "name": run.name,
        "model": run.label,
        "seed": run.seed,
        "frames": saved.frames,
        "gamma": saved.gamma,
        "history": agent.config["history"],
        "markov": tabular,
        "trained": {
            scene.name: scenes.local_id(saved.goals[scenes.scene_id[saved.goals] == index]).tolist()
            for index, scene in enumerate(scenes.scenes)
        },
        "max_steps": options.max_steps,
        "scenes": found,
    }


def _walks(
    run: LoggedRun,
    agent: Agent,
    scenes: SceneSet,
    index: int,
    starts: Mapping[int, Sequence[int]],
    options: Options,
) -> list[list[list[int]]]:
    """Sampled episodes to each goal, of an agent that the page cannot walk itself."""
    pairs = [(start, goal) for goal, begins in starts.items() for start in begins]
    begins, ends = (scenes.global_id(index, [pair[place] for pair in pairs]) for place in (0, 1))
    ways = sampled_walks(agent, scenes, begins, ends, options.max_steps, seed=run.seed)
    by_goal: dict[int, list[list[int]]] = {goal: [] for goal in starts}
    for (_, goal), way in zip(pairs, ways, strict=True):
        by_goal[goal].append(scenes.local_id(way).tolist())
    return list(by_goal.values())


def _symmetric(components: torch.Tensor) -> list[Row]:
    """One packed (G, N) per component, on a scale symmetric about 0 that cuts the few farthest values."""
    packed = []
    for part in components.unbind(-1):
        sample = part.abs().flatten()[:: max(1, part.numel() // 100_000)]  # the limit of quantile
        end = float(torch.quantile(sample, 0.995)) or 1.0
        packed.append(pack(part, "u8", -end, end))
    return packed
