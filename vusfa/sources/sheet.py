"""Overview of a scene as one picture: views from all over the room beside the map of its poses.

Needs matplotlib: ``pip install 'vusfa[scenes]'``.
"""

from __future__ import annotations

import io
import os
import textwrap
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from vusfa.errors import SceneError
from vusfa.scenes.poses import places, spread_poses, step_length
from vusfa.scenes.provenance import Provenance
from vusfa.scenes.scene import Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_floor", "draw_sheet", "save_sheet"]

_FLOOR, _EDGE, _POSE, _ISLAND, _SHOWN = "#dde0e6", "#bcc1cb", "#7f93b2", "#d6452c", "#1f61b2"
_COLUMNS = 4


def draw_sheet(scene: Scene, count: int = 12) -> bytes:
    """Draw pictures from all over the room beside the map of its floor.

    On the map +Z is up; every pose is a dart that points where it looks, poses on islands are red, and the
    numbers say where the pictures were taken. Without pictures there is only the map. The licences and
    credits of the scene are written below, for they belong to its pictures.

    Args:
        scene: the scene.
        count: pictures to show.

    Returns:
        a PNG file.

    Raises:
        SceneError: matplotlib is not installed.

    >>> draw_sheet(Scene.bundled("bathroom"), count=2)[:4]
    b'\\x89PNG'
    """
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError as error:
        raise SceneError("drawing needs matplotlib: pip install 'vusfa[scenes]'") from error
    shown = _choose(scene, count) if scene.has_pictures else []
    rows = -(-len(shown) // _COLUMNS)
    figure = Figure(figsize=(16, 0.6 + max(2 * rows, 6)) if shown else (8, 8), dpi=100, layout="constrained")
    figure.suptitle(_title(scene), fontsize=14)
    if shown:
        halves: Any = figure.subfigures(1, 2, width_ratios=[1.25, 1])
        sheet, floor = halves
        _draw_pictures(sheet.subplots(rows, _COLUMNS, squeeze=False).ravel(), scene, shown)
        draw_floor(floor.subplots(), scene, shown)
    else:
        draw_floor(figure.subplots(), scene, shown)
    figure.supxlabel(_footer(scene), fontsize=7, color="#555555")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def save_sheet(scene: Scene, path: str | os.PathLike[str], count: int = 12) -> Path:
    """Write :func:`draw_sheet` to a file, atomically.

    Raises:
        SceneError: the file cannot be written, or matplotlib is not installed.
    """
    path = Path(path)
    png = draw_sheet(scene, count)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.part")
    try:
        temporary.write_bytes(png)
        temporary.replace(path)
    except OSError as error:
        raise SceneError(f"{path}: cannot be written ({error}); check folder, rights and space") from error
    finally:
        temporary.unlink(missing_ok=True)
    return path


def _choose(scene: Scene, count: int) -> list[int]:
    """Poses all over the room; where there are enough, those that can move ahead."""
    candidates = torch.arange(scene.num_states)
    if "MoveForward" in scene.actions:
        free = (scene.graph[:, scene.actions.index("MoveForward")] >= 0).nonzero().squeeze(1)
        candidates = free if len(free) >= count else candidates
    return candidates[spread_poses(scene.location[candidates], scene.rotation[candidates], count)].tolist()


def _title(scene: Scene) -> str:
    cells = len(places(scene.location))
    return (
        f"{scene.name}: {scene.num_states} states, {cells} places {step_length(scene.location):.2g} m apart"
    )


def _footer(scene: Scene) -> str:
    origin = Provenance.of(scene.attributes)
    parts = [*origin.licences, *origin.credits]
    return textwrap.shorten("; ".join(parts), 400, placeholder=" ... (vusfa scenes show prints all)")


def _draw_pictures(axes: np.ndarray, scene: Scene, shown: Sequence[int]) -> None:
    pictures = scene.pictures(list(shown)).numpy()
    for axis in axes:
        axis.axis("off")
    for number, (axis, state, picture) in enumerate(zip(axes, shown, pictures, strict=False), 1):
        axis.imshow(picture)
        axis.set_title(f"{number}: state {state}", fontsize=9)


def draw_floor(axis: Axes, scene: Scene, shown: Sequence[int]) -> None:
    """Draw a scene's floor from above, in metres, with a dart for every pose and numbers at those shown."""
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Rectangle

    cell = step_length(scene.location)
    x, z = scene.location.double().numpy().T
    squares = [
        Rectangle((a - cell / 2, b - cell / 2), cell, cell) for a, b in places(scene.location).tolist()
    ]
    axis.add_collection(PatchCollection(squares, facecolor=_FLOOR, edgecolor=_EDGE, linewidth=0.8))
    angle = np.radians(scene.rotation.double().numpy())
    ahead = np.stack([np.sin(angle), np.cos(angle)]) * cell
    colors = np.full(scene.num_states, _POSE, dtype=object)
    colors[[state for island in scene.islands for state in island]] = _ISLAND
    colors[list(shown)] = _SHOWN
    darts: dict[str, Any] = {
        "angles": "xy",
        "scale_units": "xy",
        "scale": 1,
        "units": "xy",
        "width": cell / 30,
    }
    # From near the middle outwards, so that the headings of one place do not cover each other.
    tail_x, tail_z = x + 0.12 * ahead[0], z + 0.12 * ahead[1]
    axis.quiver(tail_x, tail_z, *(0.26 * ahead), color=list(colors), headwidth=4, headlength=4, **darts)
    axis.set_xlim(x.min() - cell, x.max() + cell)
    axis.set_ylim(z.min() - cell, z.max() + cell)
    for number, state in enumerate(shown, 1):
        at = (x[state] + 0.3 * ahead[0, state], z[state] + 0.3 * ahead[1, state])
        box = {"boxstyle": "circle,pad=0.15", "facecolor": _SHOWN, "edgecolor": "white", "linewidth": 0.6}
        axis.text(*at, str(number), fontsize=7, color="white", ha="center", va="center", bbox=box)
    axis.set_aspect("equal")
    axis.set_xlabel("x, metres")
    axis.set_ylabel("z, metres")
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)
