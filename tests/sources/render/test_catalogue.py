from __future__ import annotations

import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest

from vusfa.errors import SceneError
from vusfa.sources.render.catalogue import Catalogue, furniture_folder
from vusfa.sources.render.kinds import models_of_all_kinds
from vusfa.sources.render.meshes import Part, material_library, place


def test_lengths_are_metres_and_names_are_read_whole(boxes: Catalogue) -> None:
    crate, shelf = boxes["Boxes#1"], boxes["Boxes#2"]
    assert crate.size == (1.0, 0.8, 0.5)
    assert (crate.elevation, crate.top) == (0.0, 0.755)
    assert (crate.title, crate.creator, crate.collection) == ("Café crate", "A. Carpenter", "Boxes")
    assert crate.rotation is None
    assert (shelf.elevation, shelf.top, shelf.creator) == (1.5, 0.3, "unknown")
    np.testing.assert_array_equal(shelf.rotation, [[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    assert sorted(boxes) == ["Boxes#1", "Boxes#2"]


def test_files_are_read_from_the_archive_whatever_their_case(boxes: Catalogue) -> None:
    archive = boxes.archive(boxes["Boxes#1"])
    assert archive.read("Boxes/Crate/CRATE.obj").startswith(b"mtllib")
    assert archive.folder("boxes/crate") == ["crate.mtl", "crate.obj", "other.png"]
    with pytest.raises(SceneError, match=r"Boxes\.sh3f: cannot give 'boxes/shelf/shelf\.obj'"):
        archive.read("boxes/shelf/shelf.obj")


@pytest.mark.parametrize("trouble", ["swells", "damaged", "encrypted", "too large"])
def test_a_file_that_cannot_be_read_is_one_line(
    library: Path, trouble: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, size = library / "Boxes.sh3f", struct.pack("<I", 1 << 20)
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("boxes/big.obj", bytes(1 << 20))
    content = path.read_bytes()
    found = content.index(b"boxes/big.obj")
    if trouble == "swells":
        content = content.replace(size, struct.pack("<I", 100))
    elif trouble == "damaged":
        content = content[: found + 20] + b"\xff" * 20 + content[found + 40 :]
    elif trouble == "encrypted":
        listed = content.rindex(b"PK\x01\x02")
        content = content[: listed + 8] + b"\x01" + content[listed + 9 :]
    else:
        monkeypatch.setattr("vusfa.sources.render.catalogue.MAX_MODEL_BYTES", 1000)
    path.write_bytes(content)
    catalogue = Catalogue.open(library)
    with pytest.raises(SceneError, match=r"Boxes\.sh3f: cannot give 'boxes/big\.obj' \("):
        catalogue.archive(catalogue["Boxes#1"]).read("boxes/big.obj")


def test_an_unpacked_library_is_the_same(library: Path, tmp_path: Path) -> None:
    unpacked = tmp_path / "unpacked" / "Boxes"
    with zipfile.ZipFile(library / "Boxes.sh3f") as archive:
        archive.extractall(unpacked)
    catalogue = Catalogue.open(unpacked.parent)
    assert sorted(catalogue) == ["Boxes#1", "Boxes#2"]
    archive_of = catalogue.archive(catalogue["Boxes#1"])
    assert archive_of.folder("boxes/crate") == ["crate.mtl", "crate.obj", "other.png"]


def test_the_environment_names_the_folder(library: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SH3D_FURNITURE", str(library))
    assert furniture_folder() == library
    assert "Boxes#1" in Catalogue.open()


def test_no_furniture_is_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"sweethome3d-furniture.*SH3D_FURNITURE"):
        Catalogue.open(tmp_path)
    (tmp_path / "Torn.sh3f").write_bytes(b"PK, and then nothing")
    with pytest.raises(SceneError, match=r"Torn\.sh3f: is no furniture library"):
        Catalogue.open(tmp_path)


def test_materials_fall_back_to_the_only_picture_in_the_models_folder(boxes: Catalogue) -> None:
    found = material_library(boxes.archive(boxes["Boxes#1"]), "boxes/crate/crate.obj")
    assert found["wood"].color == [0.5, 0.25, 0.125]
    assert found["wood"].texture == "boxes/crate/other.png"
    assert (found["glass"].opacity, found["glass"].texture) == (0.2, None)


def test_a_placed_model_has_its_size_and_looks_where_it_should() -> None:
    # 2 long, 1 high, 1 deep; its front is +z. The first corner is the lower left one of the front.
    corners = np.array([[x, y, z] for z in (1.0, 0.0) for y in (0.0, 1.0) for x in (0.0, 2.0)])
    box = Part(corners, np.empty((0, 3)), None, np.zeros(3))
    (vertices,) = place([box], (1.0, 0.5, 0.4), (3.0, 2.0), 0.25, 90.0)
    # Looking along the plan's +X, which is the renderer's -x: its front lies there.
    np.testing.assert_allclose(vertices.min(axis=0), [-3.2, 0.25, 1.5], atol=1e-12)
    np.testing.assert_allclose(vertices.max(axis=0), [-2.8, 0.75, 2.5], atol=1e-12)
    assert vertices[0, 0] == pytest.approx(-3.2)


def test_the_packages_table_has_every_model_that_layouts_draw() -> None:
    assert set(models_of_all_kinds()) == set(Catalogue.bundled())
    with pytest.raises(SceneError, match=r"only the size of Scopia#5"):
        Catalogue.bundled().archive(Catalogue.bundled()["Scopia#5"])


@pytest.mark.render
def test_the_packages_table_is_that_of_the_installed_libraries() -> None:
    installed, table = Catalogue.open(), Catalogue.bundled()
    for name, model in table.items():
        found = installed[name]
        assert (found.size, found.elevation, found.top) == (model.size, model.elevation, model.top), name
        assert (found.title, found.creator) == (model.title, model.creator), name
