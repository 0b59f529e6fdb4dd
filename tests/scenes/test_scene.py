from __future__ import annotations

import copy
import dataclasses
import io
import multiprocessing
import os
import pickle
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
from PIL import Image

from vusfa.errors import SceneError
from vusfa.scenes import Scene
from vusfa.scenes.graph import shortest_path_distances
from vusfa.scenes.store import bundled_path

RING = torch.tensor([[1, -1], [2, 0], [0, 1]])


def open_files() -> set[str]:
    """What this process holds open, by name."""
    links = (f"/proc/self/fd/{fd}" for fd in os.listdir("/proc/self/fd"))
    return {os.readlink(link) for link in links if os.path.islink(link)}


def test_reads_a_file_of_any_actions_crops_and_features(make_file: Callable[..., Path]) -> None:
    path = make_file()
    scene = Scene.load(path)
    assert (scene.num_states, scene.num_actions, scene.num_crops, scene.feature_size) == (5, 3, 2, 7)
    assert scene.name == "room"
    assert scene.actions == ("action_0", "action_1", "action_2")
    assert scene.path == path
    assert not scene.has_pictures
    with h5py.File(path) as file:
        assert scene.graph.tolist() == file["graph"][()].tolist()
        assert scene.distance.tolist() == file["shortest_path_distance"][()].tolist()
        assert np.array_equal(scene.features.numpy(), file["resnet_feature"][()])
        assert scene.location.tolist() == file["location"][()].tolist()
        assert scene.rotation.tolist() == file["rotation"][()].tolist()
    dtypes = [getattr(scene, key).dtype for key in ("graph", "features", "location", "rotation", "distance")]
    assert dtypes == [torch.int64, torch.float32, torch.float32, torch.float32, torch.int16]


def test_reads_a_dump_as_the_paper_has_it(make_file: Callable[..., Path]) -> None:
    """Ten crops of 2048 features, four actions, raw pictures, an island; no attributes."""
    graph = np.array([[1, 0, 0, -1], [0, 1, 1, -1], [-1, 2, 2, -1], [-1, 4, -1, -1], [-1, -1, 3, -1]])
    distance = np.array(
        [[0, 1, -1, -1, -1], [1, 0, -1, -1, -1], [-1, -1, 0, -1, -1], [-1, -1, -1, 0, 1], [-1, -1, -1, 1, 0]]
    )
    picture = np.arange(5 * 300 * 400 * 3, dtype=np.uint32).astype(np.uint8).reshape(5, 300, 400, 3)
    path = make_file(
        "bedroom_04.h5",
        graph=graph,
        shortest_path_distance=distance,
        resnet_feature=np.zeros((5, 10, 2048), np.float32),
        rotation=np.array([0, 90, 180, 270, 0]),
        observation=picture,
    )
    scene = Scene.load(path)
    assert scene.name == "bedroom_04"
    assert scene.actions == ("MoveForward", "RotateRight", "RotateLeft", "MoveBackward")
    assert scene.islands == ((3, 4), (2,))
    assert scene.distance.tolist() == distance.tolist()
    assert (scene.num_crops, scene.feature_size) == (10, 2048)
    assert scene.picture_shape == (300, 400, 3)
    assert np.array_equal(scene.pictures([4, 1]).numpy(), picture[[4, 1]])


@pytest.mark.parametrize("dtype", ["<f2", "<f4", "<f8", ">f4"])
@pytest.mark.parametrize("integers", ["<i2", ">i4", "<i8"])
def test_any_floats_and_integers_in_either_byte_order(
    make_file: Callable[..., Path], dtype: str, integers: str
) -> None:
    plain = Scene.load(make_file())
    with h5py.File(plain.path) as file:
        values = {key: file[key][()] for key in file}
    values["resnet_feature"] = values["resnet_feature"].astype(dtype)
    for key in ("graph", "shortest_path_distance"):
        values[key] = values[key].astype(integers)
    other = Scene.load(make_file("other.h5", **values))
    assert torch.equal(other.graph, plain.graph)
    assert torch.equal(other.distance, plain.distance)
    torch.testing.assert_close(other.features, plain.features, rtol=0, atol=0 if dtype != "<f2" else 2e-3)


def test_unsigned_distances_of_a_connected_graph(make_file: Callable[..., Path]) -> None:
    path = make_file()
    with h5py.File(path) as file:
        distance = file["shortest_path_distance"][()].astype(np.uint64)
    assert torch.equal(
        Scene.load(make_file("unsigned.h5", shortest_path_distance=distance)).distance,
        Scene.load(path).distance,
    )


