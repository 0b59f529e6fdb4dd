"""The registry of metrics.

A metric is one registered function from :class:`~vusfa.evaluation.episodes.Episodes` to a numerator and a
denominator per episode; over any set of episodes its value is the sum of the numerators over the sum of the
denominators (ones for a mean). Every table, interval, CSV file and the report's page read the registry, so a
new metric is one function:

>>> @register_metric("collision_rate", label="collisions per action", digits=2, higher_is_better=False)
... def collision_rate(episodes):
...     return episodes.collisions, episodes.length
>>> METRICS.pop("collision_rate").label
'collisions per action'
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from vusfa.errors import ConfigError
from vusfa.evaluation.episodes import Episodes

__all__ = ["METRICS", "Metric", "get_metric", "metrics_within", "register_metric", "success_within"]

Parts = Callable[[Episodes], tuple[Tensor, Tensor] | None]


@dataclass(frozen=True)
class Metric:
    """A metric and how it is shown.

    Attributes:
        name: the column's name.
        parts: numerator and denominator, (n,) each, of n episodes; None where they lack a column.
        label: head of a table's column.
        short: the same for a terminal of 80 characters.
        title: one line for a chart's axis.
        unit: ``%`` for shares, which are kept as fractions and printed times 100; or empty.
        digits: decimals to print.
        higher_is_better: the direction of improvement.
        exact: whether it reads success, length and shortest only and its denominators are ones, so that
            :func:`~vusfa.evaluation.exact.exact_goals` can compute its expectation.
    """

    name: str
    parts: Parts
    label: str
    short: str
    title: str = ""
    unit: str = ""
    digits: int = 1
    higher_is_better: bool = True
    exact: bool = False

    @property
    def scale(self) -> float:
        """Factor of printed values."""
        return 100.0 if self.unit == "%" else 1.0

    @property
    def heading(self) -> str:
        """The label with its unit."""
        return f"{self.label}, {self.unit}" if self.unit else self.label

    def text(self, value: float) -> str:
        """A value as in tables, without its unit.

        >>> METRICS["spl"].text(0.4567), METRICS["spl"].text(math.nan)
        ('45.7', '–')
        """
        return "–" if math.isnan(value) else f"{self.scale * value:.{self.digits}f}"

    def value(self, episodes: Episodes) -> float:
        """Numerators over denominators; NaN without episodes, or where the metric is not defined."""
        parts = self.parts(episodes)
        if parts is None:
            return math.nan
        over, under = (part.to(torch.float64).sum().item() for part in parts)
        return over / under if under else math.nan


#: Registered metrics by name, in the order in which tables show them, after success.
METRICS: dict[str, Metric] = {}


def register_metric(
    name: str,
    *,
    label: str,
    short: str = "",
    title: str = "",
    unit: str = "",
    digits: int = 1,
    higher_is_better: bool = True,
    exact: bool = False,
) -> Callable[[Parts], Parts]:
    """Register a function as a metric; arguments as in :class:`Metric`.

    ``short`` and ``title`` are the label by default.

    Raises:
        ConfigError: the name is taken.
    """
    if name in METRICS or name.startswith("success_"):
        raise ConfigError(f"a metric called {name!r} is registered already; give another name")

    def register(parts: Parts) -> Parts:
        words = label, short or label, title or label
        METRICS[name] = Metric(name, parts, *words, unit, digits, higher_is_better, exact)
        return parts

    return register


def success_within(limit: int) -> Metric:
    """``success_LIMIT``: the share of episodes that reached their goal within ``limit`` actions.

    >>> success_within(100).heading
    'success in 100, %'
    """
    return Metric(
        f"success_{limit}",
        lambda episodes: (episodes.success & (episodes.length <= limit), torch.ones_like(episodes.length)),
        f"success in {limit}",
        f"@{limit}",
        f"Goals reached within {limit} actions",
        "%",
        exact=True,
    )


def get_metric(name: str) -> Metric:
    """The metric of this name.

    Raises:
        ConfigError: there is none.

    >>> get_metric("success_100").name, get_metric("spl").label
    ('success_100', 'SPL')
    """
    limit = name.removeprefix("success_")
    if limit != name and limit.isdigit():
        return success_within(int(limit))
    if name not in METRICS:
        raise ConfigError(f"metric {name!r}: unknown; give success_N or one of {', '.join(METRICS)}")
    return METRICS[name]


def metrics_within(within: Sequence[int], max_steps: int) -> list[Metric]:
    """Success within each limit, the largest first, then all registered metrics.

    Args:
        within: limits of actions; those above ``max_steps`` are left out.
        max_steps: of the episodes; always among the limits.

    >>> [metric.name for metric in metrics_within([1000, 20], 500)][:3]
    ['success_500', 'success_20', 'spl']
    """
    limits = sorted({max_steps, *(limit for limit in within if limit < max_steps)}, reverse=True)
    return [*(success_within(limit) for limit in limits), *METRICS.values()]


@register_metric("spl", label="SPL", title="SPL: success weighted by path length", unit="%", exact=True)
def spl(episodes: Episodes) -> tuple[Tensor, Tensor]:
    """Success weighted by path length, ``success * shortest / max(length, shortest)``, in actions instead of
    meters (Anderson et al. 2018, arXiv 1807.06757, eq. 1).
    """
    best = episodes.shortest.to(torch.float64)
    scores = torch.where(episodes.success, best / torch.maximum(episodes.length.to(torch.float64), best), 0.0)
    return scores, torch.ones_like(scores)


@register_metric("soft_spl", label="soft-SPL", short="soft", title="soft-SPL: SPL of the progress", unit="%")
def soft_spl(episodes: Episodes) -> tuple[Tensor, Tensor] | None:
    """SPL with progress in place of success: the share of the shortest path covered when the episode ends,
    ``max(0, 1 - remaining / shortest)`` (Datta et al. 2020, arXiv 2009.03231, sec. 4).
    """
    if episodes.remaining is None:
        return None
    best = episodes.shortest.to(torch.float64)
    progress = (1 - episodes.remaining / best.clamp(min=1)).clamp(min=0)
    scores = progress * best / torch.maximum(episodes.length.to(torch.float64), best)
    scores = torch.where((best > 0) & (episodes.remaining >= 0), scores, 0.0)
    return scores, torch.ones_like(scores)


@register_metric(
    "length",
    label="length",
    short="steps",
    title="Length of successful episodes (actions)",
    digits=2,
    higher_is_better=False,
)
def length(episodes: Episodes) -> tuple[Tensor, Tensor]:
    """Actions of the successful episodes."""
    return episodes.success * episodes.length, episodes.success


@register_metric("length_ratio", label="length / shortest", short="ratio", digits=2, higher_is_better=False)
def length_ratio(episodes: Episodes) -> tuple[Tensor, Tensor]:
    """Length of the successful episodes over their shortest paths: a ratio of means, so that an episode that
    starts beside its goal does not weigh as much as a long one."""
    return episodes.success * episodes.length, episodes.success * episodes.shortest


@register_metric(
    "collisions",
    label="collisions",
    short="bump",
    title="Blocked actions per episode",
    higher_is_better=False,
)
def collisions(episodes: Episodes) -> tuple[Tensor, Tensor]:
    """Actions that were blocked, per episode."""
    return episodes.collisions, torch.ones_like(episodes.collisions)
