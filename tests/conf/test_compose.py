"""Composition of settings: paths with any characters are read as they are."""

from __future__ import annotations

from pathlib import Path

import pytest

from vusfa.cli.launch import compose
from vusfa.conf.compose import as_text
from vusfa.experiments.table1 import checkpoints

NAMES = [
    "runs/first",
    "a=b",
    "a,b",
    "(c) [d] {e}",
    "it's",
    'a "b"',
    "back\\slash\\",
    "küche é",
    " c: 1 ",
    "null",
]


@pytest.mark.parametrize("name", NAMES)
def test_a_value_is_read_as_it_is(name: str) -> None:
    assert compose(overrides=[f"folder={as_text(name)}"]).folder == (None if name == "null" else name)
    scenes = compose(overrides=[f"scenes=[{as_text(name)},bathroom]"]).scenes
    assert list(scenes) == [None if name == "null" else name, "bathroom"]


def test_cells_of_table_1_lie_in_folders_of_any_name(tmp_path: Path) -> None:
    overrides = ["scenes=[bathroom]", "agent.model=gvf", "agent.hidden_size=8", "agent.embedding_size=8"]
    overrides += ["agent.history=1", "collector.num_envs=6", "collector.rollout=4", "total_frames=24"]
    folder = tmp_path / "a=b,(c) [d] é"
    (path,) = checkpoints(folder, [*overrides, "evaluation=none"], [1.0])
    assert path == folder / "checkpoint-100.pt"
    assert path.is_file()
