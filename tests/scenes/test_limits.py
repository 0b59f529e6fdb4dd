"""Files that reach outside themselves or declare more than they hold: one line, and nothing is opened."""

from __future__ import annotations

import io
import os
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from PIL import Image
from PIL.ImageFile import ImageFile

from vusfa.errors import SceneError
from vusfa.scenes import Scene, validate
from vusfa.scenes.pictures import decode, stored
from vusfa.sources.compact import compact

Make = Callable[..., Path]


def fault(path: Path) -> str:
    """The first fault of a file; loading it fails, too."""
    faults = validate(path)
    assert faults
    with pytest.raises(SceneError, match=r"room\.h5"):
        Scene.load(path)
    return faults[0]


def test_external_storage_is_refused(make_file: Make, pictures: np.ndarray) -> None:
    path = make_file()
    with h5py.File(path, "a") as file:
        size = os.path.getsize("/etc/passwd")
        file.create_dataset("observation", (5, 1, 1, 3), "u1", external=[("/etc/passwd", 0, size)])
    assert "lie outside the file" in fault(path)


@pytest.mark.parametrize("name", ["graph", "resnet_feature", "observation"])
def test_external_links_are_refused_and_not_followed(make_file: Make, tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / "pipe")  # opening it would hang
    path = make_file(**({name: None} if name != "observation" else {}))
    with h5py.File(path, "a") as file:
        file[name] = h5py.ExternalLink(str(tmp_path / "pipe"), name)
    assert "link to another place" in fault(path)


def test_soft_links_are_refused(make_file: Make) -> None:
    path = make_file(location=None)
    with h5py.File(path, "a") as file:
        file["elsewhere"] = h5py.ExternalLink("/etc/passwd", "/")
        file["location"] = h5py.SoftLink("/elsewhere/location")
    assert "dataset 'location' cannot be read (it is a link" in fault(path)


def test_virtual_datasets_are_refused(make_file: Make, tmp_path: Path) -> None:
    path = make_file(rotation=None)
    layout = h5py.VirtualLayout((5,), "f4")
    layout[:] = h5py.VirtualSource(str(tmp_path / "other.h5"), "rotation", (5,))
    with h5py.File(path, "a") as file:
        file.create_virtual_dataset("rotation", layout)
    assert "dataset 'rotation' cannot be read (its data lie outside" in fault(path)


def test_more_states_than_any_scene_has(make_file: Make) -> None:
    path = make_file(shortest_path_distance=None)
    with h5py.File(path, "a") as file:
        file.create_dataset("shortest_path_distance", (200_000, 200_000), "i2", chunks=True, compression=9)
    assert "declares 200000 states; at most 100000" in fault(path)


def test_declared_bytes_that_are_not_there(make_file: Make) -> None:
    path = make_file(resnet_feature=None)
    with h5py.File(path, "a") as file:
        file.create_dataset("resnet_feature", (5, 1000, 1_000_000), "f4", chunks=True, compression=9)
    assert "declares 20000000000 bytes, but 0 are stored" in fault(path)


def test_raw_pictures_of_a_giant(make_file: Make) -> None:
    path = make_file()
    with h5py.File(path, "a") as file:
        file.create_dataset("observation", (5, 5000, 2, 3), "u1", chunks=True, compression=9)
    assert "at most 4096 pixels per side" in fault(path)


