"""The long table of results, a pandas frame: one row per run, mode, goal and metric.

Its columns are run, model, seed, scene, goal (state id within its scene), trained (whether the goal is), mode
(``sampled``, ``greedy`` or ``exact``), metric, numerator, denominator and value. Numerators and denominators
are sums over the episodes to the goal, so :func:`pool` is exact for any set of rows. The baselines are runs
without a seed (-1).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import pandas as pd
import torch
from pandas.api.types import union_categoricals
from torch import Tensor

from vusfa.envs.dynamics import MAX_STEPS
from vusfa.evaluation.baselines import RANDOM_WALK, random_walk
from vusfa.evaluation.episodes import Episodes
from vusfa.evaluation.exact import ExactGoals
from vusfa.evaluation.metrics import metrics_within
from vusfa.evaluation.starts import Unreachable
from vusfa.evaluation.statistics import Sums
from vusfa.scenes import SceneSet

__all__ = [
    "DISTANCE_BINS",
    "SUBSETS",
    "average_over_scenes",
    "distance_bin",
    "distance_to_trained",
    "episode_rows",
    "exact_rows",
    "goal_sums",
    "join_tables",
    "pool",
    "random_walk_rows",
    "row_label",
    "select_goals",
]

#: Trained goals, unseen goals, and both.
SUBSETS = ("trained", "unseen", "all")
MEAN_OF_SCENES = "mean of scenes"
MEAN_OF_STATES = "mean of states"
WITHIN = (500, 100)
#: Actions from the nearest trained goal: the first number of each bin.
DISTANCE_BINS = (0, 1, 3, 5, 8, 12)

_SUMMED = ["numerator", "denominator"]
_NAMES = ["run", "model", "scene", "mode", "metric"]


def episode_rows(
    episodes: Episodes,
    model: str,
    *,
    run: str = "",
    seed: int = -1,
    mode: str = "sampled",
    within: Sequence[int] = WITHIN,
) -> pd.DataFrame:
    """The long table of one run's episodes.

    Args:
        episodes: of one run in one mode.
        model, run, seed, mode: columns; ``run`` is the model's name by default.
        within: limits of actions to report success for, see
            :func:`~vusfa.evaluation.metrics.metrics_within`.

    >>> one = torch.tensor([1, 1])
    >>> walks = Episodes(one, one, one, one > 0, one * 150, one * 100, one, one > 0, ("hall", "attic"), 500)
    >>> table = episode_rows(walks, "vusfa")
    >>> dict(zip(table.metric, table.value))["length_ratio"]
    1.5
    """
    size = 1 + int(episodes.goal.max()) if len(episodes) else 1
    keys, index = (episodes.scene * size + episodes.goal).unique(return_inverse=True)
    trained = torch.zeros(len(keys), dtype=torch.bool)
    trained[index[episodes.trained]] = True
    columns = {}
    for metric in metrics_within(within, episodes.max_steps):
        parts = metric.parts(episodes)
        if parts is not None:
            zeros = torch.zeros(len(keys), dtype=torch.float64)
            columns[metric.name] = [zeros.index_add(0, index, part.to(torch.float64)) for part in parts]
    scenes = np.array(episodes.scene_names, dtype=object)[(keys // size).numpy()]
    return _rows(columns, scenes, keys % size, trained, run or model, model, seed, mode)


def exact_rows(
    exact: ExactGoals,
    goals: pd.DataFrame,
    scenes: Sequence[str],
    model: str,
    *,
    run: str = "",
    seed: int = -1,
) -> pd.DataFrame:
    """The long table of exact values, mode ``exact``.

    Args:
        exact: of all goals.
        goals: rows with scene, goal and trained: the goals to keep.
        scenes: names, by their index in ``exact``.
    """
    size = 1 + int(max(exact.goal.max(), goals.goal.max()))
    place = torch.full((len(scenes) * size,), -1)
    place[exact.scene * size + exact.goal] = torch.arange(len(exact.goal))
    number = {name: index for index, name in enumerate(scenes)}
    scene = torch.tensor([number[name] for name in goals.scene])
    rows = place[scene * size + torch.tensor(goals.goal.to_numpy())]
    ones = torch.ones(len(rows), dtype=torch.float64)
    columns = {name: [column[rows].to(torch.float64), ones] for name, column in exact.metrics.items()}
    goal, trained = (torch.tensor(goals[name].to_numpy()) for name in ("goal", "trained"))
    return _rows(columns, goals.scene.to_numpy(), goal, trained, run or model, model, seed, "exact")


def random_walk_rows(
    scenes: SceneSet,
    goals: Tensor,
    trained: Tensor,
    max_steps: int = MAX_STEPS,
    within: Sequence[int] = WITHIN,
    unreachable: Unreachable = "skip",
) -> pd.DataFrame:
    """The long table of the random walk: exact success; goals that no start can reach are left out.

    Args:
        scenes: the world.
        goals: (G,) global state ids.
        trained: global ids of the trained goals.
        max_steps, within, unreachable: as for the policies beside it.
    """
    goals = goals.cpu()
    scene, local = scenes.scene_id.cpu()[goals], scenes.local_id(goals.to(scenes.scene_id.device)).cpu()
    names = [metric.name for metric in metrics_within(within, max_steps) if metric.name[:8] == "success_"]
    found = torch.empty(len(names), len(goals), dtype=torch.float64)
    for index, room in enumerate(scenes.scenes):
        here = scene == index
        for row, name in enumerate(names):
            found[row, here] = random_walk(room, local[here], int(name[8:]), unreachable)
    kept = ~found.isnan().any(0)
    ones = torch.ones(int(kept.sum()), dtype=torch.float64)
    columns = {name: [row[kept], ones] for name, row in zip(names, found, strict=True)}
    places = np.array(scenes.names, dtype=object)[scene[kept].numpy()]
    is_trained = torch.isin(goals[kept], trained.cpu())
    return _rows(columns, places, local[kept], is_trained, RANDOM_WALK, RANDOM_WALK, -1, "exact")


def _rows(
    columns: Mapping[str, Sequence[Tensor]],
    scene: np.ndarray,
    goal: Tensor,
    trained: Tensor,
    run: str,
    model: str,
    seed: int,
    mode: str,
) -> pd.DataFrame:
    count, size = len(columns), len(goal)
    over, under = (torch.cat([parts[i] for parts in columns.values()]).numpy() for i in (0, 1))
    with np.errstate(invalid="ignore", divide="ignore"):
        value = np.where(under > 0, over / under, np.nan)
    codes, places = pd.factorize(scene)

    def constant(name: str) -> pd.Categorical:
        return pd.Categorical.from_codes(np.zeros(count * size, dtype=np.int8), [name])

    return pd.DataFrame(
        {
            "run": constant(run),
            "model": constant(model),
            "seed": seed,
            "scene": pd.Categorical.from_codes(np.tile(codes, count), places),
            "goal": np.tile(goal.numpy(), count),
            "trained": np.tile(trained.numpy(), count),
            "mode": constant(mode),
            "metric": pd.Categorical.from_codes(np.arange(count).repeat(size), list(columns)),
            "numerator": over,
            "denominator": under,
            "value": value,
        }
    )


def join_tables(tables: Iterable[pd.DataFrame]) -> pd.DataFrame:
    """Several long tables as one; names become categories in the order in which they first appear."""
    tables = list(tables)
    joined = {name: union_categoricals([table[name] for table in tables]) for name in _NAMES}
    rest = pd.concat([table.drop(columns=_NAMES) for table in tables], ignore_index=True)
    return rest.assign(**joined)[tables[0].columns]


def pool(table: pd.DataFrame, by: Sequence[str]) -> pd.DataFrame:
    """Sums of numerators and denominators over all rows that agree in ``by``, and their ratio.

    Returns:
        one row per group: the columns ``by``, numerator, denominator and value (NaN for a denominator of 0).
    """
    groups = table.groupby(list(by), observed=True, sort=True)[_SUMMED]
    pooled = groups.sum().reset_index()
    pooled["value"] = (pooled.numerator / pooled.denominator).where(pooled.denominator > 0)
    return pooled


def select_goals(table: pd.DataFrame, subset: str) -> pd.DataFrame:
    """The rows of one of :data:`SUBSETS`."""
    return table if subset == "all" else table[table.trained == (subset == "trained")]


def average_over_scenes(table: pd.DataFrame, by: Sequence[str]) -> pd.DataFrame:
    """:func:`pool` per scene and, where there are several scenes, both averages over them.

    The mean of scenes averages the values of the scenes that have one; the mean of states pools all goals.

    Args:
        table: long.
        by: columns beside ``scene`` to group by, ``metric`` among them.
    """
    scenes = pool(table, [*by, "scene"])
    if scenes.scene.nunique() < 2:
        return scenes
    mean = scenes.groupby(list(by), observed=True, sort=True).value.mean().reset_index()
    whole = pool(table, by)
    parts = [scenes, mean.assign(scene=MEAN_OF_SCENES), whole.assign(scene=MEAN_OF_STATES)]
    return pd.concat([part.assign(scene=part.scene.astype(object)) for part in parts], ignore_index=True)


def goal_sums(tables: Sequence[pd.DataFrame], metric: str) -> tuple[Sums, Tensor] | None:
    """Numerators and denominators of a metric, per seed and goal.

    Args:
        tables: K long tables, one per seed, each of one mode.

    Returns:
        sums (K, G) and the number (G,) of each goal's scene; None where there are no goals, or the seeds have
        different ones.
    """
    parts = []
    for table in tables:
        rows = np.flatnonzero(table.metric == metric)
        rows = rows[np.lexsort((table.goal.to_numpy()[rows], table.scene.cat.codes.to_numpy()[rows]))]
        parts.append([table[name].array[rows].to_numpy() for name in ("scene", "goal", *_SUMMED)])
    scenes, goals, over, under = zip(*parts, strict=True) if parts else ([()],) * 4
    if not len(scenes[0]) or any(not np.array_equal(x, of[0]) for of in (goals, scenes) for x in of):
        return None
    sums = Sums(*(torch.tensor(np.stack(part)) for part in (over, under)))
    return sums, torch.tensor(pd.factorize(scenes[0])[0])


def distance_to_trained(scenes: SceneSet, scene: Tensor, goal: Tensor, trained: Tensor) -> Tensor:
    """Fewest actions from a trained goal of the same scene to each goal, -1 where there is none.

    Args:
        scenes: the world.
        scene, goal, trained: (G,) int64, int64 and bool.

    >>> bathroom, goals = SceneSet.bundled(["bathroom"]), torch.arange(4)
    >>> distance_to_trained(bathroom, goals * 0, goals, goals == 0).tolist()
    [0, 1, 2, 1]
    """
    nearest_one = torch.full_like(goal, -1)
    for index, room in enumerate(scenes.scenes):
        here = scene == index
        sources = goal[here & trained]
        if sources.numel():
            table = room.distances_to(goal[here])[:, sources].T.to(torch.int64)
            far = table.max() + 1
            nearest = torch.where(table < 0, far, table).amin(0)
            nearest_one[here] = torch.where(nearest == far, -1, nearest)
    return nearest_one


def distance_bin(index: int) -> str:
    """The actions of a bin of :data:`DISTANCE_BINS` in words.

    >>> [distance_bin(index) for index in range(len(DISTANCE_BINS))]
    ['0', '1–2', '3–4', '5–7', '8–11', '12 or more']
    """
    first, after = DISTANCE_BINS[index], (*DISTANCE_BINS, None)[index + 1]
    if after is None:
        return f"{first} or more"
    return str(first) if after == first + 1 else f"{first}–{after - 1}"


def row_label(name: str, architecture: str | None = None) -> str:
    """Label of a model in tables: its row's name, and its architecture unless that is ``controlled``.

    >>> row_label("vusfa", "paper"), row_label("vusfa", "controlled")
    ('vusfa (paper)', 'vusfa')
    """
    return name if architecture in (None, "", "controlled") else f"{name} ({architecture})"
