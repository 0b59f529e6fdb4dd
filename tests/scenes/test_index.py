"""Many rooms opened from the index of their folder."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from vusfa import limits
from vusfa.errors import ResultError, SceneError
from vusfa.scenes import Scene, SceneSet, store
from vusfa.scenes import index as index_module
from vusfa.scenes.index import INDEX, read_index


@pytest.fixture(autouse=True)
def _three_are_many(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "LAZY_SCENES", 3)


@pytest.fixture
def folder(tmp_path: Path, make_scene: Callable[..., Scene]) -> Path:
    """Three rooms of 16, 24 and 16 states, with attributes of all kinds; the second has pictures."""
    inside = tmp_path / "rooms"
    inside.mkdir()
    for index, width in enumerate((2, 3, 2)):
        scene = make_scene(f"room {index}", width=width)
        scene.attributes.update(seed=index, exposure=0.1 * index, licences=["CC0", "é"], wide=width > 2)
        pictures = np.full((scene.num_states, 6, 8, 3), index, np.uint8) if index == 1 else None
        scene.save(inside / f"{index}.h5", pictures)
    return inside


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the files that have been opened since they were last looked at."""
    names: list[str] = []
    read = store.read

    def noted(path: Any, lazy: bool = False) -> store.Dump:
        names.append(Path(path).name)
        return read(path, lazy)

    monkeypatch.setattr(store, "read", noted)
    return names


def taken(names: list[str]) -> list[str]:
    held = list(names)
    names.clear()
    return held


def assert_same(one: SceneSet, other: SceneSet) -> None:
    for name in ("successor", "blocked", "scene_id", "location", "rotation", "offsets"):
        assert torch.equal(getattr(one, name), getattr(other, name))
    assert (one.names, one.actions, one.fingerprint) == (other.names, other.actions, other.fingerprint)
    assert torch.equal(one.features[:], other.features[:])
    for a, b in zip(one.scenes, other.scenes, strict=True):
        assert (a.attributes, a.picture_shape, a.actions) == (b.attributes, b.picture_shape, b.actions)
        assert a.graph.dtype == b.graph.dtype
        assert torch.equal(a.distance, b.distance)
        if a.stored and b.stored:
            assert (a.path, a.stored) == (b.path, b.stored)


def test_the_second_opening_opens_no_file_and_gives_the_same(folder: Path, opened: list[str]) -> None:
    first = SceneSet.open(folder, lazy=True)
    assert taken(opened) == ["0.h5", "1.h5", "2.h5"]
    second = SceneSet.open(folder, lazy=True)
    assert taken(opened) == []
    assert_same(first, second)
    assert_same(second, SceneSet.open(folder, lazy=False))
    assert second.scenes[0].attributes == {**second.scenes[0].attributes, "seed": 0, "licences": ["CC0", "é"]}
    assert second.scenes[1].attributes["wide"] is True
    assert torch.equal(second.pictures([16]), torch.ones(1, 6, 8, 3, dtype=torch.uint8))


def test_a_changed_file_is_read_again_and_others_are_not(
    folder: Path, opened: list[str], make_scene: Callable[..., Scene]
) -> None:
    SceneSet.open(folder, lazy=True)
    before = os.stat(folder / "1.h5")
    other = make_scene("another", width=3)
    graph = other.graph.clone()
    graph[0] = -1
    Scene("another", graph, other.features).save(folder / "1.h5")
    os.utime(folder / "1.h5", ns=(before.st_atime_ns, before.st_mtime_ns))
    taken(opened)
    found = SceneSet.open(folder, lazy=True)
    assert taken(opened) == ["1.h5"]
    assert found.names[1] == "another"
    assert torch.equal(found.scenes[1].graph, graph)
    again = SceneSet.open(folder, lazy=True)
    assert taken(opened) == []
    assert_same(found, again)
    # a copy of the folder has other times, and its index is made anew
    shutil.copytree(folder, folder.parent / "copy")
    assert SceneSet.open(folder.parent / "copy", lazy=True).names == found.names
    assert taken(opened) == ["0.h5", "1.h5", "2.h5"]
    assert SceneSet.open(folder.parent / "copy", lazy=True).scenes[0].path == folder.parent / "copy" / "0.h5"
    assert taken(opened) == []


