"""Files: round trips, atomic writing, and one clear error for each way in which a file can be wrong."""

from __future__ import annotations

import fcntl
import io
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from vusfa.errors import SceneError
from vusfa.scenes import Scene, SceneSet, store, validate
from vusfa.sources.compact import compact


def content(path: Path) -> dict[str, Any]:
    """Everything in a file: bytes, dtypes and shapes of datasets, attributes."""
    found: dict[str, Any] = {}
    with h5py.File(path) as file:
        for key, dataset in file.items():
            values = dataset[()]
            raw = [item.tobytes() for item in values] if values.dtype == object else values.tobytes()
            found[key] = (str(dataset.dtype), dataset.shape, raw)
        for key, value in file.attrs.items():
            found["@" + key] = (type(value), np.asarray(value).tolist())
    return found


def jpeg(picture: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "JPEG")
    return buffer.getvalue()


def with_jpegs(path: Path, jpegs: list[bytes]) -> Path:
    with h5py.File(path, "a") as file:
        dataset = file.create_dataset("observation_jpeg", (len(jpegs),), dtype=h5py.vlen_dtype(np.uint8))
        for state, picture in enumerate(jpegs):
            dataset[state] = np.frombuffer(picture, np.uint8)
    return path


def the_fault(path: Path) -> str:
    """The one fault of a file; load and validate must agree on it."""
    faults = validate(path)
    assert len(faults) == 1, faults
    with pytest.raises(SceneError) as caught:
        Scene.load(path)
    assert str(caught.value) == faults[0]
    assert faults[0].startswith(f"{path}: ")
    return faults[0].removeprefix(f"{path}: ")


# ---- round trips


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_write_read_write_gives_the_same_bytes(tmp_path: Path, data: st.DataObject) -> None:
    sizes = st.integers(1, 6)
    n, a, c, f = (data.draw(sizes, name) for name in "NACF")
    rng = np.random.default_rng(data.draw(st.integers(0, 1000), "seed"))
    kind = data.draw(st.sampled_from(["none", "raw", "jpeg"]), "pictures")
    raw = rng.integers(0, 256, (n, 4, 5, 3), dtype=np.uint8)
    pictures = {"none": None, "raw": raw, "jpeg": [jpeg(picture) for picture in raw]}[kind]
    scale = data.draw(st.sampled_from([1.0, 1e-6, 1e6]), "scale")
    features = np.float32(scale) * rng.standard_normal((n, c, f), dtype=np.float32)
    if scale <= 1 and data.draw(st.booleans(), "half"):
        features = features.astype(np.float16)
    values = st.integers(-5, 5) | st.floats(allow_nan=False) | st.text("abc") | st.booleans()
    lists = st.lists(st.integers(-5, 5)) | st.lists(st.text("abc"), min_size=1)
    scene = Scene(
        data.draw(st.text("xyz", min_size=1), "name"),
        rng.integers(-1, n, (n, a)),
        features,
        location=rng.standard_normal((n, 2)),
        rotation=rng.uniform(0, 360, n),
        actions=tuple(f"move {index}" for index in range(a)),
        attributes=data.draw(st.dictionaries(st.sampled_from(["k", "l", "seed"]), values | lists)),
    )
    first, second = tmp_path / "first.h5", tmp_path / "second.h5"
    scene.save(first, pictures)
    again = Scene.load(first)
    for key in ("graph", "features", "location", "rotation", "distance"):
        assert torch.equal(getattr(again, key), getattr(scene, key)), key
    assert (again.name, again.actions) == (scene.name, scene.actions)
    assert again.attributes == scene.attributes
    assert again.has_pictures == (kind != "none")
    if kind == "raw":
        assert np.array_equal(again.pictures(range(n)).numpy(), raw)
    again.save(second)
    assert content(second) == content(first)
    assert second.read_bytes() == first.read_bytes()
    assert validate(first) == []


def test_a_bundled_room_round_trips(tmp_path: Path) -> None:
    room = Scene.bundled("bathroom")
    room.save(tmp_path / "copy.h5")
    assert (tmp_path / "copy.h5").read_bytes() == room.path.read_bytes()


def test_a_scene_can_be_saved_over_its_own_file(make_file: Callable[..., Path], pictures: np.ndarray) -> None:
    path = make_file(observation=pictures)
    scene = Scene.load(path)
    scene.save(path)
    assert np.array_equal(Scene.load(path).pictures(range(5)).numpy(), pictures)


