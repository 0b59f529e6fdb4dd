"""from-photos, from a folder to a scene that can be trained on."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from vusfa.scenes import Scene, validate
from vusfa.scenes.provenance import Provenance
from vusfa.sources import backbones
from vusfa.sources.backbones import Backbone
from vusfa.sources.crops import Preprocessing

Run = Callable[..., Any]


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def room() -> Scene:
    """The bundled bathroom."""
    return Scene.bundled("bathroom")


@pytest.fixture
def flat(tmp_path: Path, room: Scene) -> Path:
    """Photographs of the bathroom, as a person would have taken them: measured to the centimetre."""
    rng = np.random.default_rng(0)
    folder = tmp_path / "flat"
    folder.mkdir()
    lines = ["file,x,z,heading"]
    for state, picture in enumerate(room.pictures(range(room.num_states)).numpy()):
        Image.fromarray(picture).save(folder / f"{state:03}.jpg", quality=92)
        x, z = room.location[state].numpy() + rng.normal(0, 0.01, 2)
        lines.append(f"{state:03}.jpg,{x:.2f},{z:.2f},{room.rotation[state] + rng.normal(0, 1):.0f}")
    (folder / "poses.csv").write_text("\n".join(lines))
    return folder


@pytest.fixture
def features(tmp_path: Path, room: Scene) -> Path:
    """The bathroom's own features, in a file."""
    np.save(tmp_path / "features.npy", room.features[:, 0].numpy())
    return tmp_path / "features.npy"


@pytest.fixture
def mean_colour(monkeypatch: pytest.MonkeyPatch) -> Callable[[], int]:
    """In place of a large network: the mean colour of a picture. Gives how many pictures it has seen."""
    seen = []

    def network(images: torch.Tensor) -> torch.Tensor:
        seen.extend(images)
        return images.mean((2, 3))

    plain = Preprocessing(size=16, resize=16, mean=(0.0,) * 3, std=(1.0,) * 3)
    tiny = Backbone("mean colour", "mean", "0" * 64, plain, network, mixed=False)
    monkeypatch.setattr(backbones, "load_backbone", lambda name, weights: tiny)
    return lambda: len(seen)


