"""Rows of a table as Markdown and as CSV."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

from vusfa.errors import printable
from vusfa.evaluation.metrics import METRICS, get_metric
from vusfa.evaluation.statistics import Estimate

__all__ = ["flat_rows", "markdown"]

Row = dict[str, Any]


def flat_rows(rows: Iterable[Row]) -> list[Row]:
    """Rows for CSV: an estimate becomes three columns, NAME, NAME_low and NAME_high; all rows get the same.

    >>> flat_rows([{"model": "gvf", "spl": Estimate(0.5, 0.25, 0.75)}, {"model": "walk"}])[0]
    {'model': 'gvf', 'spl': 0.5, 'spl_low': 0.25, 'spl_high': 0.75}
    """
    flat: list[Row] = []
    for row in rows:
        flat.append({})
        for key, value in row.items():
            named = zip(("", "_low", "_high"), value, strict=True) if isinstance(value, Estimate) else ()
            flat[-1] |= {f"{key}{end}": number for end, number in named} or {key: value}
    names = list(dict.fromkeys(name for row in flat for name in row))
    return [{name: row.get(name, "") for name in names} for row in flat]


def markdown(rows: Sequence[Row], columns: Sequence[str]) -> str:
    """A table in Markdown; estimates as "value [low, high]", in the units of the registry, and
    differences of shares in percentage points.

    Args:
        rows: in order.
        columns: those to show; one that no row has is left out.

    >>> rows = [{"model": "gvf", "spl": Estimate(0.5, 0.25, 0.75)}, {"model": "walk"}]
    >>> print(markdown(rows, ["model", "spl"]))
    | model | SPL, % |
    |---|---|
    | gvf | 50.0 [25.0, 75.0] |
    | walk | – |
    """
    shown = [name for name in columns if any(name in row for row in rows)]
    heads = [get_metric(name).heading if _is_metric(name) else name.replace("_", " ") for name in shown]
    lines = [f"| {' | '.join(heads)} |", "|" + "---|" * len(shown)]
    lines += [f"| {' | '.join(_text(name, row.get(name)) for name in shown)} |" for row in rows]
    return "\n".join(lines)


def _is_metric(name: Any) -> bool:
    return name in METRICS or str(name).startswith("success_")


def _text(name: str, value: Any) -> str:
    if isinstance(value, Estimate):
        metric = get_metric(name if _is_metric(name) else "success_500")  # differences are of shares
        low, high = (metric.text(end) for end in value[1:])
        return metric.text(value.value) + ("" if math.isnan(value.low) else f" [{low}, {high}]")
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return (
            get_metric("success_500").text(value)
            if name == "trained"
            else "–"
            if math.isnan(value)
            else f"{value:.1f}"
        )
    if isinstance(value, int):
        return f"{value:,}"
    if value is None:
        return "–"
    text = get_metric(value).heading if _is_metric(value) else printable(str(value))
    return text.replace("|", "\\|").replace("\n", " ")