def test_features_are_halved_only_where_that_is_exact(tmp_path: Path) -> None:
    graph = torch.tensor([[0]])
    for value, dtype in ((0.5, "float16"), (0.1, "float32"), (1e6, "float32"), (65504.0, "float16")):
        Scene("one", graph, torch.tensor([[[value]]])).save(tmp_path / "one.h5")
        with h5py.File(tmp_path / "one.h5") as file:
            assert file["resnet_feature"].dtype == dtype
            assert file["graph"].dtype == "int16"


# ---- atomic writing


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "room.h5"
    scene = Scene("one", torch.tensor([[0]]), torch.rand(1, 1, 2))
    scene.save(path)
    before = path.read_bytes()
    bad = Scene("one", torch.tensor([[0]]), torch.rand(1, 1, 2), attributes={"camera": {"eye": 1.4}})
    with pytest.raises(SceneError, match="attribute 'camera' of type dict cannot be written"):
        bad.save(path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["room.h5"]


def test_an_interrupted_write_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*args: Any) -> None:
        assert len(list(tmp_path.iterdir())) == 1  # the temporary file is here by now, in the same folder
        assert not (tmp_path / "room.h5").exists()
        raise KeyboardInterrupt

    monkeypatch.setattr(store.picture_files, "write_raw", interrupt)
    scene = Scene("one", torch.tensor([[0]]), torch.rand(1, 1, 2))
    with pytest.raises(KeyboardInterrupt):
        scene.save(tmp_path / "room.h5", np.zeros((1, 2, 2, 3), np.uint8))
    assert list(tmp_path.iterdir()) == []


def test_readers_see_whole_files_while_a_writer_is_at_work(tmp_path: Path) -> None:
    path = tmp_path / "room.h5"
    scene = Scene("ring", (torch.arange(90).unsqueeze(1) + 1) % 90, torch.rand(90, 2, 300))
    scene.save(path)
    writer = threading.Thread(target=lambda: [scene.save(path) for _ in range(10)])
    writer.start()
    reads = 0
    while writer.is_alive():
        assert Scene.load(path).num_states == 90
        reads += 1
    writer.join()
    assert reads > 3
    assert [p.name for p in tmp_path.iterdir()] == ["room.h5"]


@pytest.mark.parametrize(
    ("target", "words"),
    [("missing/room.h5", "cannot be written .*check folder"), ("folder", "folder: cannot be written")],
)
def test_places_that_cannot_be_written(tmp_path: Path, target: str, words: str) -> None:
    (tmp_path / "folder").mkdir()
    with pytest.raises(SceneError, match=words):
        Scene("one", torch.tensor([[0]]), torch.rand(1, 1, 2)).save(tmp_path / target)
    assert [p.name for p in tmp_path.iterdir()] == ["folder"]


@pytest.mark.parametrize(
    ("pictures", "words"),
    [
        (np.zeros((2, 4, 5, 3), np.uint8), "2 pictures for 1 states"),
        ([b"a", b"b"], "2 pictures for 1 states"),
        (np.zeros((1, 4, 5), np.uint8), r"pictures are uint8 of shape \(1, 4, 5\)"),
        (torch.zeros(1, 4, 5, 3), "pictures are float32"),
    ],
)
def test_pictures_that_do_not_fit(tmp_path: Path, pictures: Any, words: str) -> None:
    with pytest.raises(SceneError, match=words):
        Scene("one", torch.tensor([[0]]), torch.rand(1, 1, 2)).save(tmp_path / "room.h5", pictures)
    assert list(tmp_path.iterdir()) == []


# ---- faults


def test_a_sound_file_has_none(make_file: Callable[..., Path], pictures: np.ndarray) -> None:
    assert validate(make_file(observation=pictures)) == []
    assert validate(str(with_jpegs(make_file("jpeg.h5"), [jpeg(p) for p in pictures]))) == []


@pytest.mark.parametrize(
    "name", ["graph", "resnet_feature", "location", "rotation", "shortest_path_distance"]
)
def test_a_missing_dataset(make_file: Callable[..., Path], name: str) -> None:
    assert the_fault(make_file(**{name: None})).startswith(f"dataset '{name}' is missing; write it as ")


def test_no_file_and_no_hdf5_file(tmp_path: Path) -> None:
    path = tmp_path / "room.h5"
    assert the_fault(path) == "there is no such file; check the path"
    path.write_text("graph")
    assert the_fault(path).startswith("cannot be read as HDF5 (")
    assert validate(tmp_path) == [f"{tmp_path}: there is no such file; check the path"]