def entries(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_a_bundled_room_comes_out_of_its_photographs(
    run: Run, flat: Path, room: Scene, features: Path, tmp_path: Path
) -> None:
    options = ["--by", "A. Fan", "--licence", "CC0", "--credit", "one", "--credit", "two"]
    result = run("from-photos", flat, "--features", features, *options)
    assert result.exit_code == 0, result.output
    assert result.stdout == "flat.h5: 176 states, a grid of 0.5 m, headings 90 degrees apart\n"
    assert result.stderr.startswith("next: vusfa scenes show flat.h5; vusfa train preset=replay_search")
    assert validate("flat.h5") == []
    scene = Scene.load("flat.h5")
    assert scene.name == "flat"
    assert torch.equal(scene.graph, room.graph)
    assert torch.equal(scene.distance, room.distance)
    assert scene.actions == room.actions
    assert torch.equal(scene.features, room.features)
    assert (scene.location - room.location).abs().max() < 0.01
    assert torch.equal(scene.rotation, room.rotation)
    assert scene.picture_shape == (150, 200, 3)
    difference = (scene.pictures([7, 150]).int() - room.pictures([7, 150]).int()).abs().float()
    assert difference.mean() < 2, "packed as JPEG a second time"
    origin = Provenance.of(scene.attributes)
    assert (origin.made_by, origin.licences, origin.credits) == ("A. Fan", ("CC0",), ("one", "two"))
    assert origin.made_with is not None
    assert origin.made_with.endswith("scenes from-photos")
    assert scene.attributes["photographs"].splitlines()[3] == "003.jpg"
    assert entries(tmp_path) == {"flat", "flat.h5", "features.npy"}


def test_what_is_written_can_be_copied_number_for_number(run: Run, flat: Path, features: Path) -> None:
    run("from-photos", flat, "--features", features)
    Scene.load("flat.h5").save("copy.h5")
    assert Path("flat.h5").read_bytes() == Path("copy.h5").read_bytes()


def test_features_are_computed_of_the_pictures_that_are_kept(
    run: Run, flat: Path, mean_colour: Callable[[], int]
) -> None:
    result = run("from-photos", flat, "-o", "a.h5", "--size", "40x30", "--store", "raw", "--name", "bath")
    assert result.exit_code == 0, result.output
    scene = Scene.load("a.h5")
    assert (scene.name, scene.picture_shape, scene.feature_size) == ("bath", (30, 40, 3), 3)
    means = scene.pictures(range(176)).double().mean((1, 2)) / 255
    assert (scene.features[:, 0] - means).abs().max() < 0.03
    assert scene.attributes["feature_backbone"] == "mean colour"
    assert mean_colour() >= 176


def test_stopped_while_it_encodes_it_goes_on(
    run: Run, flat: Path, mean_colour: Callable[[], int], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Ctrl-C after 96 pictures; then the rest alone; the file is the same as in one go."""
    from vusfa.sources.row_log import RowLog

    monkeypatch.setenv("SOURCE_DATE_EPOCH", "0")
    run("from-photos", flat, "-o", "whole.h5")
    in_one_go, append = mean_colour(), RowLog.append

    def interrupted(log: RowLog, rows: np.ndarray) -> None:
        append(log, rows)
        if len(log) >= 96:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(RowLog, "append", interrupted)
        assert run("from-photos", flat, "-o", "b.h5", "--name", "whole").exit_code == 130
    assert not Path("b.h5").exists()
    before = mean_colour()
    assert run("from-photos", flat, "-o", "b.h5", "--name", "whole").exit_code == 0
    assert mean_colour() - before == in_one_go - 96
    assert Path("b.h5").read_bytes() == Path("whole.h5").read_bytes()
    assert entries(tmp_path) == {"flat", "whole.h5", "b.h5"}


@pytest.mark.parametrize("there_before", [False, True])
def test_stopped_while_it_writes_nothing_is_half_written(
    run: Run, flat: Path, features: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, there_before: bool
) -> None:
    if there_before:
        Path("flat.h5").write_bytes(b"precious")

    def stop(*arguments: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("vusfa.scenes.pictures.write_jpegs", stop)
    result = run("from-photos", flat, "--features", features, "--force")
    assert (result.exit_code, result.stderr) == (130, "stopped\n")
    assert entries(tmp_path) == {"flat", "features.npy"} | ({"flat.h5"} if there_before else set())
    if there_before:
        assert Path("flat.h5").read_bytes() == b"precious"


def test_a_file_is_replaced_only_when_asked(run: Run, flat: Path, features: Path) -> None:
    Path("flat.h5").write_bytes(b"precious")
    result = run("from-photos", flat, "--features", features)
    assert result.exit_code == 1
    assert "flat.h5: exists; choose another name, or replace it with --force" in result.stderr
    assert Path("flat.h5").read_bytes() == b"precious"
    assert run("from-photos", flat, "--features", features, "--force").exit_code == 0
    assert validate("flat.h5") == []


def test_edges_and_what_may_be_an_oversight(run: Run, flat: Path, tmp_path: Path) -> None:
    (flat / "poses.csv").unlink()
    moves = ["000.jpg,on,001.jpg", "001.jpg,on,002.jpg", "002.jpg,on,000.jpg", "003.jpg,on,004.jpg"]
    (tmp_path / "moves.csv").write_text("\n".join(["state,action,next", *moves]))
    np.save("features.npy", np.eye(5))
    result = run("from-photos", flat, "--edges", "moves.csv", "--features", "features.npy")
    assert result.exit_code == 0, result.output
    assert Scene.load("flat.h5").graph.tolist() == [[1], [2], [0], [4], [-1]]
    assert Scene.load("flat.h5").actions == ("on",)
    notes = result.stderr.splitlines()
    assert notes[0].startswith("note: 171 pictures are in no table and were left out: 005.jpg, 006.jpg, ")
    assert notes[1].startswith("note: 2 states are cut off from the others, on 1 islands")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["gone"], "gone: there is no such folder"),
        (["flat", "--size", "200"], "--size is '200'; write WIDTHxHEIGHT in pixels"),
        (["flat", "--size", "0x10"], "--size is '0x10'"),
        (["flat", "--turn", "30"], "a turn is 30 degrees; it must be one of 45, 90, 180, 360"),
        (["flat", "--step", "0.3"], "the nearest place of a grid of 0.3 m"),
        (["flat", "--poses", "gone.csv"], "gone.csv: cannot be read (there is no such file)"),
        (["flat", "--features", "gone.npy"], "gone.npy: cannot be read"),
        (["flat", "--backbone", "magic"], "no backbone is called 'magic'"),
    ],
)
def test_what_cannot_be(run: Run, flat: Path, arguments: list[str], message: str, tmp_path: Path) -> None:
    result = run("from-photos", *arguments)
    assert result.exit_code == 1, result.output
    assert result.stderr.startswith("error: ")
    assert message in result.stderr
    assert entries(tmp_path) == {"flat"}


def test_a_folder_that_cannot_be_written_to(run: Run, flat: Path, features: Path) -> None:
    result = run("from-photos", flat, "--features", features, "-o", os.path.join("nowhere", "a.h5"))
    assert result.exit_code == 1
    assert "cannot be written" in result.stderr
