"""Success and length of the training's episodes: per goal, per scene, and over all.

One :meth:`EpisodeMeter.update` per update: a few ``index_add`` over the episodes that ended in the batch,
nothing per goal in Python. Sums become rates when they are logged.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from vusfa.scenes import SceneSet

__all__ = ["EpisodeMeter", "MeanMeter", "quantiles"]

# The table of sums has five rows: episodes, successes, length, length of the successes, their shortest paths.
_EPISODES = 0
#: Scenes and goals up to which each has columns of its own in the log.
MAX_SCENES, MAX_GOALS = 100, 1000
_QUANTILES = (0.1, 0.5, 0.9)


class EpisodeMeter:
    """Sums over the episodes that ended since the last :meth:`flush`.

    Args:
        scenes: the world.
        goals: (G,) global ids of the goals trained on.

    >>> scenes = SceneSet.bundled(["bathroom"])
    >>> meter = EpisodeMeter(scenes, torch.tensor([3, 40]))
    >>> sorted(meter.flush())[:3]
    ['collisions', 'episodes', 'goal/bathroom/3/length_ratio']
    """

    def __init__(self, scenes: SceneSet, goals: Tensor) -> None:
        goals = goals.cpu().unique()
        self.goals = goals
        self._column = torch.full((scenes.num_states,), -1)
        self._column[goals] = torch.arange(len(goals))
        self._scene = scenes.scene_id.cpu()[goals]
        self._scene_names = scenes.names
        local = scenes.local_id(goals.to(scenes.scene_id.device)).tolist()
        self._names = [f"{scenes.names[s]}/{g}" for s, g in zip(self._scene.tolist(), local, strict=True)]
        self.is_aggregated = len(scenes.names) > MAX_SCENES or len(self._names) > MAX_GOALS
        self._totals = torch.zeros(5, len(goals) if self.is_aggregated else 0, dtype=torch.float64)
        self._clear()

    def _clear(self) -> None:
        self._sums = torch.zeros(5, len(self.goals), dtype=torch.float64)
        self._frames = 0
        self._collisions = torch.zeros((), dtype=torch.int64)

    def update(self, batch: TensorDictBase) -> None:
        """Add a collector's batch, of any shape."""
        after = batch.get("next")
        self._frames += batch.numel()
        self._collisions += after.get("collided").sum().cpu()
        done = after.get("done").squeeze(-1)
        if not bool(done.any()):
            return
        column = self._column[after.get("goal_id")[done].cpu()]
        success = after.get("terminated").squeeze(-1)[done].cpu().to(torch.float64)
        length = after.get("elapsed_steps").squeeze(-1)[done].cpu().to(torch.float64)
        shortest = after.get("shortest_path").squeeze(-1)[done].cpu().to(torch.float64)
        rows = [torch.ones_like(length), success, length, success * length, success * shortest]
        self._sums.index_add_(1, column, torch.stack(rows))

    def add(self, state: Mapping[str, Tensor]) -> None:
        """Add the sums of another meter for the same goals, its :meth:`state_dict`."""
        self._sums += state["sums"]
        self._frames += int(state["frames"])
        self._collisions += state["collisions"].to(torch.int64)

    def flush(self) -> dict[str, float]:
        """Return the rates since the last call, and start over.

        Returns:
            ``episodes`` and ``collisions`` (per step); ``success`` (share of the episodes that ended at their
            goal), ``length`` (of an episode, in actions) and ``length_ratio`` (mean length of the successful
            episodes over the mean of their shortest paths) over all goals; the same under ``scene/NAME/``
            and, without the length, under ``goal/NAME/STATE/``. With more than :data:`MAX_SCENES` scenes or
            :data:`MAX_GOALS` goals: instead of these, how many of them had an episode (``scenes/seen``),
            and quantiles of their success (``scenes/success_p10``, ``_p50``, ``_p90``; ``goals/...``). A
            rate over no episode is NaN. The keys are always the same.
        """
        sums = self._sums
        collisions = self._collisions.item() / self._frames if self._frames else math.nan
        result = {
            "episodes": sums[_EPISODES].sum().item(),
            "collisions": collisions,
            **_rates(sums.sum(1).tolist()),
        }
        by_scene = sums.new_zeros(5, len(self._scene_names)).index_add_(1, self._scene, sums)
        if len(self._scene_names) > MAX_SCENES:
            result |= _spread("scenes", by_scene)
        else:
            for index in self._scene.unique().tolist():
                rates = _rates(by_scene[:, index].tolist())
                result |= {f"scene/{self._scene_names[index]}/{key}": rate for key, rate in rates.items()}
        if len(self._names) > MAX_GOALS:
            result |= _spread("goals", sums)
        else:
            for name, column in zip(self._names, sums.T.tolist(), strict=True):
                rates = _rates(column)
                result |= {f"goal/{name}/{key}": rates[key] for key in ("success", "length_ratio")}
        if self.is_aggregated:
            self._totals += sums
        self._clear()
        return result

    def table(self) -> dict[str, np.ndarray]:
        """Sums over all episodes, those before the last :meth:`flush` included, where goals or scenes are
        too many for columns of their own in the log.

        Returns:
            columns (G,): ``scene``, the name; ``goal``, the id within it; ``episodes``, ``successes``, and
            the actions of all episodes (``length``), of the successful ones (``success_length``) and of their
            shortest paths (``success_shortest``).
        """
        names = ("episodes", "successes", "length", "success_length", "success_shortest")
        scene, goal = zip(*(name.rsplit("/", 1) for name in self._names), strict=True)
        columns = dict(zip(names, (self._totals + self._sums).numpy(), strict=True))
        return {"scene": np.array(scene), "goal": np.array(goal, np.int64), **columns}

    def state_dict(self) -> dict[str, Tensor]:
        """The sums since the last :meth:`flush`, and those of :meth:`table` where there is one."""
        totals = {"totals": self._totals} if self.is_aggregated else {}
        since = {"sums": self._sums, "frames": torch.tensor(self._frames), "collisions": self._collisions}
        return since | totals

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Go on from what :meth:`state_dict` gave, for the same goals."""
        self._sums = state["sums"].cpu()
        self._frames = int(state["frames"])
        self._collisions = state["collisions"].cpu()
        if "totals" in state:
            self._totals = state["totals"].cpu()


class MeanMeter:
    """Means, since the last :meth:`flush`, of numbers that every update gives, such as a loss's terms.

    >>> meter = MeanMeter()
    >>> meter.update({"kl": torch.tensor(0.5)})
    >>> meter.update({"kl": torch.tensor(0.25)})
    >>> meter.flush(), meter.flush()
    ({'kl': 0.375}, {'kl': nan})
    """

    def __init__(self) -> None:
        self._names: list[str] = []
        self._sum: Tensor | None = None
        self._count = 0

    def update(self, values: Mapping[str, Tensor]) -> None:
        """Add one number per name, the same names each time; sums stay on their device."""
        self._names = self._names or list(values)
        row = torch.stack([values[name].detach().to(torch.float64) for name in self._names])
        self._sum = row if self._sum is None else self._sum + row
        self._count += 1

    def flush(self) -> dict[str, float]:
        """Return the means since the last call, NaN without an update, and start over."""
        if self._sum is None or not self._count:
            return dict.fromkeys(self._names, math.nan)
        result = dict(zip(self._names, (self._sum / self._count).tolist(), strict=True))
        self._sum, self._count = None, 0
        return result

    def state_dict(self) -> dict[str, Any]:
        """The sums since the last :meth:`flush`."""
        return {"names": self._names, "sum": self._sum, "count": self._count}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from what :meth:`state_dict` gave.

        Raises:
            ValueError: it is none.
        """
        names, total, count = list(state["names"]), state["sum"], state["count"]
        fits = total is None or (isinstance(total, Tensor) and total.shape == (len(names),))
        if not fits or type(count) is not int or not all(isinstance(name, str) for name in names):
            raise ValueError(f"{len(names)} names, {count} updates and sums that do not fit them")
        self._names, self._sum, self._count = names, total, count


