"""Changes of a room's pictures that leave its states as they are: light, camera, furniture, noise.

A varied rendering has the graph and the poses of the room itself, so that an agent of the room can be trained
and evaluated in it. The exposure is that of the unvaried room: dimmer lamps make darker pictures.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from vusfa.errors import SceneError
from vusfa.limits import MAX_STATES
from vusfa.reading import read_text
from vusfa.scenes.pictures import decode, to_jpeg
from vusfa.sources.blur import motion_blur
from vusfa.sources.render.catalogue import Catalogue
from vusfa.sources.render.grid import Poses, poses
from vusfa.sources.render.outline import overlaps
from vusfa.sources.render.plan import Furniture, Plan
from vusfa.sources.render.plan_file import read_entry
from vusfa.sources.render.textures import random_stream

__all__ = ["PLAIN", "VARIATIONS", "Variation", "load_variation", "vary_picture", "vary_plan", "vary_poses"]

_SEEDS = 2**32 // MAX_STATES
_DIRECTIONS = 16


@dataclass(frozen=True)
class Variation:
    """A change of a room's pictures; the defaults change nothing.

    Args:
        noise_seed: random seed of the light paths, and of the draws for ``offset``, ``turn`` and ``moved``.
        lamps: factor on the radiance of the lamps.
        warmth: share by which the lamps' red grows and their blue shrinks.
        offset: distance in metres of the camera from its place, in a direction drawn for each state.
        turn: angle in degrees of the camera from its heading, to a side drawn for each state.
        fov: factor on the field of view.
        moved: distance in metres by which a chair stands elsewhere; without a chair that can move so far, the
            smallest piece of furniture that can.
        jpeg: quality, 1 to 95, of a JPEG file that every picture passes through; None for no such file.
        blur: length of horizontal motion blur as a share of the picture's width.

    >>> Variation(lamps=1.3, turn=5.0).changes()
    {'lamps': 1.3, 'turn': 5.0}
    """

    noise_seed: int = 0
    lamps: float = 1.0
    warmth: float = 0.0
    offset: float = 0.0
    turn: float = 0.0
    fov: float = 1.0
    moved: float = 0.0
    jpeg: int | None = None
    blur: float = 0.0

    def changes(self) -> dict[str, float | int | None]:
        """The fields that are not at their defaults."""
        entries = {field.name: (getattr(self, field.name), field.default) for field in fields(self)}
        return {name: value for name, (value, default) in entries.items() if value != default}

    def seed(self, state: int) -> int:
        """Random seed of a state's light paths.

        >>> Variation().seed(7), Variation(noise_seed=2).seed(7)
        (7, 200007)
        """
        return state + MAX_STATES * self.noise_seed


#: No change.
PLAIN = Variation()

#: The changes of the robustness set by name; then those for training, with other draws and sizes, and two
#: for choosing settings, so that nothing is chosen on the robustness set itself.
VARIATIONS = {
    "noise": Variation(noise_seed=1),
    "brighter": Variation(lamps=1.3),
    "dimmer": Variation(lamps=0.7, warmth=0.15),
    "camera": Variation(offset=0.1, turn=5.0),
    "fov": Variation(fov=1.05),
    "moved": Variation(moved=0.3),
    "jpeg": Variation(jpeg=60),
    "blur": Variation(blur=0.03),
    "all": Variation(1, 0.7, 0.15, 0.1, 5.0, 1.05, 0.3, 60, 0.03),
    "train1": Variation(2, 1.2, offset=0.06, turn=4.0, fov=0.95, moved=0.2),
    "train2": Variation(3, 0.8, 0.1, offset=0.12, turn=7.0, fov=1.08, moved=0.4),
    "train3": Variation(12, 0.75, 0.1, offset=0.1, turn=3.0, fov=1.03, moved=0.35),
    "train4": Variation(13, offset=0.08, turn=5.5, fov=1.1, moved=0.15),
    "train5": Variation(14, 1.35, offset=0.12, turn=2.0, fov=0.97),
    "train6": Variation(15, 0.65, 0.2, offset=0.05, turn=8.0),
    "validate1": Variation(4, offset=0.09, turn=6.0),
    "validate2": Variation(5, 0.75, 0.2, 0.08, 6.0, 1.07, 0.25, 55, 0.035),
}


def _faults(variation: Variation) -> Iterator[str]:
    if not 0 <= variation.noise_seed < _SEEDS:
        yield f"noise_seed: {variation.noise_seed} must lie in 0..{_SEEDS - 1}"
    if not 0 < variation.lamps <= 100:
        yield f"lamps: {variation.lamps} must be above 0 and at most 100"
    if not -1 <= variation.warmth <= 1:
        yield f"warmth: {variation.warmth} must lie in -1..1"
    if not 0 <= variation.offset <= 100:
        yield f"offset: {variation.offset} must be 0 or more metres, and at most the plan's grid.radius"
    if not 0 <= variation.turn <= 180:
        yield f"turn: {variation.turn} must lie in 0..180"
    if not 0 < variation.fov <= 10:
        yield f"fov: {variation.fov} must be a factor above 0 and at most 10"
    if not 0 <= variation.moved <= 100:
        yield f"moved: {variation.moved} must be 0 or more metres, and at most 100"
    if variation.jpeg is not None and not 1 <= variation.jpeg <= 95:
        yield f"jpeg: {variation.jpeg} must lie in 1..95"
    if not 0 <= variation.blur <= 1:
        yield f"blur: {variation.blur} must lie in 0..1"


def load_variation(name: str | os.PathLike[str]) -> Variation:
    """A variation of :data:`VARIATIONS` by its name, or from a YAML file that holds its fields.

    Raises:
        SceneError: there is no such name or file, or the file has faults; the message lists all of them.

    >>> load_variation("brighter")
    Variation(noise_seed=0, lamps=1.3, ...)
    >>> load_variation("darker")
    Traceback (most recent call last):
    ...
    vusfa.errors.SceneError: darker: ... give the YAML file of a variation, or one of noise, brighter, ...
    """
    if str(name) in VARIATIONS and not Path(name).is_file():
        return VARIATIONS[str(name)]
    hint = f"give the YAML file of a variation, or one of {', '.join(VARIATIONS)}"
    return read_entry(Variation, read_text(name, SceneError, hint), str(name), lambda it: list(_faults(it)))


def vary_plan(plan: Plan, variation: Variation, catalogue: Catalogue) -> Plan:
    """The plan of a varied room: other lamps, another field of view, a moved piece of furniture.

    Args:
        plan: the room, with all sizes (:meth:`Plan.completed`).
        variation: the change.
        catalogue: with the models of the plan, whose titles tell chairs.

    Raises:
        SceneError: the camera would leave the free space, or no piece of furniture can move so far.
    """
    if variation.offset > plan.grid.radius:
        raise SceneError(
            f"variation of plan {plan.name!r}: offset: {variation.offset} must be at most the plan's"
            f" grid.radius, {plan.grid.radius}"
        )
    if not 1 <= plan.camera.fov * variation.fov <= 170:
        raise SceneError(
            f"variation of plan {plan.name!r}: fov: {variation.fov} makes camera.fov"
            f" {plan.camera.fov * variation.fov:g}, which must lie in 1..170"
        )
    tint = np.array([1 + variation.warmth, 1.0, 1 - variation.warmth]) * variation.lamps
    if (tint != 1).any():
        lights = [
            replace(light, radiance=tuple((np.array(light.radiance) * tint).tolist()))
            for light in plan.lights
        ]
        plan = replace(plan, lights=tuple(lights))
    if variation.fov != 1:
        plan = replace(plan, camera=replace(plan.camera, fov=plan.camera.fov * variation.fov))
    return _with_moved_piece(plan, variation, catalogue) if variation.moved else plan


def _with_moved_piece(plan: Plan, variation: Variation, catalogue: Catalogue) -> Plan:
    graph = poses(plan).graph
    turns = random_stream(variation.noise_seed).permutation(_DIRECTIONS) * (2 * math.pi / _DIRECTIONS)

    def order(k: int) -> tuple[bool, float]:
        size = plan.furniture[k].size
        assert size is not None
        return "chair" not in catalogue[plan.furniture[k].model].title.lower(), size[0] * size[2]

    for k in sorted(_free_standing(plan), key=order):
        item = plan.furniture[k]
        for angle in turns:
            x, z = (
                at + variation.moved * f(angle) for at, f in zip(item.at, (math.sin, math.cos), strict=True)
            )
            pieces = list(plan.furniture)
            pieces[k] = replace(item, at=(round(x, 4), round(z, 4)))
            varied = replace(plan, furniture=tuple(pieces))
            if _fits(varied, k) and np.array_equal(poses(varied).graph, graph):
                return varied
    raise SceneError(
        f"variation of plan {plan.name!r}: moved: no piece of furniture can stand {variation.moved} m from"
        f" its place without closing or opening a way; take a shorter distance"
    )


def _free_standing(plan: Plan) -> list[int]:
    """Indices of furniture that stands on the floor and carries nothing."""

    def carries(carrier: Furniture) -> bool:
        x0, z0, x1, z1 = carrier.rect
        return any(
            item.role == "top" and x0 <= item.at[0] <= x1 and z0 <= item.at[1] <= z1
            for item in plan.furniture
        )

    standing = [k for k, item in enumerate(plan.furniture) if item.role == "floor" and item.blocks]
    return [k for k in standing if not carries(plan.furniture[k])]


def _fits(plan: Plan, k: int) -> bool:
    """Whether a piece of furniture is inside the room and overlaps nothing that stands there."""
    rect = plan.furniture[k].rect
    if rect[0] < 0 or rect[1] < 0 or rect[2] > plan.size[0] or rect[3] > plan.size[1]:
        return False
    others = [item.rect for j, item in enumerate(plan.furniture) if j != k and item.blocks]
    return not any(overlaps(rect, other) for other in others + [solid.rect for solid in plan.solids])


def vary_poses(room: Poses, variation: Variation) -> tuple[np.ndarray, np.ndarray]:
    """Where the camera stands for each state, (N, 2) metres, and its headings (N,) in degrees."""
    rng = random_stream(variation.noise_seed)
    angle = rng.random_sample(room.num_states) * 2 * np.pi
    side = np.where(rng.random_sample(room.num_states) < 0.5, -1.0, 1.0)
    away = variation.offset * np.stack([np.sin(angle), np.cos(angle)], axis=1)
    return room.location + away, room.rotation + variation.turn * side


def vary_picture(picture: np.ndarray, variation: Variation) -> np.ndarray:
    """A picture (H, W, 3) uint8 with motion blur and the traces of a JPEG file.

    >>> stripe = np.zeros((1, 10, 3), np.uint8)
    >>> stripe[:, 4] = 240
    >>> vary_picture(stripe, Variation(blur=0.4))[0, :, 0].tolist()
    [0, 0, 60, 60, 60, 60, 0, 0, 0, 0]
    """
    length = round(variation.blur * picture.shape[1])
    if length > 1:
        picture = (motion_blur(picture, length, length - 1 - length // 2) + 0.5).astype(np.uint8)
    return picture if variation.jpeg is None else decode(to_jpeg(picture, variation.jpeg))
