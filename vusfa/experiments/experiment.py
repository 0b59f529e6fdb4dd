"""Cells of results side by side: who walked the same episodes, as sums per seed and goal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from vusfa.errors import ResultError
from vusfa.evaluation.episodes import Episodes
from vusfa.evaluation.exact import ExactGoals, exact_goals
from vusfa.evaluation.floors import shortest_paths
from vusfa.evaluation.metrics import soft_spl_scores, spl_scores
from vusfa.evaluation.statistics import Sums
from vusfa.experiments.results import Cell, read_cells
from vusfa.modules.presets import MODELS
from vusfa.scenes import SceneSet

__all__ = ["Experiment", "episode_sums", "nearest_trained", "read_experiment", "row_label"]

RANDOM_WALK, SHORTEST_PATH = "random walk", "shortest path"
_FIRST = ("untrained", *MODELS)


@dataclass(frozen=True, eq=False)
class Experiment:
    """Models whose cells hold the same episodes.

    Attributes:
        cells: by what a model is called, in order of seed.
        scenes: the world.
        scene, goal: (G,) int64, the goals: index of the scene, state id within it.
        trained: (G,) bool, trained on.
        away: (G,) int64, actions from the nearest trained goal, -1 where there is none.
        place: (n,) int64, the goal (index) of each episode.
        floor: the random walk, goal by goal, computed.
    """

    cells: Mapping[str, Sequence[Cell]]
    scenes: SceneSet
    scene: Tensor
    goal: Tensor
    trained: Tensor
    away: Tensor
    place: Tensor
    floor: ExactGoals

    def seeds(self, label: str) -> list[int]:
        """Seeds of a model's cells, in order."""
        return [int(cell.info["seed"]) for cell in self.cells[label]]

    def sums(self, label: str, way: str, seeds: Sequence[int] | None = None) -> dict[str, Sums]:
        """What a model's means are made of, measure by measure, (K, G) each.

        Args:
            label: of a model, or ``random walk`` (computed) or ``shortest path``: one row, for they have no
                seeds.
            way: of evaluation: ``sampled``, ``greedy``, or ``exact`` where the cells have it; empty for cells
                that were not evaluated so.
            seeds: those to take; all when not given. The floor and the ceiling repeat their row.
        """
        if label in (RANDOM_WALK, SHORTEST_PATH):
            found = self._exact(self.floor) if label == RANDOM_WALK else self._ceiling()
            return {
                name: Sums(*(part.expand(len(seeds or [0]), -1) for part in sums))
                for name, sums in found.items()
            }
        chosen = [cell for cell in self.cells[label] if seeds is None or cell.info["seed"] in seeds]
        if way == "exact":
            tables = [self._exact(cell.exact) for cell in chosen if cell.exact is not None]
        else:
            tables = [
                episode_sums(cell.episodes[way], self.place, len(self.goal))
                for cell in chosen
                if way in cell.episodes
            ]
        if len(tables) < len(chosen) or not tables:
            return {}
        shared = [name for name in tables[0] if all(name in table for table in tables)]
        return {
            name: Sums(*(torch.cat(parts) for parts in zip(*(table[name] for table in tables), strict=True)))
            for name in shared
        }

    def _ceiling(self) -> dict[str, Sums]:
        table = next(iter(next(iter(self.cells.values()))[0].episodes.values()))
        return episode_sums(shortest_paths(table), self.place, len(self.goal))

    def _exact(self, table: ExactGoals) -> dict[str, Sums]:
        """The goals that the episodes have, of a table of all."""
        size = 1 + int(torch.cat([table.goal, self.goal]).max())
        known = torch.full((self.scenes.num_scenes * size,), -1)
        known[table.scene * size + table.goal] = torch.arange(len(table.goal))
        rows = known[self.scene * size + self.goal]
        return {
            name: Sums(column[rows].unsqueeze(0), torch.ones(1, len(rows), dtype=torch.float64))
            for name, column in (
                ("success_500", table.success_500),
                ("success_100", table.success_100),
                ("spl", table.spl),
            )
        }


