"""recipes/generalise.py on rooms of 16 and 12 states."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from vusfa.errors import ConfigError, SceneError, VusfaError
from vusfa.evaluation.searchers import SEARCHERS
from vusfa.experiments.generalise import policies, rooms_of, split_rooms
from vusfa.experiments.runs import read_run
from vusfa.modules import make_agent
from vusfa.scenes import Scene, SceneSet

SMALL = [
    "preset=unseen",
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


SPLIT = """\
kinds: [hall, attic]
parts:
  train: {seeds: [1, 2], cells: 20}
  validation: {seeds: [3, 3]}
  large: {seeds: [7, 9]}
"""


@pytest.fixture
def split_rooms_folder(make_scene: Callable[..., Scene], tmp_path: Path) -> Path:
    """All rooms of the split but attic-7 and those after it."""
    folder = tmp_path / "split"
    folder.mkdir()
    (folder / "split.yaml").write_text(SPLIT)
    for name in ("hall-1", "attic-1", "hall-2", "attic-2", "hall-3", "attic-3", "hall-7"):
        make_scene(name, 2, 2).save(folder / f"{name}.h5")
    return folder


def test_a_split_says_where_to_train_and_where_to_test(split_rooms_folder: Path, rooms: Path) -> None:
    def stems(*asked: Any) -> tuple[Any, ...]:
        first, last, part = rooms_of(split_rooms_folder, *asked)
        return [Path(path).stem for path in first], [Path(path).stem for path in last], part

    every = ["hall-1", "attic-1", "hall-2", "attic-2"]
    assert stems(None, None, None) == (every, ["hall-3", "attic-3"], "validation")
    assert stems(3, 1, "large") == (every[:3], ["hall-7"], "large")
    missing = r"attic-7.h5: there is no such file, nor 4 more.*render-rooms .* split=.*split.yaml"
    for asked, fault in {
        (5, None, None): "part 'train' has 4 rooms, not 5",
        (0, None, None): "part 'train' has 4 rooms, not 0",
        (1, None, "train"): "test is 'train', the rooms to train in",
        (1, None, "larg"): "no part 'larg'; did you mean 'large'",
        (1, None, "large"): missing,
    }.items():
        with pytest.raises(VusfaError, match=fault):
            rooms_of(split_rooms_folder, *asked)
    with pytest.raises(ConfigError, match=r"test is 'large', but .* has no split.yaml"):
        rooms_of(rooms, 1, 1, "large")
    assert rooms_of(rooms, 1, 1, None)[2] is None


def test_tested_in_two_parts_after_one_training(
    recipe: Callable[[str], Any], split_rooms_folder: Path, tmp_path: Path
) -> None:
    folders = {"results": tmp_path / "results", "runs": tmp_path / "runs"}
    asked: dict[str, Any] = {"trained": 2, "tested": 1, "episodes": 1, "searchers": False, **folders}
    recipe("generalise").generalise(split_rooms_folder, SMALL, **asked)
    recipe("generalise").generalise(split_rooms_folder, SMALL, **asked, test="large")
    for part, room in (("validation", "hall-3"), ("large", "hall-7")):
        run = read_run(tmp_path / "results", "generalise", f"vusfa-{part}-0")
        assert run.info["tested_in"] == [room]
        assert run.info["part"] == part
        assert run.info["trained_in"] == ["hall-1", "attic-1"]
        assert tuple(run.episodes) == ("agent", "agent-memory", "memory")
    assert [path.name for path in (tmp_path / "runs" / "generalise").iterdir()] == ["vusfa-0"]
    with pytest.raises(ConfigError, match="vusfa-0: this agent was trained in 2 rooms, not in the 3"):
        recipe("generalise").generalise(split_rooms_folder, SMALL, **{**asked, "trained": 3}, again=True)


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


def test_an_agent_that_remembers_by_itself_walks_without_a_count_of_tried_actions(rooms: Path) -> None:
    scenes = SceneSet.open([str(rooms / "hall-1.h5")])
    agents: dict[str, Any] = {"hidden_size": 8, "embedding_size": 8, "scenes": scenes, "shared_heads": True}
    assert set(policies(make_agent("gvf", memory="lstm", **agents), scenes, 3.0, 1.0)) == {"agent", "memory"}
    assert set(policies(make_agent("gvf", **agents), scenes, 3.0, 1.0)) == {"agent", "agent-memory", "memory"}


def test_imitation_trains_and_is_tested_in_other_rooms(
    recipe: Callable[[str], Any], rooms: Path, tmp_path: Path
) -> None:
    results = tmp_path / "results"
    small = [each for each in SMALL if not each.startswith(("preset", "agent.history"))]
    recipe("generalise").generalise(
        rooms, ["agent.fusion=concatenation", *small], trained=2, tested=1, episodes=2,
        results=results, runs=tmp_path / "runs", searchers=False,
    )  # fmt: skip
    run = read_run(results, "generalise", "vusfa-0")
    assert set(run.episodes) == {"agent", "memory"}
    assert len(run.episodes["agent"].success) == 2 * 36
