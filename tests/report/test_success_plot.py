"""The plot of a table of results."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from vusfa.errors import ResultError
from vusfa.evaluation.baselines import RANDOM_WALK, SHORTEST_PATH
from vusfa.evaluation.statistics import Estimate
from vusfa.report.success_plot import draw_success

ROWS: list[dict[str, Any]] = [
    {"goals": goals, "model": model, "success_500": Estimate(value, value - 0.02, min(value + 0.02, 1))}
    for goals, values in {"trained": (1.0, 0.25, 1.0), "unseen": (0.15, 0.29, 1.0)}.items()
    for model, value in zip(("gvf", RANDOM_WALK, SHORTEST_PATH), values, strict=True)
]


def ink(path: Path) -> set[tuple[int, int]]:
    with Image.open(path) as image:
        rows, columns = np.nonzero((np.asarray(image.convert("RGB")) == (0x1F, 0x61, 0xB6)).all(-1))
    return set(zip(columns.tolist(), rows.tolist(), strict=True))


def test_points_lie_where_the_numbers_are(tmp_path: Path) -> None:
    found = ink(draw_success(ROWS, tmp_path / "a.png"))
    with Image.open(tmp_path / "a.png") as image:
        width = image.width
    left, right = ([x for x, _ in found if (x < width / 2) == first] for first in (True, False))
    # 100 % at the right end of the first panel, 15 % near the left end of the second
    assert max(left) > 0.4 * width
    assert min(right) - width / 2 < 0.15 * width
    moved = [{**row, "success_500": Estimate(0.9, 0.88, 0.92)} for row in ROWS]
    assert ink(draw_success(moved, tmp_path / "b.png")) != found


@pytest.mark.parametrize("rows", [[], ROWS[1:3], [{"goals": "unseen", "model": "gvf"}]])
def test_rows_without_the_metric(rows: list[dict[str, Any]], tmp_path: Path) -> None:
    with pytest.raises(ResultError, match="no result has the metric 'success_500'"):
        draw_success(rows, tmp_path / "a.png")
    assert not (tmp_path / "a.png").exists()
