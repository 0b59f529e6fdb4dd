"""The small copy of a scene file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from vusfa.errors import SceneError
from vusfa.scenes import Scene, store
from vusfa.sources.compact import compact

# What the bundled rooms were made from, where it lies beside the repository.
_RENDERED = Path(__file__).parents[3] / "shared" / "scenes"


def test_features_are_rounded_and_all_else_is_kept(
    make_file: Callable[..., Path], pictures: np.ndarray, tmp_path: Path
) -> None:
    source = make_file(observation=pictures, attributes={"scene": "study", "seed": 4, "licences": ["CC0"]})
    compact(source, tmp_path / "small.h5")
    before, after = Scene.load(source), Scene.load(tmp_path / "small.h5")
    with h5py.File(tmp_path / "small.h5") as file:
        assert file["resnet_feature"].dtype == "float16"
        assert "observation" not in file
    assert torch.equal(after.features, before.features.half().float())
    assert not torch.equal(after.features, before.features)
    for key in ("graph", "location", "rotation", "distance"):
        assert torch.equal(getattr(after, key), getattr(before, key))
    assert (after.name, after.attributes) == ("study", {"seed": 4, "licences": ["CC0"]})
    assert after.picture_shape == before.picture_shape


def test_pictures_can_be_left_out(
    make_file: Callable[..., Path], pictures: np.ndarray, tmp_path: Path
) -> None:
    compact(make_file(observation=pictures), tmp_path / "small.h5", pictures=False)
    found = Scene.load(tmp_path / "small.h5")
    assert (found.num_states, found.has_pictures) == (len(pictures), False)


def test_raw_pictures_become_jpeg_files_that_look_the_same(
    make_file: Callable[..., Path], tmp_path: Path
) -> None:
    gradient = np.linspace(0, 255, 32)
    picture = np.stack([np.add.outer(gradient, gradient) / 2] * 3, axis=-1).astype(np.uint8)
    source = make_file(observation=np.stack([picture, 255 - picture] * 2 + [picture]))
    compact(source, tmp_path / "small.h5")
    off = Scene.load(source).pictures(range(5)).int() - Scene.load(tmp_path / "small.h5").pictures(range(5))
    assert off.abs().max() <= 6


def test_jpeg_pictures_are_kept_byte_for_byte_and_twice_is_once(tmp_path: Path) -> None:
    room = Scene.bundled("bathroom")
    compact(room.path, tmp_path / "twice.h5")
    assert (tmp_path / "twice.h5").read_bytes() == room.path.read_bytes()


def test_features_beyond_half_precision_are_refused(make_file: Callable[..., Path], tmp_path: Path) -> None:
    features = np.ones((5, 2, 7), np.float32)
    features[2, 0, 0] = 1e5
    with pytest.raises(SceneError, match=r"room.h5: dataset 'resnet_feature', state 2: .*beyond float16"):
        compact(make_file(resnet_feature=features), tmp_path / "small.h5")
    assert not (tmp_path / "small.h5").exists()


def test_the_old_name_is_found_and_warns() -> None:
    with pytest.warns(DeprecationWarning, match=r"vusfa\.sources\.compact\.compact"):
        assert store.compact is compact


@pytest.mark.skipif(not _RENDERED.is_dir(), reason="the rendered rooms do not lie beside the repository")
@pytest.mark.parametrize("name", ["bathroom", "bedroom", "kitchen", "living_room"])
def test_the_bundled_rooms_are_what_was_rendered(name: str) -> None:
    source, room = Scene.load(_RENDERED / f"{name}.h5"), Scene.bundled(name)
    assert torch.equal(room.features, source.features.half().float())
    for key in ("graph", "location", "rotation", "distance"):
        assert torch.equal(getattr(room, key), getattr(source, key))
    assert (room.name, room.actions, room.attributes) == (source.name, source.actions, source.attributes)
    with h5py.File(source.path) as rendered, h5py.File(room.path) as bundled:
        for before, after in zip(rendered["observation_jpeg"], bundled["observation_jpeg"], strict=True):
            assert before.tobytes() == after.tobytes()
