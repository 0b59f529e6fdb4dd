"""95 % bootstrap intervals over seeds and goals, for every metric of a report's summary.

See :mod:`vusfa.evaluation.statistics` for how they are drawn.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import pandas as pd
import torch

from vusfa.evaluation.long_table import MEAN_OF_SCENES, goal_sums
from vusfa.evaluation.statistics import Draws, bootstrap_mean, make_draws

__all__ = ["intervals"]


def intervals(tables: Sequence[pd.DataFrame], scene: str, names: Sequence[str]) -> dict[str, float]:
    """Ends of the 95 % interval of every metric: ``name_from`` and ``name_to``, NaN where there is none.

    Args:
        tables: K long tables, one per seed, of a subset of goals.
        scene: name of a scene, or of a mean over scenes.
        names: metrics.
    """
    chosen = tables
    if tables and scene in tables[0].scene.cat.categories:
        chosen = [table[table.scene == scene] for table in tables]
    result: dict[str, float] = {}
    for name in names:
        sums = goal_sums(chosen, name)
        low, high = math.nan, math.nan
        if sums is not None:
            seeds = len(sums[0].numerator)
            draws = _draws(seeds, tuple(sums[1].tolist()))
            _, low, high = bootstrap_mean(*sums, by_scene=scene == MEAN_OF_SCENES, draws=draws)
        result |= {f"{name}_from": low, f"{name}_to": high}
    return result


@lru_cache(maxsize=4)
def _draws(seeds: int, scene: tuple[int, ...]) -> Draws:
    """Bootstrap draws, cached for all metrics and models."""
    return make_draws(seeds, torch.tensor(scene))
