"""recipes/generalise.py on rooms of 16 and 12 states."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from vusfa.errors import SceneError
from vusfa.evaluation.searchers import SEARCHERS
from vusfa.experiments.generalise import split_rooms
from vusfa.experiments.runs import read_run
from vusfa.scenes import Scene

SMALL = [
    "agent.hidden_size=8",
    "agent.embedding_size=8",
    "agent.history=2",
    "collector.num_envs=32",
    "collector.rollout=4",
    "total_frames=256",
]


@pytest.fixture
def rooms(make_scene: Callable[..., Scene], tmp_path: Path) -> Path:
    folder = tmp_path / "rooms"
    folder.mkdir()
    for name in ("hall-1", "attic-2", "hall-10", "attic-9"):
        make_scene(name.split("-")[0], *((4, 2) if name < "b" else (3, 3))).save(folder / f"{name}.h5")
    return folder


def test_the_last_numbers_are_tested(recipe: Callable[[str], Any], rooms: Path) -> None:
    first, last = split_rooms(rooms, 2, 1)
    assert [Path(path).stem for path in first] == ["hall-1", "attic-2"]
    assert [Path(path).stem for path in last] == ["hall-10"]
    with pytest.raises(SceneError, match=r"4 dumps \(\.h5\), 5 are wanted"):
        split_rooms(rooms, 4, 1)


def test_trained_in_some_rooms_and_tested_in_others(
    recipe: Callable[[str], Any], rooms: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folders = {"results": tmp_path / "results", "runs": tmp_path / "runs"}
    asked: dict[str, Any] = {"trained": 3, "tested": 1, "episodes": 2, **folders}
    recipe("generalise").generalise(rooms, SMALL, **asked)
    cell = read_run(tmp_path / "results", "generalise", "vusfa-0")
    assert cell.info["trained_in"] == ["hall-1", "attic-2", "attic-9"]
    assert cell.info["tested_in"] == ["hall"]
    assert tuple(cell.episodes) == ("agent", "agent-memory", "memory", *SEARCHERS)
    assert cell.episodes["shortest-path"].success.all()
    sizes = {way: len(table) for way, table in cell.episodes.items()}
    assert set(sizes.values()) == {2 * len(cell.episodes["agent"].goal.unique())}
    assert not cell.episodes["agent"].trained.any()
    printed = capsys.readouterr().out
    assert "random walk" in printed
    assert "agent-memory" in printed
    recipe("generalise").generalise(rooms, SMALL, **asked)  # the checkpoint is there: the same numbers
    again = read_run(tmp_path / "results", "generalise", "vusfa-0")
    assert again.episodes["agent"].equal(cell.episodes["agent"])