@pytest.mark.parametrize("kept", [0.0, 0.02, 0.5, 0.99])
def test_a_truncated_file(tmp_path: Path, kept: float) -> None:
    path = tmp_path / "room.h5"
    whole = store.bundled_path("bathroom").read_bytes()
    path.write_bytes(whole[: int(kept * len(whole))])
    assert "truncated, damaged or something else: copy it or make it again" in the_fault(path)


def test_damage_inside_a_dataset_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "room.h5"
    Scene("ten", torch.arange(10).unsqueeze(1), torch.rand(10, 2, 50)).save(path)
    with h5py.File(path) as file:
        start = file["resnet_feature"].id.get_chunk_info(0).byte_offset
    damaged = bytearray(path.read_bytes())
    damaged[start + 20] ^= 0xFF
    path.write_bytes(damaged)
    assert the_fault(path).startswith("dataset 'resnet_feature' cannot be read (")


def test_every_flipped_byte_is_an_error_or_harmless(tmp_path: Path) -> None:
    """No damage may come out as anything but a SceneError."""
    path = tmp_path / "room.h5"
    pictures = np.zeros((3, 4, 4, 3), np.uint8)
    scene = Scene("three", torch.tensor([[1], [2], [0]]), torch.rand(3, 1, 4), attributes={"seed": 1})
    scene.save(path, [jpeg(picture) for picture in pictures])
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    refused = 0
    for place in rng.choice(len(whole), 300, replace=False):
        damaged = bytearray(whole)
        damaged[place] ^= int(rng.integers(1, 256))
        path.write_bytes(damaged)
        try:
            Scene.load(path).pictures(range(3))
        except SceneError as error:
            assert str(path) in str(error)  # noqa: PT017
            assert validate(path)
            refused += 1
    assert refused > 20


def test_graph_indices_out_of_range(make_file: Callable[..., Path]) -> None:
    graph = np.array([[1, 0, -1], [2, 0, -1], [3, 1, -1], [4, 5, -1], [-2, 3, -1]])
    assert the_fault(make_file(graph=graph)) == (
        "dataset 'graph', state 3 (the first of 2): action 1 leads to 5, but states are 0..4"
        " (-1 is a blocked move); correct it"
    )


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e39])
@pytest.mark.filterwarnings("ignore:overflow")
def test_features_that_are_no_numbers(make_file: Callable[..., Path], value: float) -> None:
    features = np.ones((5, 2, 7))
    features[3, 1, 4] = features[4] = value
    assert the_fault(make_file(resnet_feature=features)) == (
        f"dataset 'resnet_feature', state 3 (the first of 2): crop 1, feature 4 is {np.float32(value)};"
        " compute the features of this state again"
    )


def test_distances_that_disagree_with_the_graph(make_file: Callable[..., Path]) -> None:
    path = make_file()
    with h5py.File(path, "a") as file:
        file["shortest_path_distance"][1, 3] = 7
        file["shortest_path_distance"][2, 0] = -1
        file["shortest_path_distance"][4, 4] = 1
    assert the_fault(path) == (
        "dataset 'shortest_path_distance', state 1 to state 3: 7, but by the graph it is 2;"
        " correct the graph, or replace the dataset by vusfa.scenes.graph.shortest_path_distances(graph)"
    )


def test_islands_are_no_fault_but_a_path_between_them_is(make_file: Callable[..., Path]) -> None:
    graph = np.array([[1], [0], [3], [2], [4]])
    distance = np.full((5, 5), -1)
    for pair in ((0, 1), (2, 3)):
        distance[np.ix_(pair, pair)] = [[0, 1], [1, 0]]
    distance[4, 4] = 0
    path = make_file(graph=graph, shortest_path_distance=distance)
    assert validate(path) == []
    assert Scene.load(path).islands == ((2, 3), (4,))
    distance[0, 2] = 3
    assert "state 0 to state 2: 3, but by the graph it is -1" in the_fault(
        make_file("wrong.h5", graph=graph, shortest_path_distance=distance)
    )


