"""Furniture models: OBJ files of the libraries as placed triangles with one plain material each.

Needs trimesh. The libraries' files have faults that are mended here: textures that lie in the model's own
folder whatever path they are asked for by, texture coordinates that are not numbers or absurdly large,
materials that name no texture though there is one. Glass (less than half opaque) is left out.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from PIL import Image

from vusfa.errors import SceneError
from vusfa.sources.render.catalogue import Archive, Catalogue, Model

__all__ = ["Part", "load_parts", "material_library", "place"]

_PICTURE = re.compile(r"\.(jpe?g|png|gif|bmp)$", re.IGNORECASE)
_LARGEST_TEXTURE = 512
_ABSURD = 1e4
_GLASS = 0.5


@dataclass(frozen=True, eq=False)
class Part:
    """Triangles of one material, in the model's own frame, upright.

    Args:
        vertices: (n, 3).
        faces: (m, 3) indices.
        uv: (n, 2) texture coordinates, or None.
        color: (3,) linear red, green, blue, where there is no texture.
        texture: (h, w, 3) linear, or None.
        opacity: (h, w, 1), where the texture has holes.
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | None
    color: np.ndarray
    texture: np.ndarray | None = None
    opacity: np.ndarray | None = None


@dataclass
class Material:
    """An entry of a material library: diffuse color (sRGB), opacity, and the texture's file."""

    color: list[float] | None = None
    opacity: float = 1.0
    texture: str | None = None


def material_library(archive: Archive, file: str) -> dict[str, Material]:
    """The materials that an OBJ file refers to, by name; textures are files that exist."""
    folder = str(PurePosixPath(file).parent)
    files = archive.folder(folder)
    pictures = [name for name in files if _PICTURE.search(name)]
    found: dict[str, Material] = {}
    text = archive.read(file).decode("utf-8", "ignore")
    for library in re.findall(r"^mtllib (.*)$", text, flags=re.MULTILINE):
        name = library.strip().lower()
        if name not in files:
            continue
        current = Material()
        for line in archive.read(f"{folder}/{name}").decode("utf-8", "ignore").splitlines():
            key, _, value = line.strip().partition(" ")
            if key == "newmtl":
                current = found[value.strip()] = Material()
            elif key == "Kd":
                current.color = [float(number) for number in value.split()[:3]]
            elif key == "d":
                current.opacity = float(value.split()[-1])
            elif key == "map_Kd":
                base = re.split(r"[\\/]", value.strip())[-1].lower()
                only = pictures[0] if len(pictures) == 1 else None
                texture = base if base in files else only
                current.texture = f"{folder}/{texture}" if texture else None
    return found


class _Files(Mapping[str, bytes]):
    """The files of an archive as an OBJ file in some folder there asks for them."""

    def __init__(self, archive: Archive, folder: str) -> None:
        self._archive = archive
        self._folder = folder

    def __getitem__(self, name: str) -> bytes:
        path = f"{self._folder}/{name.strip()}"
        if path not in self._archive:
            raise KeyError(name)
        return self._archive.read(path)

    def __iter__(self) -> Iterator[str]:
        return iter(self._archive.folder(self._folder))

    def __len__(self) -> int:
        return len(self._archive.folder(self._folder))


