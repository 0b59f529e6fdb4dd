"""Conversion of a folder of photographs to a scene.

The folder's poses or edges say what the states are and where the actions lead (:mod:`vusfa.sources.grid`,
:mod:`vusfa.sources.photo_tables`). The pictures are rotated as their cameras recorded, cropped around their
center, resized, and kept as JPEG files or raw.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageOps

from vusfa.errors import SceneError
from vusfa.limits import MAX_PHOTO_PIXELS
from vusfa.reading import open_regular, read_npy
from vusfa.scenes.graph import default_actions
from vusfa.scenes.pictures import open_image, to_jpeg
from vusfa.scenes.validation import raise_faults
from vusfa.sources.capture import PoseGraph
from vusfa.sources.grid import put_on_grid
from vusfa.sources.photo_tables import edge_states, read_edges, read_poses

__all__ = ["Layout", "fit_picture", "lay_out", "read_features", "read_photos"]

_ENDINGS = (".jpg", ".jpeg", ".png")


@dataclass(frozen=True)
class Layout(PoseGraph):
    """What the states are, and where the actions lead.

    Attributes:
        files: N pictures, relative to their folder, in the order of the states.
        found: description of what was inferred, "a grid of 0.5 m, headings 90 degrees apart".
        left_out: pictures of the folder that are no state.
    """

    files: tuple[str, ...]
    found: str
    left_out: tuple[str, ...]


def lay_out(
    folder: str | os.PathLike[str],
    poses: str | os.PathLike[str] | None = None,
    edges: str | os.PathLike[str] | None = None,
    *,
    step: float | None = None,
    turn: int | None = None,
) -> Layout:
    """Read a folder's tables; pictures are only looked for.

    Args:
        folder: where the photographs are.
        poses: CSV of poses; by default ``poses.csv`` in the folder, where there is one.
        edges: CSV of moves; by default ``edges.csv`` in the folder, where there is one. With it the poses, if
            there are any, are kept as they are; without it the moves are those of a grid.
        step: distance of neighbouring places in metres; inferred when not given.
        turn: degrees between neighbouring headings; inferred when not given.

    Raises:
        SceneError: no folder, neither poses nor edges, faults in them, or pictures that are missing.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise SceneError(f"{folder}: there is no such folder; check the path")
    poses = _table_path(folder, poses, "poses.csv")
    edges = _table_path(folder, edges, "edges.csv")
    if edges is not None:
        if step is not None or turn is not None:
            raise SceneError(f"{edges}: says where the actions lead; leave out step and turn")
        return _by_edges(folder, edges, poses)
    if poses is not None:
        return _by_poses(folder, poses, step, turn)
    raise SceneError(
        f"{folder}: has neither poses.csv (file,x,z,heading) nor edges.csv (state,action,next); write one of"
        f" them, or say where it is"
    )


def _table_path(folder: Path, path: str | os.PathLike[str] | None, name: str) -> Path | None:
    if path is not None:
        return Path(path)
    return folder / name if (folder / name).is_file() else None


def _by_poses(folder: Path, poses: Path, step: float | None, turn: int | None) -> Layout:
    table = read_poses(poses)
    _require_pictures(folder, poses, table.files, table.labels)
    grid = put_on_grid(table.location, table.rotation, table.labels, step=step, turn=turn, source=poses)
    return Layout(
        grid.graph,
        grid.location,
        grid.rotation,
        default_actions(4),
        table.files,
        f"a grid of {grid.step:.3g} m, headings {grid.turn} degrees apart",
        _left_out(folder, table.files),
    )


def _by_edges(folder: Path, edges: Path, poses: Path | None) -> Layout:
    if poses is None:
        files = labels = edge_states(edges)
        location, rotation = np.zeros((len(files), 2)), np.zeros(len(files))
    else:
        table = read_poses(poses)
        files, labels, location, rotation = table.files, tuple(table.labels), table.location, table.rotation
    _require_pictures(folder, poses or edges, files, labels)
    graph, actions = read_edges(edges, files)
    found = f"moves as in {edges.name}"
    return Layout(graph, location, rotation, actions, tuple(files), found, _left_out(folder, files))


