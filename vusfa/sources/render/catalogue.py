"""Furniture from the Sweet Home 3D libraries: models, sizes, authors and licences.

The libraries are ``.sh3f`` files, which are zip archives with a catalogue of properties inside; Debian's
package ``sweethome3d-furniture`` puts five of them into ``/usr/share/sweethome3d/furniture``. They are read
as they are, without unpacking; an unpacked library (a folder of the archive's name) will do too. The
environment variable ``SH3D_FURNITURE`` names another folder.

A model is called ``COLLECTION#NUMBER``, such as ``Scopia#5``. The sizes of all models that layouts draw from
are also in this package (``furniture.yaml``), so that rooms can be planned without any furniture.
"""

from __future__ import annotations

import os
import re
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import yaml

from vusfa.errors import SceneError
from vusfa.limits import MAX_MODEL_BYTES
from vusfa.reading import BoundedZip, open_regular

__all__ = ["DEBIAN_FOLDER", "LICENCES", "Archive", "Catalogue", "Model", "furniture_folder"]

DEBIAN_FOLDER = Path("/usr/share/sweethome3d/furniture")

#: Licence of each collection. The catalogues' own words are longer and differ between versions.
LICENCES = {
    "BlendSwap-CC-0": "CC0 1.0 (public domain), https://creativecommons.org/publicdomain/zero/1.0/",
    "BlendSwap-CC-BY": "CC BY 3.0, https://creativecommons.org/licenses/by/3.0/",
    "KatorLegaz": "CC BY 3.0 US, https://creativecommons.org/licenses/by/3.0/us/,"
    " copyright 2003-2008 Andrew Kator and Jennifer Legaz",
    "Reallusion": "CC BY 3.0 US, https://creativecommons.org/licenses/by/3.0/us/,"
    " copyright 2008-2016 Reallusion",
    "Scopia": "CC BY 3.0, https://creativecommons.org/licenses/by/3.0/, copyright 2006-2020 Emmanuel Puybaret"
    " / eTeks and Scopia Visual Interfaces Systems, s.l.",
}

_PROPERTIES = "PluginFurnitureCatalog.properties"


@dataclass(frozen=True, eq=False)
class Model:
    """An entry of the catalogue; lengths in metres.

    Args:
        name: ``COLLECTION#NUMBER``.
        title: what it is, such as ``Wardrobe``.
        creator: its author, as the catalogue names them.
        size: (width, height, depth).
        elevation: of its underside above the floor.
        top: how high above its underside other things stand on it.
        file: its OBJ file inside the archive; empty when only its size is known.
        rotation: (3, 3) that turns the file's vertices upright, or None.
    """

    name: str
    title: str
    creator: str
    size: tuple[float, float, float]
    elevation: float = 0.0
    top: float = 0.0
    file: str = ""
    rotation: np.ndarray | None = None

    @property
    def collection(self) -> str:
        """Name of its collection."""
        return self.name.partition("#")[0]

    @property
    def width(self) -> float:
        """Length along its wall, in metres."""
        return self.size[0]

    @property
    def height(self) -> float:
        """Height above its underside, in metres."""
        return self.size[1]

    @property
    def depth(self) -> float:
        """Length away from its wall, in metres."""
        return self.size[2]

    @property
    def exact_size(self) -> tuple[float, float, float]:
        """Size as written in plans: rounded to a micrometre, without the errors of a division."""
        width, height, depth = (round(length, 6) for length in self.size)
        return width, height, depth

    @property
    def credit(self) -> str:
        """Name, title, author and licence in one line, as the licences require.

        >>> Catalogue.bundled()["Scopia#5"].credit.split(", https")[0]
        'Scopia#5 Wardrobe, by Scopia (CC BY 3.0'
        """
        licence = LICENCES.get(self.collection, "licence unknown")
        return f"{self.name} {self.title}, by {self.creator} ({licence})"


class Archive:
    """The files of a library: an ``.sh3f`` archive, or the folder with its unpacked content.

    Args:
        path: the archive or the folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._zip: zipfile.ZipFile | None = None
        if path.is_dir():
            self._names = {
                str(file.relative_to(path).as_posix()).lower(): str(file.relative_to(path))
                for file in path.rglob("*")
                if file.is_file()
            }
            return
        try:
            self._zip = BoundedZip(path)
        except (OSError, zipfile.BadZipFile) as error:
            raise SceneError(
                f"{path}: is no furniture library ({error}); install or copy it again"
            ) from error
        self._names = {name.lower(): name for name in self._zip.namelist() if not name.endswith("/")}

    def __contains__(self, name: str) -> bool:
        return name.lower() in self._names

    def read(self, name: str) -> bytes:
        """Read a file; names are not case-sensitive, as the libraries assume."""
        try:
            found = self._names[name.lower()]
            if self._zip is None:
                with open_regular(self.path / found, MAX_MODEL_BYTES) as file:
                    return file.read()
            if self._zip.getinfo(found).file_size > MAX_MODEL_BYTES:
                raise OSError(f"it has more than {MAX_MODEL_BYTES} bytes")
            return self._zip.read(found)
        except (OSError, KeyError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
            raise SceneError(f"{self.path}: cannot give {name!r} ({error}); install it again") from error

    def folder(self, name: str) -> list[str]:
        """List the names of the files in a folder, in lower case."""
        prefix = f"{name.lower().rstrip('/')}/"
        rest = (entry[len(prefix) :] for entry in self._names if entry.startswith(prefix))
        return sorted(entry for entry in rest if "/" not in entry)


def furniture_folder() -> Path | None:
    """The folder of the furniture libraries: ``$SH3D_FURNITURE``, else Debian's, else None."""
    named = os.environ.get("SH3D_FURNITURE")
    if named:
        return Path(named)
    return DEBIAN_FOLDER if DEBIAN_FOLDER.is_dir() else None


