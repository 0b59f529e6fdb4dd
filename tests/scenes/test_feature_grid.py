"""Grids of features."""

from __future__ import annotations

import pytest
import torch

from vusfa.errors import ConfigError
from vusfa.scenes import Scene, SceneSet
from vusfa.scenes.feature_grid import feature_grid, parse_grid


def rooms(*grids: str | None) -> SceneSet:
    graph = torch.tensor([[1, -1], [0, -1]])
    made = []
    for number, grid in enumerate(grids):
        attributes = {} if grid is None else {"feature_grid": grid}
        made.append(Scene(f"room{number}", graph, torch.rand(2, 1, 12), attributes=attributes))
    return SceneSet(made)


def test_it_is_what_the_scenes_say() -> None:
    assert feature_grid(rooms("2x3", "2x3")) == (2, 3)
    assert feature_grid(rooms(None, None)) == (1, 1)


@pytest.mark.parametrize("grids", [("2x3", "3x2"), (None, "2x3"), ("5x2",), ("axb",), ("0x4",), ("100x1",)])
def test_grids_that_do_not_fit_are_refused(grids: tuple[str | None, ...]) -> None:
    with pytest.raises(ConfigError, match=r"12 features on grids of .*; give rooms with one feature_grid"):
        feature_grid(rooms(*grids))


def test_words_become_rows_and_columns() -> None:
    assert parse_grid("12x3") == (12, 3)