@pytest.mark.parametrize(
    ("name", "values", "words"),
    [
        ("graph", np.zeros((5, 3), np.float32), "holds float32 of shape (5, 3); write it as integers (N, A)"),
        ("graph", np.zeros(5, np.int64), "holds int64 of shape (5,); write it as integers (N, A)"),
        ("graph", np.zeros((5, 3), bool), "holds bool of shape (5, 3); write it as integers (N, A)"),
        ("graph", 7, "holds int64 of shape (); write it as integers (N, A)"),
        ("resnet_feature", np.zeros((5, 7)), "holds float64 of shape (5, 7); write it as floats (N, C, F)"),
        ("resnet_feature", np.zeros((5, 2, 7), int), "holds int64 of shape (5, 2, 7); write it as floats"),
        ("resnet_feature", np.zeros((5, 0, 7)), "is empty, (5, 0, 7); write it as floats (N, C, F)"),
        (
            "resnet_feature",
            np.zeros((4, 2, 7)),
            "has 4 states, but the graph has 5; write one entry per state",
        ),
        ("location", np.zeros((5, 3)), "holds float64 of shape (5, 3); write it as numbers (N, 2)"),
        ("location", np.zeros((6, 2)), "has 6 states, but the graph has 5"),
        ("location", np.array([b"x"] * 5), "holds |S1 of shape (5,); write it as numbers (N, 2)"),
        ("location", b"nowhere", "holds |S7 of shape (); write it as numbers (N, 2)"),
        ("location", np.full((5, 2), np.nan), ", state 0 (the first of 5): [nan, nan] is not finite"),
        ("rotation", np.zeros((5, 1)), "holds float64 of shape (5, 1); write it as numbers (N,)"),
        ("rotation", np.array([0, np.inf, 0, 0, 0]), ", state 1: inf is not finite; give every state a pose"),
        ("rotation", h5py.Empty("f"), "holds object of shape (); write it as numbers (N,)"),
        (
            "shortest_path_distance",
            np.zeros((5, 4), int),
            "holds int64 of shape (5, 4); write it as integers",
        ),
        ("shortest_path_distance", np.zeros((5, 5)), "holds float64 of shape (5, 5); write it as integers"),
        ("shortest_path_distance", np.zeros((4, 4), int), "has 4 states, but the graph has 5"),
        ("observation", np.zeros((5, 4, 4), np.uint8), "holds uint8 of shape (5, 4, 4); write it as uint8"),
        ("observation", np.zeros((5, 4, 4, 4), np.uint8), "holds uint8 of shape (5, 4, 4, 4); write it as"),
        ("observation", np.zeros((5, 4, 4, 3)), "holds float64 of shape (5, 4, 4, 3); write it as uint8"),
        ("observation", np.zeros((4, 4, 4, 3), np.uint8), "has 4 pictures, but the graph has 5 states"),
        (
            "observation_jpeg",
            np.zeros(5, np.uint8),
            "holds uint8 of shape (5,); write it as (N,) of variable",
        ),
    ],
)
def test_shapes_and_dtypes(make_file: Callable[..., Path], name: str, values: Any, words: str) -> None:
    fault = the_fault(make_file(**{name: values}))
    assert fault.startswith(f"dataset '{name}'")
    assert words in fault


def test_names_of_actions_that_do_not_fit(make_file: Callable[..., Path]) -> None:
    fault = the_fault(make_file(attributes={"actions": ["on", "back"]}))
    assert fault.startswith("attribute 'actions' names 2 actions, but dataset 'graph' has 3 columns")


def test_all_faults_at_once(make_file: Callable[..., Path], pictures: np.ndarray) -> None:
    features = np.ones((5, 2, 7), np.float32)
    features[0] = np.nan
    path = make_file(
        graph=np.full((5, 3), 9),
        resnet_feature=features,
        location=np.zeros(3),
        rotation=None,
        observation=pictures[:3],
    )
    faults = validate(path)
    named = [fault.removeprefix(f"{path}: ").split("'")[1] for fault in faults]
    assert sorted(named) == ["graph", "location", "observation", "resnet_feature", "rotation"]
    with pytest.raises(SceneError) as caught:
        Scene.load(path)
    assert str(caught.value).splitlines() == [
        f"{path}: 5 faults",
        *(f"  - {fault.removeprefix(f'{path}: ')}" for fault in faults),
    ]


def test_what_else_a_file_holds_is_kept(make_file: Callable[..., Path], tmp_path: Path) -> None:
    path = make_file(observation_jpeg=None, attributes={"seed": 3})
    with h5py.File(path, "a") as file:
        file["depth"] = np.arange(15, dtype=np.float16).reshape(5, 3)
        file["depth"].attrs["unit"] = "m"
        file.create_group("objects")["names"] = np.array([b"bed", b"lamp"])
        file["location"].attrs["unit"] = "m"
        file["resnet_feature"].attrs["layer"] = "pool5"
        file["elsewhere"] = h5py.ExternalLink("/etc/passwd", "/")
        file.create_dataset("outside", (4,), "u1", external=[("/etc/passwd", 0, 4)])
    Scene.load(path).save(tmp_path / "saved.h5")
    compact(path, tmp_path / "small.h5")
    Scene.load(path).save(path)  # in its own place
    for copy in (tmp_path / "saved.h5", tmp_path / "small.h5", path):
        assert validate(copy) == []
        with h5py.File(copy) as file:
            assert file["depth"][()].tolist() == np.arange(15).reshape(5, 3).tolist()
            assert file["objects/names"][()].tolist() == [b"bed", b"lamp"]
            units = [file["depth"].attrs["unit"], file["location"].attrs["unit"]]
            assert units == ["m", "m"]
            assert file["resnet_feature"].attrs["layer"] == "pool5"
            assert file.get("elsewhere", getlink=True).filename == "/etc/passwd"
            assert "outside" not in file


