from __future__ import annotations

from pathlib import Path

import pytest

from vusfa.errors import ConfigError
from vusfa.experiments.room_split import find_split, read_split


def test_the_packages_split() -> None:
    """240 small rooms to train in, 20 to choose by, 40 to test in, 40 of the kinds' own sizes; none twice."""
    split = read_split("unseen")
    rooms = {part: list(split.rooms(part)) for part in split.parts}
    assert {part: len(rooms[part]) for part in rooms} == {
        "train": 240,
        "validation": 20,
        "test": 40,
        "large": 40,
    }
    assert len({room[:2] for part in rooms.values() for room in part}) == 340
    for part, cells in {"train": 20, "validation": 20, "test": 20, "large": None}.items():
        assert {room[2] for room in rooms[part]} == {cells}
        kinds = [room[0] for room in rooms[part]]
        assert {kinds.count(kind) for kind in split.kinds} == {len(kinds) // 5}
    assert [room[:2] for room in rooms["train"][:6]] == [
        *((kind, 1) for kind in ("bathroom", "bedroom", "hall", "kitchen", "living_room")),
        ("bathroom", 2),
    ]


def test_a_folder_keeps_its_split(tmp_path: Path) -> None:
    split = read_split("unseen")
    assert find_split(tmp_path) is None
    for _ in range(2):
        split.write(tmp_path / "rooms")
    assert find_split(tmp_path / "rooms") == split
    (tmp_path / "other.yaml").write_text("kinds: [hall]\nparts: {train: {seeds: [1, 2]}}")
    with pytest.raises(ConfigError, match=r"split\.yaml: is another split"):
        read_split(tmp_path / "other.yaml").write(tmp_path / "rooms")


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("[1]", "is no split of rooms"),
        ("kinds: [hall]", "is no split of rooms"),
        ("{kinds: [hall], parts: {}, other: 1}", "is no split of rooms"),
        ("{kinds: hall, parts: {}}", "field 'kinds' is 'hall'"),
        ("{kinds: [../x], parts: {train: {seeds: [1, 2]}}}", "needs names of kinds"),
        ("{kinds: [hall], parts: {test: {seeds: [1, 2]}}}", "a part 'train'"),
        ("{kinds: [hall], parts: {train: [1, 2]}}", "part 'train' is"),
        ("{kinds: [hall], parts: {train: {seeds: [1]}}}", "has seeds .*, no first and last"),
        ("{kinds: [hall], parts: {train: {seeds: [1, true]}}}", "no first and last"),
        ("{kinds: [hall], parts: {train: {seeds: [2, 1]}}}", "has seeds 2 to 1"),
        ("{kinds: [hall], parts: {train: {seeds: [1, 9999999]}}}", "has seeds 1 to 9999999"),
        ("{kinds: [hall], parts: {train: {seeds: [1, 2], cells: many}}}", "field 'cells' is 'many'"),
        ("{kinds: [hall], parts: {train: {seeds: [1, 2]}, test: {seeds: [2, 3]}}}", "two parts share seeds"),
        ("{kinds: [hall], parts: {train: {seeds: [1, 2]}}, width: 1.5}", "field 'width' is 1.5"),
    ],
)
def test_what_is_no_split(tmp_path: Path, text: str, fault: str) -> None:
    (tmp_path / "split.yaml").write_text(text)
    with pytest.raises(ConfigError, match=fault):
        read_split(tmp_path / "split.yaml")


def test_a_name_that_is_none() -> None:
    with pytest.raises(ConfigError, match="unsene"):
        read_split("unsene")
