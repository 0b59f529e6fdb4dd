"""The two tables that can come with a folder of photographs: their poses, or the moves between them.

Poses are a CSV with the columns ``file,x,z,heading``: metres, and degrees where 0 looks along +Z and 90 along
+X. Edges are a CSV with the columns ``state,action,next``, where states are the files' names and a move
without a line is blocked. Further columns are ignored. All faults of a table are reported at once, with
their lines.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vusfa.errors import SceneError
from vusfa.limits import MAX_TABLE_BYTES, brief
from vusfa.reading import read_text
from vusfa.scenes.graph import default_actions
from vusfa.scenes.validation import raise_faults

__all__ = ["Poses", "edge_states", "read_edges", "read_poses"]


@dataclass(frozen=True)
class Poses:
    """A table of poses.

    Attributes:
        files: N names of pictures, relative to their folder.
        location: (N, 2) float64, x and z in metres.
        rotation: (N,) float64 degrees.
        lines: the table's line of each, counted from 1.
    """

    files: tuple[str, ...]
    location: np.ndarray
    rotation: np.ndarray
    lines: tuple[int, ...]

    @property
    def labels(self) -> list[str]:
        """``line 7 (kitchen/03.jpg)`` for every pose."""
        return [f"line {line} ({file})" for line, file in zip(self.lines, self.files, strict=True)]


def read_poses(path: Path) -> Poses:
    """Read a table of poses.

    Raises:
        SceneError: the table cannot be read, or has faults; every one of them is listed with its line.
    """
    files: dict[str, int] = {}
    numbers: list[list[float]] = []
    faults: list[str] = []
    for line, row in _rows(path, ("file", "x", "z", "heading")):
        file = row["file"]
        if not file:
            faults.append(f"line {line}: column 'file' is empty; name the picture")
        elif file in files:
            faults.append(
                f"line {line}: {brief(file)} has a pose already, in line {files[file]}; every pose needs a"
                f" picture of its own"
            )
        found = []
        for column in ("x", "z", "heading"):
            try:
                found.append(float(row[column]))
            except ValueError:
                found.append(math.nan)
            if not math.isfinite(found[-1]):
                unit = "degrees" if column == "heading" else "metres"
                faults.append(f"line {line}: {column!r} is {brief(row[column])}; write a number, in {unit}")
        files.setdefault(file, line)
        numbers.append(found)
    if not numbers and not faults:
        faults.append("has no poses in it; write a line for every picture")
    raise_faults(path, faults)
    table = np.array(numbers)
    return Poses(tuple(files), table[:, :2], table[:, 2], tuple(files.values()))


def edge_states(path: Path) -> tuple[str, ...]:
    """Names of all states in a table of edges, sorted.

    Raises:
        SceneError: the table cannot be read.
    """
    rows = [row for _, row in _rows(path, ("state", "action", "next"))]
    named = {row[column] for row in rows for column in ("state", "next")}
    return tuple(sorted(named - {"", "-1"}))


def read_edges(path: Path, states: Sequence[str]) -> tuple[np.ndarray, tuple[str, ...]]:
    """Read a table of moves.

    Args:
        path: the CSV; an empty ``next``, or -1, is a blocked move, as is a move without a line.
        states: N names; a state's id is its place here.

    Returns:
        the graph (N, A) int64, -1 = blocked; and the actions' names: the four of the THOR v1 dumps, in their
        order, when there are no others, else all in the order in which they first appear.

    Raises:
        SceneError: the table cannot be read, or has faults; every one of them is listed with its line.
    """
    number = {name: state for state, name in enumerate(states)}
    moves: dict[tuple[int, str], tuple[int, int]] = {}
    actions: dict[str, None] = {}
    faults: list[str] = []
    for line, row in _rows(path, ("state", "action", "next")):
        blocked = row["next"] in ("", "-1")
        named = (row["state"],) if blocked else (row["state"], row["next"])
        unknown = [name for name in named if name and name not in number]
        faults += [
            f"line {line}: there is no state {brief(name)}; states are the pictures' names"
            for name in unknown
        ]
        for column in ("state", "action"):
            if not row[column]:
                faults.append(f"line {line}: column {column!r} is empty; fill it in")
        if unknown or not row["state"] or not row["action"]:
            continue
        actions[row["action"]] = None
        move = (number[row["state"]], row["action"])
        result = -1 if blocked else number[row["next"]]
        if move in moves and moves[move][0] != result:
            faults.append(
                f"line {line}: {brief(row['action'])} from {brief(row['state'])} has another result in line"
                f" {moves[move][1]}; take one of the lines out"
            )
        moves.setdefault(move, (result, line))
    if not moves and not faults:
        faults.append("has no moves in it; write a line for every move: state,action,next")
    raise_faults(path, faults)
    usual = default_actions(4)
    names = usual if set(actions) <= set(usual) else tuple(actions)
    graph = np.full((len(states), len(names)), -1, dtype=np.int64)
    for (state, action), (result, _) in moves.items():
        graph[state, names.index(action)] = result
    return graph, names


def _rows(path: Path, columns: Sequence[str]) -> Iterator[tuple[int, dict[str, str]]]:
    """Lines of a CSV with their numbers, blank ones left out, values without spaces around them."""
    # A BOM is what spreadsheets put in front.
    text = read_text(path, SceneError, "save it as UTF-8 with commas", MAX_TABLE_BYTES, "utf-8-sig")
    reader = csv.reader(io.StringIO(text, newline=""))
    try:
        header = [name.strip().lower() for name in next(reader, [])]
        missing = [name for name in columns if name not in header]
        if missing:
            raise SceneError(
                f"{path}: line 1: column {missing[0]!r} is missing; the first line must name the columns:"
                f" {','.join(columns)} (found: {brief(','.join(header)) if header else 'nothing'})"
            )
        for cells in reader:
            if any(cell.strip() for cell in cells):
                values = dict(zip(header, (cell.strip() for cell in cells), strict=False))
                yield reader.line_num, {name: values.get(name, "") for name in columns}
    except csv.Error as error:
        raise SceneError(f"{path}: cannot be read as CSV ({error}); save it as UTF-8 with commas") from error