def test_attributes_name_scene_and_actions_and_the_rest_is_provenance(make_file: Callable[..., Path]) -> None:
    attributes = {
        "scene": "study",
        "actions": ["on", "back", "wait"],
        "seed": 3,
        "exposure": 0.5,
        "models": np.array([b"a", b"b"]),
        "camera": [1, 2],
    }
    scene = Scene.load(make_file(attributes=attributes))
    assert (scene.name, scene.actions) == ("study", ("on", "back", "wait"))
    assert scene.attributes == {"seed": 3, "exposure": 0.5, "models": ["a", "b"], "camera": [1, 2]}
    assert [type(scene.attributes[key]) for key in ("seed", "exposure")] == [int, float]


def test_built_from_tensors_fills_in_what_is_not_given() -> None:
    features = torch.rand(3, 1, 4, dtype=torch.float64, requires_grad=True)
    scene = Scene("ring", RING, features)
    assert torch.equal(scene.distance, shortest_path_distances(RING))
    assert scene.location.shape == (3, 2)
    assert scene.rotation.tolist() == [0, 0, 0]
    assert scene.features.dtype == torch.float32
    assert not scene.features.requires_grad
    assert scene.islands == ()
    with torch.no_grad():
        features.zero_()
    assert scene.features.abs().sum() > 0  # a copy
    renamed = dataclasses.replace(scene, name="other")
    assert (renamed.name, renamed.num_states) == ("other", 3)


def test_cannot_be_changed() -> None:
    scene = Scene("ring", RING, torch.rand(3, 1, 4))
    with pytest.raises(dataclasses.FrozenInstanceError):
        scene.name = "other"  # type: ignore[misc]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"graph": torch.tensor([[1], [2]])}, "'graph', state 1: action 0 leads to 2, but states are 0..1"),
        ({"graph": RING.float()}, r"'graph' holds float32 of shape \(3, 2\); write it as integers \(N, A\)"),
        ({"features": torch.rand(3, 4)}, r"'resnet_feature' holds float32 of shape \(3, 4\)"),
        ({"features": torch.rand(4, 1, 4)}, "'resnet_feature' has 4 states, but the graph has 3"),
        ({"location": torch.rand(3, 3)}, r"'location' holds float32 of shape \(3, 3\)"),
        ({"rotation": [0.0, float("nan"), 0.0]}, "'rotation', state 1: nan is not finite"),
        (
            {"distance": torch.zeros(3, 3, dtype=torch.int64)},
            r"state 0 to state 1: 0, but",
        ),
        ({"actions": ["on"]}, "'actions' names 1 actions, but dataset 'graph' has 2 columns"),
        ({"graph": torch.zeros(0, 2, dtype=torch.int64)}, r"'graph' is empty, \(0, 2\)"),
        ({"graph": torch.tensor(3)}, r"'graph' holds int64 of shape \(\)"),
    ],
)
def test_faults_of_scenes_in_memory_name_the_scene(changes: dict, words: str) -> None:
    arguments = {"graph": RING, "features": torch.rand(3, 1, 4), **changes}
    with pytest.raises(SceneError, match=r"scene 'ring': (.|\n)*" + words):
        Scene("ring", **arguments)


@pytest.mark.parametrize("name", ["", 5, None, "a\x1b[2J", "x" * 201, "two\nlines"])
def test_names_that_a_file_could_not_have(name: Any) -> None:
    with pytest.raises(SceneError, match=r"attribute 'scene' is .*; give a name of 1 to 200") as error:
        Scene(name, RING, torch.rand(3, 1, 4))
    assert len(str(error.value)) < 600


def test_pictures_in_any_order_shape_and_number(make_file: Callable[..., Path], pictures: np.ndarray) -> None:
    scene = Scene.load(make_file(observation=pictures))
    assert scene.picture_shape == (6, 8, 3)
    for ids in ([3, 0, 3], torch.tensor([[4], [1]]), np.array(2), [], range(5)):
        found = scene.pictures(ids)
        assert found.dtype == torch.uint8
        assert np.array_equal(found.numpy(), pictures[np.asarray(ids, dtype=np.int64)])


def test_jpeg_pictures_are_those_that_pillow_decodes(tmp_path: Path, pictures: np.ndarray) -> None:
    jpegs = []
    for picture in pictures:
        buffer = io.BytesIO()
        Image.fromarray(picture).save(buffer, "JPEG", quality=80)
        jpegs.append(buffer.getvalue())
    path = tmp_path / "jpeg.h5"
    Scene("five", torch.arange(5).unsqueeze(1), torch.rand(5, 1, 2)).save(path, jpegs)
    scene = Scene.load(path)
    assert scene.has_pictures
    expected = [np.asarray(Image.open(io.BytesIO(jpegs[state]))) for state in (4, 4, 2)]
    assert np.array_equal(scene.pictures([4, 4, 2]).numpy(), np.stack(expected))
    assert scene.pictures([]).shape == (0, 6, 8, 3)


