"""Two of the tutorials run, in tiny form; the site runs all of them in full."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import pytest
import torch

from tests.docs.pages import DOCS, cells, run_cells

TUTORIALS = sorted(path for path in (DOCS / "tutorials").glob("*.md") if path.name != "index.md")


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """What a tutorial writes goes to a folder of its own; figures go nowhere."""
    monkeypatch.chdir(tmp_path)
    matplotlib.use("Agg")
    yield
    plt.close("all")


@pytest.mark.parametrize("path", TUTORIALS, ids=lambda path: path.stem)
def test_every_tutorial_is_a_notebook_with_parameters(path: Path) -> None:
    assert path.read_text(encoding="utf-8").startswith("---\njupytext:\n")
    assert sum("parameters" in cell.tags for cell in cells(path)) == 1


def test_successor_features_in_a_gymnasium_task() -> None:
    names = run_cells(DOCS / "tutorials" / "gymnasium.md", {"size": 8, "frames": 200, "environments": 2})
    assert {"loss_successor", "loss_objective", "loss_critic"} <= set(names["terms"].keys())
    assert names["values"].shape == (9, 9)


def test_psi_has_an_exact_value() -> None:
    tiny = {"frames": 2_560, "width": 16, "embedding": 8}
    names = run_cells(DOCS / "tutorials" / "psi.md", tiny)
    occupancy, goal = names["occupancy"], names["goal"]
    # The goal is entered at most once, and after it nothing is visited.
    assert bool((occupancy[:, goal] <= 1 + 1e-9).all())
    assert torch.equal(occupancy[goal], torch.zeros_like(occupancy[goal]))
    assert bool((occupancy >= -1e-12).all())
    assert bool((occupancy.sum(-1) <= 1 / (1 - names["gamma"]) + 1e-6).all())
