"""Graph of poses on a grid: the pose that each action leads to.

Measured poses are inaccurate. The grid that fits most of them is found first (step, turn, where it lies,
how it is turned); then every pose takes its nearest grid point, and one too far from any is reported. In
the frame of a scene +Z is heading 0 and +X is heading 90.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vusfa.errors import SceneError
from vusfa.scenes.validation import raise_faults

__all__ = ["GridPoses", "fit_lattice", "fit_offset", "fit_step", "fit_turn", "put_on_grid"]

_TURNS = (360, 180, 90, 45)
_OFF_PLACE = 0.25  # of a step
_OFF_HEADING = 10.0  # degrees
_ALIGNED = 2.0  # degrees: headings so little turned count as not turned
_MOST = 0.9  # share of the poses that a turn must explain


@dataclass(frozen=True)
class GridPoses:
    """Poses on a grid and the moves between them.

    Attributes:
        graph: (N, 4) int64: MoveForward, RotateRight, RotateLeft, MoveBackward; -1 without such a pose.
        location: (N, 2) float64 metres, of the grid points.
        rotation: (N,) float64 degrees, of the grid's headings, 0 to 360.
        step: distance of neighbouring grid points, metres.
        turn: degrees between neighbouring headings; 360 when all poses look the same way.
    """

    graph: np.ndarray
    location: np.ndarray
    rotation: np.ndarray
    step: float
    turn: int


def fit_offset(values: np.ndarray, period: float) -> float:
    """Where a lattice of some period lies that most values are near: a number in [-period / 2, period / 2].

    The circular mean; then again without the values far from it.

    >>> round(fit_offset(np.array([0.31, 1.29, 5.3]), period=1.0), 3)
    0.3
    """
    kept = values
    offset = 0.0
    for _ in range(2):
        offset = float(np.angle(np.exp(2j * np.pi * kept / period).mean())) * period / (2 * math.pi)
        near = np.abs(_beyond(values - offset, period)) <= _OFF_PLACE * period
        kept = values[near] if near.any() else values
    return offset


def _beyond(values: np.ndarray, period: float) -> np.ndarray:
    """Difference of the values from their nearest multiple of a period."""
    return values - period * np.rint(values / period)


def fit_turn(rotation: np.ndarray) -> int:
    """The widest turn, of 360, 180, 90 and 45 degrees, that explains nine of ten headings (N,), in degrees.

    >>> fit_turn(np.array([1.0, 89.0, 270.5])), fit_turn(np.array([7.0, 7.0]))
    (90, 360)
    """
    for turn in _TURNS:
        beyond = _beyond(rotation - fit_offset(rotation, turn), turn)
        if (np.abs(beyond) <= _OFF_HEADING).mean() >= _MOST:
            return turn
    return _TURNS[-1]


def fit_step(location: np.ndarray, heading: np.ndarray) -> float:
    """Rough estimate of the step of the grid.

    Poses of one heading have different places, so that their nearest neighbours are one step away: the median
    of these distances.

    Args:
        location: (N, 2).
        heading: (N,) integers, the number of each pose's heading.

    Returns:
        the step; 1.0 when no two poses look the same way.
    """
    nearest = [np.empty(0)]
    for one in np.unique(heading):
        alike = location[heading == one]
        # two thousand poses of one heading are enough
        alike = alike[np.lexsort(alike.T)][:2000]
        if len(alike) > 1:
            apart = np.linalg.norm(alike[:, None] - alike[None], axis=-1)
            np.fill_diagonal(apart, np.inf)
            nearest.append(apart.min(1))
    step = float(np.median(np.concatenate(nearest))) if len(nearest) > 1 else 1.0
    return step if step > 0 else 1.0


def fit_lattice(place: np.ndarray, basis: complex, fixed_step: bool = False) -> tuple[complex, complex]:
    """The square lattice that most places are near: ``origin + basis * (a + b i)`` for integers a and b.

    It is fitted to the places near the middle first, then, by least squares, to more and more of them: a
    small error of the step or of the angle adds up over distance, and must be corrected before it amounts to
    a cell.

    Args:
        place: (N,) complex, x + z i.
        basis: a rough one; its length is the step, its angle that of the lattice.
        fixed_step: whether the length is exact.

    Returns:
        origin and basis.
    """
    middle = place[np.abs(place - place.mean()).argmin()]
    away = np.abs(place - middle)
    reach = 3.0
    near = away <= reach * abs(basis)
    along = (place[near] - middle) / basis
    origin = middle + basis * complex(fit_offset(along.real, 1.0), fit_offset(along.imag, 1.0))
    while True:
        near = away <= reach * abs(basis)
        along = (place - origin) / basis
        cell = np.rint(along.real) + 1j * np.rint(along.imag)
        used = near & (np.abs(along - cell) <= _OFF_PLACE)
        if len(np.unique(cell[used])) > 1:
            centered = cell[used] - cell[used].mean()
            slope = (np.conj(centered) * place[used]).sum() / (np.abs(centered) ** 2).sum()
            basis = complex(slope / abs(slope) * abs(basis) if fixed_step else slope)
        if used.any():
            origin = complex((place[used] - basis * cell[used]).mean())
        if near.all():
            return origin, basis
        reach *= 1.5


def _rounded(origin: complex, basis: complex, place: np.ndarray, fixed_step: bool) -> tuple[complex, complex]:
    """Step and angle as round numbers, where that moves no grid point noticeably."""
    step, angle = abs(basis), math.degrees(np.angle(basis))
    size = float(np.abs(place - origin).max()) / step
    round_step, round_angle = step if fixed_step else round(step, 2), float(round(angle))
    if round_step > 0 and abs(round_step - step) * size < 0.02 * step:
        step = round_step
    if abs(math.radians(round_angle - angle)) * size < 0.02:
        angle = round_angle
    # numpy's own sine and cosine are not exact at 90 degrees
    quarter = {0.0: 1.0, 90.0: 1j, -90.0: -1j, 180.0: -1.0}
    basis = step * complex(quarter.get(angle, complex(np.exp(1j * math.radians(angle)))))
    along = (place - origin) / basis
    shift = complex(fit_offset(along.real, 1.0), fit_offset(along.imag, 1.0))
    return complex(np.round(origin + basis * shift, 4)), basis


def put_on_grid(
    location: np.ndarray,
    rotation: np.ndarray,
    labels: Sequence[str],
    *,
    step: float | None = None,
    turn: int | None = None,
    source: str | os.PathLike[str] = "poses",
) -> GridPoses:
    """Assign every pose its grid point and every action its result.

    MoveForward leads to the next grid point ahead (with a turn of 45, from a diagonal heading to the diagonal
    neighbour), where there is a pose with the same heading; a wall between two such poses is not known here.

    Args:
        location: (N, 2) metres, x and z.
        rotation: (N,) degrees.
        labels: N names of the poses for messages.
        step: distance of neighbouring places; inferred when not given.
        turn: degrees between neighbouring headings, 45, 90, 180 or 360; inferred when not given.
        source: what messages begin with.

    Raises:
        SceneError: poses that lie off the grid, or two that are the same; every one of them is listed.

    >>> corridor = np.array([[0.0, 0.0], [0.01, 0.5], [0.0, 1.0]])
    >>> found = put_on_grid(corridor, np.array([0.0, 1.0, 359.0]), ["a.jpg", "b.jpg", "c.jpg"])
    >>> found.step, found.graph[:, [0, 3]].tolist()
    (0.5, [[1, -1], [2, 0], [-1, 1]])
    """
    if turn is not None and turn not in _TURNS:
        raise SceneError(f"a turn is {turn} degrees; it must be one of {', '.join(map(str, _TURNS[::-1]))}")
    if step is not None and not (math.isfinite(step) and step > 0):
        raise SceneError(f"a step is {step} metres; it must be more than 0")
    location, rotation = np.asarray(location, np.float64), np.asarray(rotation, np.float64)
    turn = fit_turn(rotation) if turn is None else turn
    first = fit_offset(rotation, turn)
    first = 0.0 if abs(first) <= _ALIGNED else first
    heading = np.rint((rotation - first) / turn).astype(np.int64) % (360 // turn)
    off_heading = _beyond(rotation - first, turn)

    # The grid's axes lie along the headings. With x + z i for a place, to turn clockwise by an angle is to
    # multiply by exp(-i angle); the lattice's own coordinates are then right + ahead i.
    place = location @ np.array([1, 1j])
    rough = fit_step(location, heading) if step is None else step
    basis = rough * complex(np.exp(-1j * math.radians(first)))
    origin, basis = fit_lattice(place, basis, fixed_step=step is not None)
    origin, basis = _rounded(origin, basis, place, fixed_step=step is not None)
    step = abs(basis)
    along = (place - origin) / basis
    cell = np.stack([np.rint(along.real), np.rint(along.imag)], 1).astype(np.int64)
    on_grid = origin + basis * (cell @ np.array([1, 1j]))
    snapped = np.stack([on_grid.real, on_grid.imag], 1)
    off_place = np.abs(on_grid - place)

    faults: list[str] = []
    states: dict[tuple[int, int, int], int] = {}
    for state, (u, v) in enumerate(cell.tolist()):
        if off_place[state] > _OFF_PLACE * step:
            x, z = snapped[state]
            faults.append(
                f"{labels[state]}: lies {off_place[state]:.2f} m from ({x:.2f}, {z:.2f}), the nearest place"
                f" of a grid of {step:.3g} m; correct x and z, or give the step, or an edges file"
            )
        if abs(off_heading[state]) > _OFF_HEADING:
            faults.append(
                f"{labels[state]}: heading {rotation[state]:g} is {abs(off_heading[state]):.0f} degrees off"
                f" the nearest of {first:.3g}, {first + turn:.3g}, ...; correct it, or give the turn, or an"
                f" edges file"
            )
        pose = (u, v, int(heading[state]))
        if pose in states:
            faults.append(
                f"{labels[state]}: is the same pose as {labels[states[pose]]}, within a grid of {step:.3g} m;"
                f" take one of them out, or correct it"
            )
        states.setdefault(pose, state)
    raise_faults(source, faults)
    return GridPoses(_moves(states, turn), snapped, (first + heading * turn) % 360, step, turn)


def _moves(states: dict[tuple[int, int, int], int], turn: int) -> np.ndarray:
    """The graph (N, 4) of states by grid point and number of their heading."""
    graph = np.full((len(states), 4), -1, dtype=np.int64)
    for (u, v, heading), state in states.items():
        angle = math.radians(heading * turn)
        x, z = math.sin(angle), math.cos(angle)
        wide = max(abs(x), abs(z))
        ahead_u, ahead_v = round(x / wide), round(z / wide)
        turns = 360 // turn
        results = [
            (u + ahead_u, v + ahead_v, heading),
            (u, v, (heading + 1) % turns),
            (u, v, (heading - 1) % turns),
            (u - ahead_u, v - ahead_v, heading),
        ]
        for action, result in enumerate(results):
            # A turn of 360 degrees leads nowhere: it counts as blocked.
            found = states.get(result, -1)
            graph[state, action] = -1 if found == state else found
    return graph