def png(width: int, height: int) -> bytes:
    """A PNG file of a few bytes that declares any size."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(b""))
        + chunk(b"IEND", b"")
    )


def eps() -> bytes:
    buffer = io.BytesIO()
    Image.new("RGB", (4, 4)).save(buffer, "EPS")
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("encoded", "message"),
    [
        pytest.param(png(50_000, 50_000), "exceeds limit|pixels", id="2.5 billion pixels"),
        pytest.param(png(10_000, 10_000), "exceeds limit|10000 x 10000 pixels", id="100 million pixels"),
        pytest.param(png(5000, 1), "5000 x 1 pixels; at most 4096", id="too wide"),
        pytest.param(eps(), "unknown format", id="EPS"),
        pytest.param(png(40, 40), ".", id="no pixels"),
        pytest.param(b"", "unknown format", id="nothing"),
    ],
)
def test_pictures_that_are_refused(make_file: Make, encoded: bytes, message: str) -> None:
    with pytest.raises(OSError, match=message):
        decode(encoded)
    path = make_file()
    with h5py.File(path, "a") as file:
        dataset = file.create_dataset("observation_jpeg", (5,), h5py.vlen_dtype(np.uint8))
        for state in range(5):
            dataset[state] = np.frombuffer(encoded, np.uint8)
    assert "dataset 'observation_jpeg', state 0: is unusable" in fault(path)


def test_only_regular_files_are_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.h5")
    for path in (tmp_path / "pipe.h5", Path("/dev/zero")):
        assert validate(path) == [f"{path}: is no regular file; check the path"]


def test_one_picture_for_many_states_is_not_multiplied(
    make_file: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Entries of one dataset can share their bytes in the file, and would not share them in memory."""
    path = make_file()
    with h5py.File(path, "a") as file:
        dataset = file.create_dataset("observation_jpeg", (5,), h5py.vlen_dtype(np.uint8))
        for state in range(5):
            dataset[state] = np.zeros(10_000, np.uint8)
    monkeypatch.setattr(Path, "stat", lambda self: os.stat_result([0o100644, 0, 0, 0, 0, 0, 20_000, 0, 0, 0]))
    with pytest.raises(SceneError, match="has more bytes than the file"):
        stored(path, 5)


def test_pictures_of_one_color_are_read_whatever_their_size(make_file: Make) -> None:
    black = np.zeros((5, 2600, 2600, 3), np.uint8)  # 101 MB
    path = make_file()
    with h5py.File(path, "a") as file:
        file.create_dataset("observation", data=black, chunks=(1, 2600, 2600, 3), compression=9)
    assert path.stat().st_size < black.nbytes / 500
    assert validate(path) == []


@pytest.mark.parametrize("length", [16, 400])
def test_zeros_in_the_heap_of_texts_and_pictures(make_file: Make, length: int) -> None:
    """A block that never reached the disk; HDF5 itself would not return."""
    path = make_file(attributes={"licences": ["CC0", "CC BY"], "credits": "somebody" * 30})
    with h5py.File(path, "a") as file:
        file.attrs.create("more", ["a", "b"], dtype=h5py.string_dtype())
    content = path.read_bytes()
    first = content.index(b"GCOL") + 16
    path.write_bytes(content[:first] + bytes(length) + content[first + length :])
    assert validate(path) == [f"{path}: is damaged at byte {first}; copy the file or make it again"]
    with pytest.raises(SceneError, match="is damaged at byte"):
        Scene.load(path)


