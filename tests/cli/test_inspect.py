"""list, show and check."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from PIL import Image

from vusfa.scenes import Scene, pictures
from vusfa.scenes.provenance import Provenance

Run = Callable[..., Any]


@pytest.fixture
def faulty_file(scene_file: Path) -> Path:
    """A copy of the scene with two faults."""
    path = shutil.copy(scene_file, scene_file.with_name("faulty.h5"))
    with h5py.File(path, "a") as file:
        file["graph"][3, 1] = 99
        file["rotation"][2] = np.nan
    return Path(path)


def test_list_measures_bundled_rooms_and_files(run: Run, scene_file: Path) -> None:
    result = run("list", "bathroom", scene_file, "--json")
    assert result.exit_code == 0
    bathroom, hall = json.loads(result.stdout)
    assert bathroom["file"] == "bundled"
    # The numbers that came with the room.
    assert (bathroom["name"], bathroom["states"], bathroom["cells"]) == ("bathroom", 176, 44)
    assert (bathroom["features"], bathroom["islands"], bathroom["longest_path"]) == (1280, 0, 21)
    assert round(bathroom["random_walk"], 3) == 0.566
    assert round(bathroom["mean_path"], 1) == 8.1
    assert hall["file"] == str(scene_file)
    assert (hall["states"], hall["cells"], hall["actions"]) == (16, 4, 4)
    assert hall["picture_shape"] == [40, 48, 3]


def test_list_draws_a_table(run: Run, scene_file: Path) -> None:
    result = run("list", "bathroom", scene_file, "--walk-steps", 0)
    assert result.exit_code == 0
    (row,) = [line for line in result.stdout.splitlines() if "bathroom" in line]
    cells = [cell.strip() for cell in row.strip("│").split("│")]
    assert cells[:6] == ["bathroom", "176", "44", "4", "1280", "0"]
    assert cells[6] == "0.0 %", "no look-alikes"
    assert cells[7] == "0.0 %", "no steps, no success"
    assert cells[8:] == ["8.1", "21", "200 x 150", "bundled"]
    assert str(scene_file) in result.stdout, "a long path is not cut off"


def test_list_counts_the_look_alikes_of_all_scenes_of_a_name(
    run: Run, scene_file: Path, make_scene: Any
) -> None:
    scene = make_scene("hall")
    features = scene.features.clone()
    features[1] = 2 * features[0]
    Scene("hall", scene.graph, features).save(scene_file.with_name("two_alike.h5"))
    arguments = ["list", scene_file, scene_file.with_name("two_alike.h5"), "bathroom"]
    assert [row["look_alikes"] for row in json.loads(run(*arguments, "--json").stdout)] == [0, 2 / 16, 0]
    groups = json.loads(run(*arguments, "--by-name", "--json").stdout)
    assert groups[0] == {"name": "hall", "scenes": 2, "states": 32, "look_alikes": 0.0625, "most": 0.125}
    (row,) = [line for line in run(*arguments, "--by-name").stdout.splitlines() if "hall" in line]
    cells = [cell.strip() for cell in row.strip("│").split("│")]
    assert cells == ["hall", "2", "32", "93.75 %", "87.50 %"]


def test_list_looks_into_folders(
    run: Run, scene_file: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    folder = tmp_path / "rooms"
    folder.mkdir()
    shutil.copy(scene_file, folder / "b.hdf5")
    shutil.copy(scene_file, folder / "a.h5")
    (folder / "notes.txt").write_text("no scene")
    with h5py.File(folder / "other.h5", "w") as file:
        file["something"] = [1]
    names = [Path(row["file"]).name for row in json.loads(run("list", folder, "--json").stdout)]
    assert names == ["a.h5", "b.hdf5"]
    names = [Path(row["file"]).name for row in json.loads(run("list", f"{folder}/*.h5", "--json").stdout)]
    assert names == ["a.h5"]
    monkeypatch.chdir(folder)
    names = [row["name"] for row in json.loads(run("list", "--json").stdout)]
    assert names == ["bathroom", "bedroom", "kitchen", "living_room", "hall", "hall"]


def test_list_goes_on_after_a_faulty_file(run: Run, scene_file: Path, faulty_file: Path) -> None:
    result = run("list", faulty_file, scene_file)
    assert result.exit_code == 1
    assert "faulty" in result.stdout
    assert "hall" in result.stdout
    assert "state 3: action 1 leads to 99" in result.stderr
    told = json.loads(run("list", faulty_file, scene_file, "--json").stdout)
    assert "leads to 99" in told[0]["error"]
    assert told[1]["states"] == 16


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("attic", "'attic' is neither a bundled scene (bathroom, bedroom, kitchen, living_room) nor a file"),
        ("", "there are no scene files (.h5, .hdf5); check the path"),
        ("gone.h5", "there is no such file"),
    ],
)
def test_list_says_what_is_not_there(
    run: Run, source: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = run("list", source or tmp_path)
    assert result.exit_code == 1
    assert message in result.stderr


def test_show_draws_one_png(run: Run, scene_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(scene_file.parent)
    result = run("show", scene_file.name, "--pictures", 2)
    assert result.exit_code == 0, result.stderr
    with Image.open(scene_file.with_name("hall.png")) as image:
        assert image.format == "PNG"
    assert result.stdout.splitlines()[0] == "hall: 16 states in 4 places, islands: 0"
    assert result.stdout.splitlines()[-1] == "drawn: hall.png"
    assert "look-alikes: 0.0 % of the states" in result.stdout
    assert "origin: unknown" in result.stdout


def test_show_prints_where_a_scene_comes_from(
    run: Run, make_scene: Callable[..., Scene], tmp_path: Path
) -> None:
    origin = Provenance("a tool 1.0", "A. Fan", plan="walls: 4\nsize: [3, 4]", licences=("CC0", "CC BY 3.0"))
    scene = make_scene("hall")
    attributes = {**origin.attributes(), "exposure": 2.5, "long": "\n".join(map(str, range(30)))}
    told = Scene("hall", scene.graph, scene.features, attributes=attributes)
    told.save(tmp_path / "told.h5")
    result = run("show", tmp_path / "told.h5", "-o", tmp_path / "told.png")
    lines = result.stdout.splitlines()
    first = lines.index("origin:")
    assert lines[first : first + 9] == [
        "origin:",
        "  made with: a tool 1.0",
        "  made by: A. Fan",
        "  plan:",
        "    walls: 4",
        "    size: [3, 4]",
        "  licences:",
        "    CC0",
        "    CC BY 3.0",
    ]
    assert lines[first + 9 : -1] == [
        "other attributes:",
        "  exposure: 2.5",
        "  long:",
        "    0",
        "    1",
        "    2",
        "    ... (30 lines)",
    ]


def test_show_where_it_cannot_write(run: Run, scene_file: Path) -> None:
    result = run("show", scene_file, "-o", scene_file.parent / "nowhere" / "a.png")
    assert result.exit_code == 1
    assert "cannot be written" in result.stderr


def test_check_says_all_faults_of_all_files(run: Run, scene_file: Path, faulty_file: Path) -> None:
    result = run("check", scene_file, faulty_file, "gone.h5")
    assert result.exit_code == 1
    lines = result.stdout.splitlines()
    assert lines[0] == f"{scene_file}: sound"
    assert lines[1].startswith(f"{faulty_file}: dataset 'graph', state 3: action 1 leads to 99")
    assert lines[2].startswith(f"{faulty_file}: dataset 'rotation', state 2: nan")
    assert lines[3] == "gone.h5: there is no such file; check the path"
    assert len(lines) == 4
    assert result.stderr == "error: 2 of 3 files have faults\n"


def test_check_is_silent_about_nothing(run: Run, scene_file: Path) -> None:
    result = run("check", scene_file)
    assert (result.exit_code, result.stdout, result.stderr) == (0, f"{scene_file}: sound\n", "")


def test_check_says_how_many_pictures_it_has_decoded(
    run: Run, scene_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Damage in the middle of a picture at the end of a huge file: --all finds it, and the line says so."""
    with h5py.File(scene_file, "a") as file:
        raw = file["observation"][()]
        del file["observation"]
        noise = np.random.default_rng(0).integers(0, 256, raw.shape, dtype=np.uint8)
        stored = [io.BytesIO() for _ in noise]
        for picture, png in zip(noise, stored, strict=True):
            Image.fromarray(picture).save(png, "PNG")
        damaged = bytearray(stored[-2].getvalue())  # not sampled: the first, the last, and two between are
        damaged[len(damaged) // 2] ^= 1
        pictures.write_jpegs(file, [*(png.getvalue() for png in stored[:-2]), damaged, stored[-1].getvalue()])
    monkeypatch.setattr("vusfa.limits.MAX_DECODED_PIXELS", 4 * 40 * 48)
    result = run("check", scene_file)
    note = "4 of 16 pictures decoded; --all decodes every one"
    assert (result.exit_code, result.stdout) == (0, f"{scene_file}: sound ({note})\n")
    every = run("check", scene_file, "--all")
    assert every.exit_code == 1
    assert "dataset 'observation_jpeg', state 14: is unusable" in every.stdout


def test_compare_says_how_far_two_scenes_are_apart(run: Run, scene_file: Path, make_scene: Any) -> None:
    result = run("compare", scene_file, scene_file)
    assert result.exit_code == 0, result.stderr
    assert result.stdout.splitlines() == [
        "graph: equal",
        "poses: equal",
        "pictures: 0.000 of 255 apart on average, 0.000 at most",
        "features: equal, cosine 1.000000 on average, 1.000000 at least",
    ]
    scene = make_scene("hall")
    other = scene_file.with_name("other.h5")
    Scene("hall", scene.graph, scene.features[:, :, 1:], scene.location, scene.rotation + 1).save(other)
    result = run("compare", scene_file, other)
    assert result.exit_code == 1
    assert result.stdout.splitlines() == [
        "graph: equal",
        "poses: different",
        "pictures: none in one of them, or not of the same size",
        "features: not as many",
    ]
    assert "176 states and cannot be compared" in run("compare", scene_file, "bathroom").stderr