def test_only_the_pictures_asked_for_are_read(
    make_file: Callable[..., Path], pictures: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    original = h5py.Dataset.__getitem__

    def spy(self, key, *args, **kwargs):
        if self.name == "/observation":
            asked.append(key)
        return original(self, key, *args, **kwargs)

    path = make_file(observation=pictures)
    monkeypatch.setattr(h5py.Dataset, "__getitem__", spy)
    scene = Scene.load(path)
    assert asked == []
    scene.pictures([3, 1, 3])
    assert [key.tolist() for key in asked] == [[1, 3]]


def test_no_file_stays_open(make_file: Callable[..., Path], pictures: np.ndarray) -> None:
    path = make_file(observation=pictures)
    scene = Scene.load(path)
    assert str(path) not in open_files()
    scene.pictures([0])
    assert str(path) not in open_files()
    with h5py.File(path) as file:
        assert str(path) in open_files()  # the check itself can see an open file
        assert file["graph"].shape == (5, 3)


def test_pictures_that_are_not_there(make_file: Callable[..., Path], pictures: np.ndarray) -> None:
    with pytest.raises(SceneError, match="scene 'room' has no pictures"):
        Scene.load(make_file()).pictures([0])
    path = make_file("seen.h5", observation=pictures)
    scene = Scene.load(path)
    with pytest.raises(SceneError, match=r"seen.h5: there is no state 5; the states are 0..4"):
        scene.pictures([0, 5])
    with pytest.raises(SceneError, match="there is no state -1"):
        scene.pictures([-1])
    path.unlink()
    with pytest.raises(SceneError, match=r"seen.h5: there is no such file"):
        scene.pictures([0])


def test_relative_paths_survive_a_change_of_folder(
    make_file: Callable[..., Path], pictures: np.ndarray, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    make_file(observation=pictures)
    monkeypatch.chdir(tmp_path)
    scene = Scene.load("room.h5")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert np.array_equal(scene.pictures(2).numpy(), pictures[2])


def test_copies_and_pickles_are_whole(make_file: Callable[..., Path], pictures: np.ndarray) -> None:
    scene = Scene.load(make_file(observation=pictures, attributes={"seed": 1}))
    for other in (pickle.loads(pickle.dumps(scene)), copy.deepcopy(scene)):
        for key in ("graph", "features", "location", "rotation", "distance"):
            assert torch.equal(getattr(other, key), getattr(scene, key))
        assert (other.name, other.actions, other.attributes) == (scene.name, scene.actions, {"seed": 1})
        assert np.array_equal(other.pictures([1]).numpy(), pictures[[1]])


def _send_picture(scene: Scene, state: int, connection) -> None:
    connection.send((int(scene.pictures([state]).numpy().sum()), int(scene.distance.numpy().sum())))
    connection.close()


@pytest.mark.parametrize("method", ["fork", "spawn"])
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")  # Python 3.12: the test process has threads
def test_a_loaded_scene_works_in_other_processes(
    make_file: Callable[..., Path], pictures: np.ndarray, method: str
) -> None:
    scene = Scene.load(make_file(observation=pictures))
    scene.pictures([0])
    context = multiprocessing.get_context(method)
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_send_picture, args=(scene, 3, sender))
    process.start()
    sender.close()
    try:
        assert receiver.poll(60)
        assert receiver.recv() == (int(pictures[3].sum()), int(scene.distance.sum()))
    finally:
        process.join(10)
        process.kill()
    assert process.exitcode == 0
    assert scene.pictures([4]).sum() == int(pictures[4].sum())


def test_threads_may_read_at_once() -> None:
    scene = Scene.bundled("bathroom")
    expected = scene.pictures(range(8))
    found: dict[int, torch.Tensor] = {}

    def read(state: int) -> None:
        found[state] = scene.pictures(state)

    threads = [threading.Thread(target=read, args=(state,)) for state in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(torch.equal(found[state], expected[state]) for state in range(8))


def test_680_states_load_in_well_under_a_second() -> None:
    began = time.process_time()
    Scene.load(bundled_path("kitchen"))
    assert time.process_time() - began < 1.0  # 0.15 seconds on an idle core