def test_texts_that_are_shared_by_many_entries(make_file: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    path = make_file(attributes={"credits": ["x" * 1000] * 50, "numbers": np.zeros(100)})
    assert len(Scene.load(path).attributes["credits"]) == 50
    monkeypatch.setattr("vusfa.limits.MAX_ATTRIBUTE_BYTES", 40_000)
    assert "attribute 'credits' declares up to" in fault(path)
    monkeypatch.setattr("vusfa.limits.MAX_ATTRIBUTE_BYTES", 700)
    assert "attribute 'numbers' declares up to 800 bytes" in fault(
        make_file(attributes={"numbers": np.zeros(100)})
    )


@pytest.mark.parametrize("name", ["x" * 201, "a\x1b[31m", "two\nlines"])
def test_names_that_messages_cannot_show(make_file: Make, name: str) -> None:
    text = fault(make_file(attributes={"scene": name}))
    assert "attribute 'scene' is " in text
    assert text.isprintable()
    assert len(text) < 500


def test_features_that_swell(make_file: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    path = make_file(resnet_feature=None)
    with h5py.File(path, "a") as file:
        file.create_dataset("resnet_feature", data=np.ones((5, 4, 100)), compression=9)
    assert validate(path) == []
    monkeypatch.setattr("vusfa.limits.MAX_EXTRA_BYTES", 5_000)
    assert "needs 8000 bytes as float32, but " in fault(path)


@pytest.mark.parametrize("chunks", [None, (2, 1, 3)])
@pytest.mark.parametrize("kind", ["f2", "f8", ">f4"])
def test_features_of_any_width_are_read_and_written_by_rows(
    make_file: Make,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    kind: str,
    chunks: tuple[int, ...] | None,
) -> None:
    monkeypatch.setattr("vusfa.scenes.hdf5._NUMBERS_AT_ONCE", 30)
    values = np.random.default_rng(0).standard_normal((5, 2, 7)).astype(kind)
    path, damaged = make_file(resnet_feature=None), make_file("damaged.h5", resnet_feature=None)
    with h5py.File(path, "a") as file:
        file.create_dataset("resnet_feature", data=values, chunks=chunks)
    scene = Scene.load(path)
    assert scene.features.numpy().tolist() == values.astype(np.float32).tolist()
    scene.save(tmp_path / "again.h5")
    assert Scene.load(tmp_path / "again.h5").features.equal(scene.features)
    compact(path, tmp_path / "small.h5")
    assert Scene.load(tmp_path / "small.h5").features.numpy().tolist() == values.astype("f2").tolist()
    values[4, 1, 3] = np.nan if kind == "f2" else np.inf
    with h5py.File(damaged, "a") as file:
        file.create_dataset("resnet_feature", data=values, chunks=chunks)
    assert "state 4: crop 1, feature 3 is " in "".join(validate(damaged))


@pytest.mark.parametrize(("kind", "most"), [("f2", 5.5), ("f4", 5.5), ("f8", 6.5)])
def test_features_take_the_memory_of_float32_alone(
    make_file: Make, monkeypatch: pytest.MonkeyPatch, kind: str, most: float
) -> None:
    monkeypatch.setattr("vusfa.scenes.hdf5._NUMBERS_AT_ONCE", 10_000)
    path = make_file(resnet_feature=np.ones((5, 10, 10_000), kind))
    tracemalloc.start()
    try:
        Scene.load(path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak / 500_000 < most  # bytes per number


def test_chunks_are_bounded(make_file: Make, pictures: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    path = make_file()
    with h5py.File(path, "a") as file:
        file.create_dataset("observation", data=pictures, chunks=pictures.shape)
    assert validate(path) == []
    monkeypatch.setattr("vusfa.limits.MAX_CHUNK_BYTES", 700)
    assert "has chunks of shape (5, 6, 8, 3); at most 700 bytes" in fault(path)


@pytest.mark.parametrize("kind", ["JPEG", "PNG"])
@pytest.mark.parametrize("damage", ["cut off", "other size", "no picture", "empty"])
def test_a_bad_picture_at_the_end_is_refused_before_all_others_are_decoded(
    make_file: Make, monkeypatch: pytest.MonkeyPatch, kind: str, damage: str
) -> None:
    def encoded(side: int) -> bytes:
        buffer = io.BytesIO()
        Image.effect_noise((side, 16), 90).convert("RGB").save(buffer, kind)
        return buffer.getvalue()

    sound = encoded(20)
    last = {"cut off": sound[:-300], "other size": encoded(21), "no picture": eps(), "empty": b""}[damage]
    path = make_file()
    with h5py.File(path, "a") as file:
        dataset = file.create_dataset("observation_jpeg", (5,), h5py.vlen_dtype(np.uint8))
        for state in range(5):
            dataset[state] = np.frombuffer(last if state == 4 else sound, np.uint8)
    loads: list[object] = []
    load = ImageFile.load
    monkeypatch.setattr(ImageFile, "load", lambda image: (loads.append(image), load(image))[1])
    (found,) = validate(path)
    assert "dataset 'observation_jpeg', state 4: is unusable" in found
    assert len(set(map(id, loads))) <= 3  # of state 0, where its shape is looked up, and of the bad one


def test_what_only_decoding_finds(make_file: Make) -> None:
    """Damage in the middle of one; with few decoded, evenly spaced, the first and the last are among them."""
    buffer = io.BytesIO()
    Image.effect_noise((20, 16), 90).convert("RGB").save(buffer, "PNG")
    sound = buffer.getvalue()
    middle = sound[:200] + bytes(40) + sound[240:]
    for bad, few in ((4, 2), (0, 2), (2, 3)):
        path = make_file()
        with h5py.File(path, "a") as file:
            dataset = file.create_dataset("observation_jpeg", (5,), h5py.vlen_dtype(np.uint8))
            for state in range(5):
                dataset[state] = np.frombuffer(middle if state == bad else sound, np.uint8)
        assert f"state {bad}: is unusable" in validate(path)[0]
        assert f"state {bad}: is unusable" in validate(path, few)[0]
    assert validate(make_file(), 0) == []