def test_parts_of_a_folder_share_its_index(
    folder: Path, opened: list[str], make_scene: Callable[..., Scene]
) -> None:
    make_scene("room 3").save(folder / "3.h5")
    files = sorted(folder.glob("*.h5"))
    SceneSet.open(files[:3], lazy=True)
    taken(opened)
    assert SceneSet.open(files[1:], lazy=True).names == ("room 1", "room 2", "room 3")
    assert taken(opened) == ["3.h5"]
    SceneSet.open(folder, lazy=True)
    assert taken(opened) == []
    files[0].unlink()
    files[1].touch()
    SceneSet.open(folder, lazy=True)
    held = read_index(folder)
    assert held is not None
    assert sorted(held) == ["1.h5", "2.h5", "3.h5"]  # the one that is gone is left out


def test_few_rooms_links_and_odd_attributes_are_not_indexed(
    folder: Path, opened: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    SceneSet.open([folder / "0.h5", folder / "1.h5"], lazy=True)
    SceneSet.open(folder, lazy=False)
    assert not (folder / INDEX).exists()
    (folder.parent / "links").mkdir()
    for file in folder.glob("*.h5"):
        (folder.parent / "links" / file.name).symlink_to(file)
    assert SceneSet.open(folder.parent / "links", lazy=True).names == ("room 0", "room 1", "room 2")
    assert not (folder.parent / "links" / INDEX).exists()
    scenes = {"0.h5": Scene.load(folder / "0.h5", lazy=True), "1.h5": Scene.load(folder / "1.h5", lazy=True)}
    scenes["0.h5"].attributes["odd"] = 1j
    index_module.write_index(folder, scenes)
    assert list(read_index(folder) or {}) == ["1.h5"]
    monkeypatch.setattr(limits, "MAX_INDEX_TEXT_BYTES", 10)
    (folder / INDEX).unlink()
    index_module.write_index(folder, scenes)
    assert not (folder / INDEX).exists()
    # a file that has become a link leads elsewhere
    monkeypatch.undo()
    monkeypatch.setattr(limits, "LAZY_SCENES", 3)
    SceneSet.open(folder, lazy=True)
    os.rename(folder / "2.h5", folder.parent / "2.h5")
    (folder / "2.h5").symlink_to(folder.parent / "2.h5")
    assert SceneSet.open(folder, lazy=True).scenes[2].path == folder.parent / "2.h5"


def test_a_folder_that_may_not_be_written_has_no_index(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise ResultError("read-only file system")

    monkeypatch.setattr(index_module, "write_npz", refuse)
    assert SceneSet.open(folder, lazy=True).num_scenes == 3
    assert not (folder / INDEX).exists()


def test_faults_are_those_of_files(folder: Path) -> None:
    SceneSet.open(folder, lazy=True)
    (folder / "1.h5").write_bytes(b"no HDF5")
    with pytest.raises(SceneError, match=r"1\.h5: cannot be read as HDF5"):
        SceneSet.open(folder, lazy=True)
    with pytest.warns(UserWarning, match=r"1 scenes cannot be opened"):
        assert SceneSet.open(folder, skip_broken=True, lazy=True).names == ("room 0", "room 2")
    with pytest.raises(SceneError, match=r"1\.h5: cannot be read as HDF5"):
        SceneSet.open(folder, lazy=True)
    (folder / "1.h5").unlink()
    os.mkfifo(folder / "1.h5")
    with pytest.raises(SceneError, match=r"1\.h5: is no regular file"):
        SceneSet.open(folder, lazy=True)


def test_what_was_read_before_a_fault_is_kept(folder: Path, opened: list[str]) -> None:
    sound = (folder / "2.h5").read_bytes()
    (folder / "2.h5").write_bytes(b"no HDF5")
    with pytest.raises(SceneError):
        SceneSet.open(folder, lazy=True)
    (folder / "2.h5").write_bytes(sound)
    taken(opened)
    SceneSet.open(folder, lazy=True)
    assert taken(opened) == ["2.h5"]


def _text(arrays: dict[str, Any], change: Callable[[list[Any]], Any]) -> np.ndarray:
    facts = json.loads(arrays["text"].tobytes())
    changed = change(facts)
    return np.frombuffer(json.dumps(facts if changed is None else changed).encode(), np.uint8)


def _set(name: str, place: Any, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(arrays: dict[str, Any]) -> None:
        arrays[name] = arrays[name].copy()
        arrays[name][place] = value

    return change


def _replace(name: str, make: Callable[[dict[str, Any]], Any]) -> Callable[[dict[str, Any]], None]:
    def change(arrays: dict[str, Any]) -> None:
        made = make(arrays)
        if made is None:
            del arrays[name]
        else:
            arrays[name] = made

    return change


def _facts(room: int, field: int, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(facts: list[Any]) -> None:
        facts[room][field] = value

    return _replace("text", lambda arrays: _text(arrays, change))


FAULTS = {
    "a successor of another room": _set("graph", 3, 16),
    "a successor below -1": _set("graph", 3, -2),
    "a place that is not finite": _set("location", (5, 1), np.nan),
    "a heading that is not finite": _set("rotation", 5, np.inf),
    "a size of none": _set("size", (0, 0), 0),
    "sizes that do not add up": _set("size", (0, 0), 17),
    "sizes beyond 64 bits": _set("size", (0, slice(None)), 1 << 62),
    "a size of features beyond all": _set("size", (0, 3), 1 << 62),
    "pictures of no width": _set("picture", (1, 1), 0),
    "pictures of four channels": _set("picture", (1, 2), 4),
    "pictures too large": _set("picture", (1, 0), 1 << 20),
    "an array missing": _replace("rotation", lambda arrays: None),
    "no sizes": _replace("size", lambda arrays: None),
    "other numbers": _replace("graph", lambda arrays: arrays["graph"].astype(np.float64)),
    "another shape": _replace("stamp", lambda arrays: arrays["stamp"][:, :3]),
    "fewer rooms": _replace("picture", lambda arrays: arrays["picture"][:2]),
    "no rooms": _replace("size", lambda arrays: arrays["size"][:0]),
    "numbers in place of an array": _replace("size", lambda arrays: np.int64(3)),
    "text that is none": _replace("text", lambda arrays: np.full(9, 255, np.uint8)),
    "text of nothing": _replace("text", lambda arrays: np.zeros(0, np.uint8)),
    "text too deep": _replace("text", lambda arrays: np.frombuffer(b"[" * 200_000, np.uint8)),
    "an object": _replace("text", lambda arrays: _text(arrays, lambda facts: {"rooms": facts})),
    "one room too few": _replace("text", lambda arrays: _text(arrays, lambda facts: facts[:2])),
    "a room that is none": _replace("text", lambda arrays: _text(arrays, lambda facts: [1, 2, 3])),
    "a room of three": _replace("text", lambda arrays: _text(arrays, lambda facts: [f[:3] for f in facts])),
    "a file elsewhere": _facts(0, 0, "../0.h5"),
    "the same file twice": _facts(0, 0, "1.h5"),
    "a file of no name": _facts(0, 0, None),
    "a scene of no name": _facts(0, 1, ""),
    "a name of two lines": _facts(0, 1, "a\nb"),
    "one action too few": _facts(0, 2, ["ahead"]),
    "actions of no name": _facts(0, 2, [1, 2, 3, 4]),
    "attributes of no name": _facts(0, 3, ["seed"]),
    "attributes in attributes": _facts(0, 3, {"seed": {"seed": 1}}),
    "attributes of nothing": _facts(0, 3, {"seed": [None]}),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_an_index_with_a_fault_is_made_anew(folder: Path, opened: list[str], fault: str) -> None:
    first = SceneSet.open(folder, lazy=True)
    with np.load(folder / INDEX) as held:
        arrays = {name: held[name] for name in held.files}
    FAULTS[fault](arrays)
    np.savez(folder / INDEX, **arrays)
    taken(opened)
    assert read_index(folder) is None
    assert_same(SceneSet.open(folder, lazy=True), first)
    assert taken(opened) == ["0.h5", "1.h5", "2.h5"]
    assert read_index(folder) is not None


@pytest.mark.parametrize("content", [b"", b"PK", b"PK\x05\x06" + bytes(18)])
def test_an_index_that_is_none_is_made_anew(folder: Path, content: bytes) -> None:
    first = SceneSet.open(folder, lazy=True)
    (folder / INDEX).write_bytes(content)
    assert read_index(folder) is None
    assert_same(SceneSet.open(folder, lazy=True), first)
    assert read_index(folder) is not None


def test_an_index_larger_than_allowed_is_not_read(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    SceneSet.open(folder, lazy=True)
    monkeypatch.setattr(limits, "MAX_INDEX_TEXT_BYTES", 10)
    assert read_index(folder) is None