def test_a_locked_file_is_called_locked(
    make_file: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = make_file()
    monkeypatch.delenv("HDF5_USE_FILE_LOCKING", raising=False)
    with open(path) as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        (fault,) = validate(path)
    assert fault.startswith(f"{path}: is locked")
    assert "HDF5_USE_FILE_LOCKING=FALSE" in fault
    assert validate(path) == []


def test_a_file_that_may_not_be_read(make_file: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: object) -> None:
        raise PermissionError(13, "Permission denied")

    path = make_file()
    monkeypatch.setattr("vusfa.scenes.hdf5.h5py.File", refuse)  # nothing is unreadable to root
    assert validate(path) == [f"{path}: may not be read (Permission denied); change its permissions"]


@pytest.mark.parametrize("kind", ["i8", "i4", "i2", "u1"])
def test_distances_of_any_integers_are_held_in_two_bytes(make_file: Callable[..., Path], kind: str) -> None:
    path = make_file(shortest_path_distance=None)
    ring = np.abs(np.arange(5)[:, None] - np.arange(5))
    ring = np.minimum(ring, 5 - ring)
    with h5py.File(path, "a") as file:
        file.create_dataset("shortest_path_distance", data=ring.astype(kind), chunks=(2, 3))
    scene = Scene.load(path)
    assert scene.distance.dtype == torch.int16
    assert scene.distance.tolist() == ring.tolist()
    assert SceneSet([scene]).distance_tables[0].data_ptr() == scene.distance.data_ptr()


def test_a_group_in_a_datasets_place(make_file: Callable[..., Path]) -> None:
    path = make_file(graph=None)
    with h5py.File(path, "a") as file:
        file.create_group("graph")
    assert the_fault(path).startswith("dataset 'graph' is missing")


def test_pictures_that_are_none(make_file: Callable[..., Path], pictures: np.ndarray) -> None:
    good = [jpeg(picture) for picture in pictures]
    first = with_jpegs(make_file("first.h5"), [b"none", *good[1:]])
    assert the_fault(first).startswith("dataset 'observation_jpeg', state 0: is unusable (unknown format)")
    few = with_jpegs(make_file("few.h5"), good[:3])
    assert the_fault(few).startswith("dataset 'observation_jpeg' has 3 pictures, but the graph has 5 states")
    # Loading looks at the first picture alone; validation at every one, and so does whoever asks for it.
    for name, bad, words in (
        ("cut.h5", good[3][:-30], "state 3: is unusable (image file is truncated"),
        ("small.h5", jpeg(pictures[3][:2]), "state 3: is unusable ((2, 8) in size, and state 0 is (6, 8)"),
    ):
        path = with_jpegs(make_file(name), [*good[:3], bad, good[4]])
        assert len(validate(path)) == 1
        assert validate(path)[0].startswith(f"{path}: dataset 'observation_jpeg', {words}")
        scene = Scene.load(path)
        assert scene.pictures([0, 4]).shape == (2, 6, 8, 3)
        with pytest.raises(SceneError, match="state 3"):
            scene.pictures([0, 3])


def test_pictures_of_other_sizes_in_later_blocks(
    make_file: Callable[..., Path], pictures: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(store.picture_files, "_AT_ONCE", 2)
    path = with_jpegs(make_file(), [jpeg(p) for p in pictures[:2]] + [jpeg(p[:3]) for p in pictures[2:]])
    assert validate(path) == [
        f"{path}: dataset 'observation_jpeg', state 2: is unusable ((3, 8) in size, and state 0 is (6, 8));"
        " write it again"
    ]


def test_raw_pictures_count_where_there_are_both(
    make_file: Callable[..., Path], pictures: np.ndarray
) -> None:
    path = with_jpegs(make_file(observation=pictures), [jpeg(picture) for picture in pictures])
    assert np.array_equal(Scene.load(path).pictures(range(5)).numpy(), pictures)