def episode_sums(episodes: Episodes, place: Tensor, goals: int) -> dict[str, Sums]:
    """Numerators and denominators of all measures, goal by goal, (1, G) each.

    Args:
        episodes: of one agent.
        place: (n,) int64, the goal of each, 0 to G - 1.
        goals: G.

    Returns:
        ``success_500``, ``success_100``, ``spl``, ``soft_spl`` (where the episodes tell what remained),
        ``length_ratio`` (of the successful episodes) and ``collisions``.

    >>> one = torch.tensor([1, 1])
    >>> walked = Episodes(one, one, one, one > 0, one * 150, one * 100, one, one > 0, ("hall", "attic"), 500)
    >>> sums = episode_sums(walked, one * 0, 1)
    >>> {name: (over / under).item() for name, (over, under) in sums.items() if name != "spl"}
    {'success_500': 1.0, 'success_100': 0.0, 'length_ratio': 1.5, 'collisions': 1.0}
    """
    success, length, shortest = episodes.success, episodes.length, episodes.shortest
    ones = torch.ones(len(episodes), dtype=torch.float64)
    terms: dict[str, tuple[Tensor, Tensor]] = {
        f"success_{k}": (success & (length <= k), ones) for k in (500, 100)
    }
    terms["spl"] = spl_scores(success, length, shortest), ones
    if episodes.remaining is not None:
        terms["soft_spl"] = soft_spl_scores(length, shortest, episodes.remaining), ones
    terms["length_ratio"] = success * length, success * shortest
    terms["collisions"] = episodes.collisions, ones

    def summed(values: Tensor) -> Tensor:
        return torch.zeros(goals, dtype=torch.float64).index_add_(0, place, values.double()).unsqueeze(0)

    return {name: Sums(summed(over), summed(under)) for name, (over, under) in terms.items()}


def read_experiment(root: str | Path, names: Sequence[str], scenes: SceneSet | None = None) -> Experiment:
    """Read the cells of experiments that share their episodes.

    Args:
        root: folder of results.
        names: of the experiments.
        scenes: the world; those that the cells name when not given.

    Raises:
        ResultError: there is no cell, one is damaged, or one has other episodes; the scenes are others.
    """
    cells = [cell for name in names for cell in read_cells(root, name) if cell.episodes]
    if not cells:
        raise ResultError(f"{root}: no results of {' or '.join(names)}; run recipes/table1.py first")
    first = next(iter(cells[0].episodes.values()))
    for cell in cells:
        for way, table in cell.episodes.items():
            same = all(
                torch.equal(getattr(table, column), getattr(first, column))
                for column in ("scene", "goal", "start", "trained")
            )
            if not same or table.scene_names != first.scene_names:
                raise ResultError(
                    f"{Path(root) / cell.experiment / cell.name}: the episodes of {way} are not those of"
                    f" {cells[0].name}; give experiments of one manifest and the same trained goals"
                )
    scenes = SceneSet.open(list(cells[0].info["scenes"])) if scenes is None else scenes
    walked = cells[0].info.get("scenes_fingerprint", scenes.fingerprint)
    if walked != scenes.fingerprint:
        where = Path(root) / cells[0].experiment / cells[0].name
        raise ResultError(
            f"{where}: of other scenes (fingerprint {walked[:12]}, and"
            f" {', '.join(scenes.names)} have {scenes.fingerprint[:12]}); give those that it was walked in"
        )
    groups: dict[str, list[Cell]] = {}
    for cell in sorted(cells, key=_order):
        groups.setdefault(row_label(cell.info), []).append(cell)
    size = 1 + int(first.goal.max())
    keys, place = (first.scene * size + first.goal).unique(return_inverse=True)
    trained = torch.zeros(len(keys), dtype=torch.bool)
    trained[place[first.trained]] = True
    scene, goal = keys // size, keys % size
    even = exact_goals(
        lambda state, _goal, _scene: torch.full((len(state), scenes.num_actions), 1 / scenes.num_actions),
        scenes,
    )
    away = nearest_trained(scenes, scene, goal, trained)
    return Experiment(groups, scenes, scene, goal, trained, away, place, even)


def row_label(info: Mapping[str, Any]) -> str:
    """What a cell's model is called in tables.

    >>> row_label({"model": "vusfa", "row": "vusfa", "agent_preset": "paper"})
    'vusfa (paper)'
    """
    name, preset = str(info.get("row", info["model"])), info.get("agent_preset", "controlled")
    return name if preset == "controlled" else f"{name} ({preset})"


def nearest_trained(scenes: SceneSet, scene: Tensor, goal: Tensor, trained: Tensor) -> Tensor:
    """Fewest actions to each goal from a trained one of its scene, -1 where there is none.

    Args:
        scenes: the world.
        scene, goal: (G,) int64.
        trained: (G,) bool.

    >>> bathroom, goals = SceneSet.bundled(["bathroom"]), torch.arange(4)
    >>> nearest_trained(bathroom, goals * 0, goals, goals == 0).tolist()
    [0, 1, 2, 1]
    """
    away = torch.full_like(goal, -1)
    for index, room in enumerate(scenes.scenes):
        here = scene == index
        known = goal[here & trained]
        if known.numel():
            table = room.distance[known][:, goal[here]].to(torch.int64)
            far = table.max() + 1
            nearest = torch.where(table < 0, far, table).amin(0)
            away[here] = torch.where(nearest == far, -1, nearest)
    return away


def _order(cell: Cell) -> tuple[int, str, int]:
    model = str(cell.info["model"])
    rank = _FIRST.index(model) if model in _FIRST else len(_FIRST)
    plain = row_label(cell.info) == model
    return (rank if plain else len(_FIRST) + 1, row_label(cell.info), int(cell.info["seed"]))
