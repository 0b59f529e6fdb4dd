"""Scenes whose features stay on the disk."""

from __future__ import annotations

import copy
import os
import pickle
import threading
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from vusfa.errors import SceneError
from vusfa.modules.frames import FeatureFrames
from vusfa.scenes import Scene, SceneSet
from vusfa.scenes import statistics as summary_module
from vusfa.scenes.features import LazyFeatures, SceneRows


@pytest.fixture
def folder(tmp_path: Path, make_scene: Callable[..., Scene]) -> Path:
    """Three rooms of 16, 24 and 16 states."""
    for index, width in enumerate((2, 3, 2)):
        make_scene(f"room {index}", width=width).save(tmp_path / f"{index}.h5")
    return tmp_path


@pytest.fixture
def both(folder: Path) -> tuple[SceneSet, SceneSet]:
    """The same rooms in memory and in files."""
    return SceneSet.open(folder), SceneSet.open(folder, lazy=True)


def change(path: Path, **datasets: np.ndarray) -> None:
    with h5py.File(path, "a") as file:
        for name, values in datasets.items():
            del file[name]
            file[name] = values


def test_what_is_read_is_what_is_there(both: tuple[SceneSet, SceneSet]) -> None:
    eager, lazy = both
    assert lazy.is_lazy
    assert not eager.is_lazy
    for name in ("successor", "blocked", "scene_id", "location", "rotation", "offsets"):
        assert torch.equal(getattr(lazy, name), getattr(eager, name))
    facts = ("names", "num_crops", "feature_size", "fingerprint", "actions")
    assert [getattr(lazy, fact) for fact in facts] == [getattr(eager, fact) for fact in facts]
    ids = torch.tensor([[50, 3], [17, 50]])
    assert torch.equal(lazy.features[ids], eager.features[ids])
    assert torch.equal(lazy.features[ids, 0], eager.features[ids, 0])
    assert torch.equal(lazy.features[:], eager.features)
    for index in (-1, 55, slice(3, 40, 7), [2, 50], torch.tensor(4), eager.scene_id == 1):
        assert torch.equal(lazy.features[index], eager.features[index])
    assert torch.equal(lazy.features[-3:, 0, 2:4], eager.features[-3:, 0, 2:4])
    with pytest.raises(IndexError):
        lazy.features[56]
    assert torch.equal(lazy.scenes[1].features, eager.scenes[1].features)
    assert torch.equal(lazy.distance(0, [5, 9]), eager.distance(0, [5, 9]))
    for other in (pickle.loads(pickle.dumps(lazy)), copy.deepcopy(lazy), lazy.to("cpu")):
        assert other.is_lazy
        assert torch.equal(other.features[ids], eager.features[ids])
    assert len(pickle.dumps(lazy.scenes)) < len(pickle.dumps(eager.scenes))