def _spread(name: str, sums: Tensor) -> dict[str, float]:
    """Of the columns of a table of sums that have episodes: their number, and quantiles of their success."""
    seen = sums[:, sums[_EPISODES] > 0]
    success = quantiles(f"{name}/success", seen[1] / seen[_EPISODES])
    return {f"{name}/seen": float(seen.shape[1]), **success}


def quantiles(name: str, values: Tensor) -> dict[str, float]:
    """Quantiles of values (n,) but for NaN, which they are where there is none.

    >>> quantiles("success", torch.tensor([0.0, 0.5, 1.0, math.nan]))
    {'success_p10': 0.10..., 'success_p50': 0.5, 'success_p90': 0.89...}
    """
    known = values[~values.isnan()]
    found = known.quantile(known.new_tensor(_QUANTILES)).tolist() if len(known) else [math.nan] * 3
    return {f"{name}_p{100 * q:.0f}": value for q, value in zip(_QUANTILES, found, strict=True)}


def _rates(sums: Sequence[float]) -> dict[str, float]:
    episodes, successes, length, success_length, success_shortest = sums
    return {
        "success": successes / episodes if episodes else math.nan,
        "length": length / episodes if episodes else math.nan,
        "length_ratio": success_length / success_shortest if success_shortest else math.nan,
    }