def _require_pictures(folder: Path, table: Path, files: Sequence[str], labels: Sequence[str]) -> None:
    faults = [
        f"{label}: there is no such picture in {folder}; correct the name, or take it out"
        for file, label in zip(files, labels, strict=True)
        if not (folder / file).is_file()
    ]
    raise_faults(table, faults)


def _left_out(folder: Path, files: Sequence[str]) -> tuple[str, ...]:
    """Pictures in the folder, and in the folders that the files are in, which are none of the files."""
    used = {(folder / file).resolve() for file in files}
    inside = {
        path for place in {path.parent for path in used} | {folder.resolve()} for path in place.iterdir()
    }
    unused = {path for path in inside - used if path.suffix.lower() in _ENDINGS}
    return tuple(sorted(os.path.relpath(path, folder.resolve()) for path in unused))


def fit_picture(path: str | os.PathLike[str], width: int, height: int) -> np.ndarray:
    """Read a photograph upright, crop it around its middle to the requested shape, and scale it down.

    Returns:
        (height, width, 3) uint8.

    Raises:
        OSError: it is no picture that can be read.
    """
    with open_regular(path) as file, open_image(file) as image:
        # JPEG files of cameras are large: they can be decoded at half their size, a quarter, ...
        image.draft("RGB", (4 * max(width, height),) * 2)
        if image.width * image.height > MAX_PHOTO_PIXELS:
            raise OSError(f"{image.width} x {image.height} pixels; at most {MAX_PHOTO_PIXELS} are decoded")
        upright = ImageOps.exif_transpose(image).convert("RGB")
    return np.asarray(ImageOps.fit(upright, (width, height), Image.Resampling.LANCZOS))


def read_photos(
    folder: str | os.PathLike[str],
    files: Sequence[str],
    width: int,
    height: int,
    *,
    raw: bool = False,
    advance: Callable[[], None] = lambda: None,
) -> np.ndarray | list[bytes]:
    """Read all photographs, cropped and resized.

    Args:
        folder: where they are.
        files: their names.
        width: pixels.
        height: pixels.
        raw: as they are, instead of as JPEG files of quality 92.
        advance: called after every picture.

    Returns:
        (N, height, width, 3) uint8, or N JPEG files.

    Raises:
        SceneError: pictures that cannot be read; every one of them is listed.
    """
    faults = []
    small: list[np.ndarray] = []
    packed: list[bytes] = []
    for file in files:
        path = Path(folder) / file
        try:
            picture = fit_picture(path, width, height)
        except OSError as error:
            faults.append(f"{file}: cannot be read as a picture ({error}); replace it, or take it out")
        else:
            if raw:
                small.append(picture)
            else:
                packed.append(to_jpeg(picture))
        advance()
    raise_faults(folder, faults)
    return np.stack(small) if raw else packed


def read_features(path: str | os.PathLike[str], num_states: int) -> np.ndarray:
    """Features from a file of ``numpy.save``: (N, F) or (N, C, F), rows in the order of the states.

    Returns:
        (N, C, F) float32.

    Raises:
        SceneError: the file is missing or damaged, or its shape does not fit.
    """
    values = read_npy(path, SceneError, "write it with numpy.save")
    if values.dtype.kind not in "fiu" or values.ndim not in (2, 3):
        raise SceneError(
            f"{path}: holds {values.dtype} of shape {values.shape}; write one array of numbers, (N, F) or"
            f" (N, C, F)"
        )
    if len(values) != num_states:
        raise SceneError(
            f"{path}: has {len(values)} rows, but there are {num_states} states; write one for each, in the"
            f" order of the table"
        )
    return np.asarray(values if values.ndim == 3 else values[:, None], dtype=np.float32)