def _texture(image: Image.Image) -> tuple[np.ndarray, np.ndarray | None]:
    """Linear colors (h, w, 3) and, where the picture has holes, the opacity (h, w, 1)."""
    pixels = np.asarray(image.convert("RGBA"), np.float32) / 255
    step = max(1, max(pixels.shape[:2]) // _LARGEST_TEXTURE)
    pixels = pixels[::step, ::step]
    holes = pixels[..., 3].min() < 0.5
    return np.clip(pixels[..., :3] ** 2.2, 0.005, 0.9), pixels[..., 3:] if holes else None


def _look(visual: Any, name: str, library: dict[str, Material], archive: Archive) -> tuple[Material, Any]:
    material = getattr(visual, "material", None)
    entry = library.get(getattr(material, "name", "") or "") or library.get(name) or Material()
    image = getattr(material, "image", None)
    if image is None and entry.texture and getattr(visual, "uv", None) is not None:
        image = Image.open(io.BytesIO(archive.read(entry.texture)))
    return entry, image


def load_parts(catalogue: Catalogue, model: Model) -> list[Part]:
    """Read a model.

    Raises:
        SceneError: its file is missing or cannot be read.
    """
    archive = catalogue.archive(model)
    folder = str(PurePosixPath(model.file).parent)
    try:
        import trimesh
    except ModuleNotFoundError as error:
        raise SceneError("rendering needs some more packages: pip install 'vusfa[render]'") from error
    try:
        scene: Any = trimesh.load(
            io.BytesIO(archive.read(model.file)),
            file_type="obj",
            resolver=_Files(archive, folder),
            process=False,
            split_object=False,
            group_material=True,
        )
    except SceneError:
        raise
    except Exception as error:  # a parser may raise anything for a damaged file
        raise SceneError(f"{model.name}: {model.file} is no sound OBJ file ({error})") from error
    geometry = scene.geometry.items() if hasattr(scene, "geometry") else [("", scene)]
    library = material_library(archive, model.file)
    return list(_parts(geometry, library, archive, model))


def _parts(geometry: Any, library: dict[str, Material], archive: Archive, model: Model) -> Iterator[Part]:
    for name, mesh in geometry:
        if not len(getattr(mesh, "faces", ())):
            continue
        vertices = np.asarray(mesh.vertices)
        if model.rotation is not None:
            vertices = vertices @ model.rotation.T
        entry, image = _look(mesh.visual, name, library, archive)
        uv = getattr(mesh.visual, "uv", None)
        if uv is not None:
            uv = np.asarray(uv) if len(uv) == len(vertices) else None
        if uv is not None:
            uv = np.where(np.isfinite(uv) & (np.abs(uv) < _ABSURD), uv, 0)
        diffuse = getattr(getattr(mesh.visual, "material", None), "diffuse", [180, 180, 180, 255])
        color = np.array(entry.color) if entry.color else np.array(diffuse, float)[:3] / 255
        texture, opacity = _texture(image) if image is not None else (None, None)
        if entry.opacity < _GLASS:  # invisible, but part of the model's extent
            yield Part(vertices, np.empty((0, 3), np.uint32), None, color)
            continue
        yield Part(
            vertices,
            np.asarray(mesh.faces, np.uint32),
            uv,
            np.clip(color**2.2 * 0.9, 0.01, 0.85),
            texture,
            opacity,
        )


def place(
    parts: list[Part],
    size: tuple[float, float, float],
    at: tuple[float, float],
    elevation: float,
    facing: float,
) -> list[np.ndarray]:
    """Place a model: vertices (n, 3) of each part in the renderer's frame, x to the left, y up, z forward.

    Args:
        parts: of one model.
        size: (width, height, depth) that the whole of it is stretched to.
        at: plan's (x, z) of its middle.
        elevation: of its underside.
        facing: degrees, where its front (+z of its own frame) looks.

    >>> box = Part(np.array([[0.0, 0, 0], [2.0, 2, 2]]), np.empty((0, 3)), None, np.zeros(3))
    >>> place([box], (1.0, 1.0, 1.0), (5.0, 5.0), 0.5, 0.0)[0].tolist()
    [[-5.5, 0.5, 4.5], [-4.5, 1.5, 5.5]]
    """
    low = np.min([part.vertices.min(axis=0) for part in parts], axis=0)
    high = np.max([part.vertices.max(axis=0) for part in parts], axis=0)
    scale = np.array(size) / np.maximum(high - low, 1e-6)
    middle = (low + high) / 2
    cos, sin = math.cos(-math.radians(facing)), math.sin(-math.radians(facing))
    placed = []
    for part in parts:
        x, y, z = ((part.vertices - [middle[0], low[1], middle[2]]) * scale).T
        placed.append(
            np.stack([cos * x + sin * z - at[0], y + elevation, -sin * x + cos * z + at[1]], axis=1)
        )
    return placed