def test_many_files_are_opened_lazily(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vusfa.scenes.places.LAZY_SCENES", 3)
    assert SceneSet.open(folder).is_lazy
    assert not SceneSet.open(folder, lazy=False).is_lazy
    assert not SceneSet.open([folder / "0.h5", folder / "1.h5"]).is_lazy


def test_a_scene_in_memory_may_stand_beside_scenes_in_files(
    folder: Path, make_scene: Callable[..., Scene]
) -> None:
    rooms = SceneSet([Scene.load(folder / "0.h5", lazy=True), make_scene("mine")])
    alike = SceneSet([Scene.load(folder / "0.h5"), make_scene("mine")])
    assert torch.equal(rooms.features[:], alike.features)
    assert rooms.fingerprint == alike.fingerprint
    assert not list(folder.glob(".vusfa*"))


def test_statistics_are_those_of_all_states(both: tuple[SceneSet, SceneSet]) -> None:
    eager, lazy = both
    table, found = eager.features[:, 0].double(), lazy.features.summary
    assert torch.allclose(found.mean, table.mean(0))
    assert torch.allclose(found.deviation, table.std(0, correction=0))
    assert torch.equal(found.largest, table.abs().amax(0))
    ids = torch.tensor([3, 55, 20])
    frames = [FeatureFrames(rooms.features, normalize=True) for rooms in both]
    assert torch.allclose(frames[1].lookup(ids), frames[0].lookup(ids), atol=1e-5)
    assert torch.allclose(frames[1].lookup(None), frames[0].lookup(None), atol=1e-5)
    frames[1].load_state_dict(frames[0].state_dict())  # normalized anew
    frames[1].lookup(ids)
    moved = {"mean": torch.ones(8), "deviation": torch.full((8,), 2.0)}
    frames[1].load_state_dict(moved)
    assert torch.equal(frames[1].lookup(ids), (eager.features[ids, 0] - 1) / 2)
    assert torch.equal(copy.deepcopy(frames[1]).lookup(ids), frames[1].lookup(ids))


def test_the_cache_is_believed_only_of_the_same_files(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    computed: list[int] = []
    compute = summary_module._computed
    monkeypatch.setattr(summary_module, "_computed", lambda scenes: computed.append(1) or compute(scenes))

    def fingerprint() -> str:
        found = SceneSet.open(folder, lazy=True).fingerprint
        assert found == SceneSet.open(folder, lazy=False).fingerprint
        return found

    first = fingerprint()
    assert fingerprint() == first
    assert len(computed) == 1
    os.utime(folder / "1.h5")  # touched, or copied: the content is compared
    assert fingerprint() == first
    assert len(computed) == 1
    before = os.stat(folder / "1.h5")
    features = SceneSet.open(folder / "1.h5").features.numpy()
    change(folder / "1.h5", resnet_feature=features + np.float32(1))
    os.utime(folder / "1.h5", ns=(before.st_atime_ns, before.st_mtime_ns))
    assert fingerprint() != first
    assert len(computed) == 2
    (cache,) = folder.glob(".vusfa-*.npz")
    for content in (b"", b"PK", cache.read_bytes()[:-40]):
        cache.write_bytes(content)
        fingerprint()
    for name, wrong in (
        ("mean", np.full(8, np.nan)),
        ("mean", np.zeros(9)),
        ("deviation", -np.ones(8)),
        ("stamp", np.zeros((3, 4))),
        ("fingerprint", np.array("../../etc/passwd")),
        ("fingerprint", None),
    ):
        with np.load(cache) as held:
            content = {key: held[key] for key in held.files} | {name: wrong}
        np.savez(cache, **{key: value for key, value in content.items() if value is not None})
        fingerprint()
    assert len(computed) == 2 + 3 + 6


def test_a_folder_that_may_not_be_written_is_fine(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        from vusfa.errors import ResultError

        raise ResultError("read-only file system")

    monkeypatch.setattr(summary_module, "write_npz", refuse)
    assert SceneSet.open(folder, lazy=True).fingerprint == SceneSet.open(folder).fingerprint


def test_rows_are_read_once_and_make_room() -> None:
    offsets, read = torch.tensor([0, 2, 5, 6, 10]), []

    def rows_of(scene: int) -> torch.Tensor:
        read.append(scene)
        first, end = offsets[scene : scene + 2].tolist()
        return torch.arange(first, end).float().unsqueeze(1).expand(-1, 3)

    rows = SceneRows(offsets, limit=6 * 12)

    def ask(*ids: int) -> list[int]:
        before = len(read)
        found = rows(torch.tensor(ids), rows_of)
        assert found.tolist() == [[float(i)] * 3 for i in ids]
        return read[before:]

    assert ask(1, 3, 0) == [0, 1]
    assert ask(4, 1) == []
    assert ask(5) == [2]
    assert ask(0, 2, 5) == []
    assert ask(6, 0) == [3, 0]  # no room for four more: all else is forgotten
    assert sorted(set(ask(9, 1, 4, 5))) == [0, 1, 2, 3]  # more than the limit: all that is asked for
    assert ask(9, 1, 4, 5) == []
    assert rows(None, rows_of)[:, 0].tolist() == list(range(10))
    assert rows(torch.zeros(0, 4, dtype=torch.int64), rows_of).shape == (0, 4, 3)
    empty = SceneRows(offsets)
    assert empty(torch.zeros(0, dtype=torch.int64), rows_of).shape == (0, 3)


def test_prefetched_scenes_are_read_in_the_background(folder: Path) -> None:
    rooms = SceneSet.open(folder, lazy=True)
    features = rooms.features
    assert isinstance(features, LazyFeatures)
    features.prefetch([1])
    assert not features._coming  # nobody has asked for features yet
    whole = rooms.features[:]
    features.of_scene(0)
    names = []
    read = type(rooms.scenes[1].stored).read
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "vusfa.scenes.features.StoredFeatures.read",
            lambda stored: names.append(threading.current_thread().name) or read(stored),
        )
        features.prefetch([1, 2])
        features.prefetch([2])
        assert torch.equal(features.of_scene(2), whole[40:])
        assert torch.equal(features.of_scene(1), whole[16:40])
    assert any(name.startswith("scenes") for name in names)
    (folder / "1.h5").unlink()
    features.prefetch([1])
    with pytest.raises(SceneError, match=r"1\.h5: has gone since it was opened"):
        features.of_scene(1)


def test_a_file_that_vanishes_or_changes_is_named(folder: Path) -> None:
    rooms = SceneSet.open(folder, lazy=True)
    (folder / "2.h5").rename(folder / "elsewhere")
    with pytest.raises(SceneError, match=r"2\.h5: has gone since it was opened; .* put it back, and resume"):
        rooms.features[[50]]
    (folder / "elsewhere").rename(folder / "2.h5")
    os.utime(folder / "2.h5", ns=(1, 1))
    with pytest.raises(SceneError, match=r"2\.h5: has changed since it was opened"):
        _ = rooms.scenes[2].features
    (folder / "1.h5").write_bytes(b"")
    with pytest.raises(SceneError, match=r"1\.h5: "):
        _ = rooms.fingerprint


def test_faults_of_features_are_found_when_they_are_read(folder: Path) -> None:
    features = SceneSet.open(folder / "1.h5").features.numpy().copy()
    features[5, 0, 3] = np.nan
    change(folder / "1.h5", resnet_feature=features)
    rooms = SceneSet.open(folder, lazy=True)
    assert rooms.features[[3]].isfinite().all()
    for read in (lambda: rooms.features[[20]], lambda: rooms.fingerprint):
        with pytest.raises(SceneError, match=r"1\.h5: dataset 'resnet_feature', state 5: crop 0, feature 3"):
            read()
    with pytest.warns(UserWarning, match=r"1 scenes cannot be opened and are left out:\n  - .*1\.h5"):
        left = SceneSet.open(folder, skip_broken=True, lazy=True)
    assert left.names == ("room 0", "room 2")


@pytest.mark.parametrize(
    ("datasets", "words"),
    [
        ({"resnet_feature": np.zeros((24, 8), np.float32)}, r"holds float32 of shape \(24, 8\)"),
        ({"resnet_feature": np.zeros((23, 1, 8), np.float32)}, "has 23 states, but the graph has 24"),
        ({"resnet_feature": np.zeros((24, 1, 8), np.int32)}, "holds int32"),
        ({"graph": np.full((24, 4), 99)}, "leads to 99"),
        ({"graph": np.zeros((0, 4), int)}, "'graph' is empty"),
        ({"location": np.full((24, 2), np.inf)}, "'location', state 0"),
        ({"shortest_path_distance": np.zeros((23, 23), int)}, "has 23 states, but the graph has 24"),
    ],
)
def test_other_faults_are_found_when_it_is_opened(folder: Path, datasets: dict, words: str) -> None:
    change(folder / "1.h5", **datasets)
    with pytest.raises(SceneError, match=rf"1\.h5: (?:.|\n)*{words}"):
        SceneSet.open(folder, lazy=True)


def test_missing_features_and_scenes_that_differ(folder: Path, make_scene: Callable[..., Scene]) -> None:
    make_scene("narrow", features=5).save(folder / "3.h5")
    with pytest.raises(SceneError, match=r"'room 0' \(.*0\.h5\) and 'narrow' \(.*3\.h5\) differ in feature"):
        SceneSet.open(folder, lazy=True)
    graph = np.tile(np.arange(16)[:, None], (1, 3))
    with h5py.File(folder / "3.h5", "w") as file:
        file["graph"], file["resnet_feature"] = graph, np.zeros((16, 1, 8), np.float32)
        file["location"], file["rotation"] = np.zeros((16, 2)), np.zeros(16)
        file["shortest_path_distance"] = np.where(np.eye(16), 0, -1)
    with pytest.raises(SceneError, match=r"'room 0' \(.*0\.h5\) and '3' \(.*3\.h5\) differ in actions"):
        SceneSet.open(folder, lazy=True)
    with h5py.File(folder / "3.h5", "a") as file:
        del file["resnet_feature"]
    with pytest.raises(SceneError, match=r"3\.h5: dataset 'resnet_feature' is missing"):
        SceneSet.open(folder, lazy=True)
