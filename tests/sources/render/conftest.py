from __future__ import annotations

import zipfile
from pathlib import Path

import pytest

from vusfa.sources.render.catalogue import Catalogue

PROPERTIES = """\
# a library of two boxes
id=Test#boxes
model#1=/boxes/crate/crate.obj
name#1=Caf\\u00e9 crate
creator#1=A. Carpenter
width#1=100.0
depth#1=50.0
height#1=80.0
dropOnTopElevation#1=75.5
model#2=/boxes/shelf/shelf.obj
name#2=Shelf
creator#2=
width#2=60
depth#2=20
height#2=30
elevation#2=150
modelRotation#2=1 0 0  0 0 -1  0 1 0
"""

CRATE = """\
mtllib Crate.mtl
v 0 0 0
v 2 0 0
v 2 1 0
v 0 1 4
vt 0 0
vt 1e9 1
usemtl wood
f 1/1 2/2 3/1
usemtl glass
f 1/1 3/2 4/1
"""

MATERIALS = """\
newmtl wood
Kd 0.5 0.25 0.125
map_Kd C:\\textures\\Planks.png
newmtl glass
Kd 0.9 0.9 0.9
d 0.2
"""


@pytest.fixture
def library(tmp_path: Path) -> Path:
    """A folder with one library of furniture, as a zip archive."""
    folder = tmp_path / "furniture"
    folder.mkdir()
    with zipfile.ZipFile(folder / "Boxes.sh3f", "w") as archive:
        archive.writestr("PluginFurnitureCatalog.properties", PROPERTIES.encode("latin-1"))
        archive.writestr("boxes/crate/crate.obj", CRATE)
        archive.writestr("boxes/crate/crate.mtl", MATERIALS)
        archive.writestr("boxes/crate/other.png", b"no picture, but the only one there")
    return folder


@pytest.fixture
def boxes(library: Path) -> Catalogue:
    return Catalogue.open(library)