def _properties(text: str) -> dict[str, str]:
    r"""Java properties, one per line; ``\uXXXX`` as the character.

    >>> _properties("# comment\nname#1=Caf\\u00e9 table\n")
    {'name#1': 'Café table'}
    """
    found = re.findall(r"^\s*([\w#]+)\s*=[ \t]*(.*?)\s*$", text, flags=re.MULTILINE)
    return {
        key: re.sub(r"\\u([0-9a-fA-F]{4})", lambda match: chr(int(match[1], 16)), value)
        for key, value in found
    }


def _models(collection: str, properties: Mapping[str, str]) -> Iterator[Model]:
    for key in properties:
        if not key.startswith("model#"):
            continue
        number = key.partition("#")[2]

        def value(field: str, default: str = "0", number: str = number) -> str:
            return properties.get(f"{field}#{number}") or default

        try:
            rotation = value("modelRotation", "")
            height = value("height")
            yield Model(
                name=f"{collection}#{number}",
                title=value("name", collection),
                creator=value("creator", "unknown"),
                size=(float(value("width")) / 100, float(height) / 100, float(value("depth")) / 100),
                elevation=float(value("elevation")) / 100,
                top=float(value("dropOnTopElevation", height)) / 100,
                file=properties[key].lstrip("/"),
                rotation=np.array([float(v) for v in rotation.split()]).reshape(3, 3) if rotation else None,
            )
        except ValueError as error:
            raise SceneError(
                f"furniture {collection}#{number}: {error}; install the library again"
            ) from error


class Catalogue(Mapping[str, Model]):
    """Models by name.

    Args:
        models: all of them.
        archives: the libraries with their files by collection; empty if only sizes are known.
        source: name of the catalogue in errors.
    """

    def __init__(
        self,
        models: Mapping[str, Model],
        archives: Mapping[str, Archive] | None = None,
        source: str = "catalogue",
    ) -> None:
        self._models = dict(models)
        self.archives = dict(archives or {})
        self.source = source

    def __getitem__(self, name: str) -> Model:
        # A mapping's own error is a KeyError; ``in`` and ``get`` count on it.
        return self._models[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._models)

    def __len__(self) -> int:
        return len(self._models)

    def __repr__(self) -> str:
        return f"Catalogue({self.source}: {len(self)} models)"

    @classmethod
    def open(cls, folder: str | os.PathLike[str] | None = None) -> Catalogue:
        """Open the furniture libraries of a folder, by default :func:`furniture_folder`.

        Raises:
            SceneError: there is no furniture, or a library is damaged.
        """
        found = furniture_folder() if folder is None else Path(folder)
        paths = {}
        if found is not None and found.is_dir():
            for path in sorted(found.iterdir()):
                if path.suffix == ".sh3f" or (path / _PROPERTIES).is_file():
                    paths[path.stem if path.suffix == ".sh3f" else path.name] = path
        if not paths:
            raise SceneError(
                f"no furniture libraries (*.sh3f) in {found or DEBIAN_FOLDER}; install Debian's package"
                f" sweethome3d-furniture, or name the folder that has them by SH3D_FURNITURE"
            )
        models, archives = {}, {}
        for collection, path in paths.items():
            archives[collection] = Archive(path)
            properties = _properties(archives[collection].read(_PROPERTIES).decode("latin-1"))
            models.update({model.name: model for model in _models(collection, properties)})
        return cls(models, archives, str(found))

    @classmethod
    def bundled(cls) -> Catalogue:
        """Sizes, titles and authors of the models that layouts use, without their files.

        >>> Catalogue.bundled()["BlendSwap-CC-BY#3"].title
        'Bath'
        """
        return _bundled()

    def archive(self, model: Model) -> Archive:
        """Find the library that holds a model's file.

        Raises:
            SceneError: only the model's size is known.
        """
        if not model.file or model.collection not in self.archives:
            raise SceneError(f"{self.source} has only the size of {model.name}; use Catalogue.open()")
        return self.archives[model.collection]


@cache
def _bundled() -> Catalogue:
    table = yaml.safe_load((Path(__file__).parent / "furniture.yaml").read_text(encoding="utf-8"))
    models = {}
    for name, (title, creator, *lengths) in table.items():
        # Centimetres, as in the libraries: the same division gives the same numbers.
        width, height, depth, elevation, top = (float(length) / 100 for length in lengths)
        models[name] = Model(name, title, creator, (width, height, depth), elevation, top)
    return Catalogue(models, source="the package's table of furniture")
