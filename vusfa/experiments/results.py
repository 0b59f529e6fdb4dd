"""Raw results on disk: ``results/EXPERIMENT/CELL/``, from which every table can be computed again.

A cell is one trained agent, or one floor or ceiling. Its folder holds

``cell.json``    what it is: model, preset, seed, settings, trained goals, frames, seconds, machine, versions
``NAME.npz``     the episodes of one way to evaluate it (``sampled``, ``greedy``), columns of small integers
``exact.npz``    where it can be had, :class:`~vusfa.evaluation.exact.ExactGoals`

The folder appears at once and complete, or not at all.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from vusfa.errors import ResultError
from vusfa.evaluation.episodes import Episodes
from vusfa.evaluation.exact import ExactGoals
from vusfa.files import read_npz, write_json

__all__ = ["Cell", "read_cell", "read_cells", "write_cell"]

_EXACT = "exact"


@dataclass(frozen=True, eq=False)
class Cell:
    """One row's worth of results.

    Attributes:
        experiment, name: where it lies.
        info: plain data, as in cell.json.
        episodes: tables by the way of evaluation.
        exact: goal by goal, or None.
    """

    experiment: str
    name: str
    info: Mapping[str, Any]
    episodes: Mapping[str, Episodes]
    exact: ExactGoals | None = None


def write_cell(root: str | Path, cell: Cell) -> Path:
    """Write a cell's folder; one of the same name is replaced.

    Raises:
        ResultError: a way of evaluation is called ``exact``, or no file's name.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as root:
    ...     _ = write_cell(root, Cell("table1", "walk", {"model": "random walk"}, {}))
    ...     read_cell(root, "table1", "walk").info
    {'model': 'random walk'}
    """
    for name in cell.episodes:
        if name == _EXACT or not name.replace("-", "_").isidentifier():
            raise ResultError(f"episodes are called {name!r}; give a name of letters, digits and -")
    folder = Path(root) / cell.experiment / cell.name
    folder.parent.mkdir(parents=True, exist_ok=True)
    unfinished = Path(tempfile.mkdtemp(prefix=f".{cell.name}.", dir=folder.parent))
    try:
        unfinished.chmod(0o755)
        tables = {name: (table.scene_names, table.max_steps) for name, table in cell.episodes.items()}
        if len(set(tables.values())) > 1:
            raise ResultError(f"the episodes of {folder} are of different scenes or lengths")
        scenes, steps = next(iter(tables.values()), ((), 0))
        told = {"scenes": list(scenes), "max_steps": steps, "episodes": list(tables)} if tables else {}
        write_json(unfinished / "cell.json", {"info": dict(cell.info), **told})
        for name, table in cell.episodes.items():
            _write_columns(unfinished / f"{name}.npz", table, table.columns)
        if cell.exact is not None:
            _write_columns(unfinished / f"{_EXACT}.npz", cell.exact, _columns(ExactGoals))
        if folder.exists():
            shutil.rmtree(folder)
        unfinished.rename(folder)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return folder


def read_cell(root: str | Path, experiment: str, name: str) -> Cell:
    """Read a cell's folder.

    Raises:
        ResultError: something is missing or damaged; the file is named.
    """
    folder = Path(root) / experiment / name
    path = folder / "cell.json"
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        info, wanted = content["info"], content.get("episodes", [])
        scenes, steps = tuple(content.get("scenes", ())), int(content.get("max_steps", 0))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ResultError(
            f"{path}: cannot be read ({error!r}); delete the folder and run it again"
        ) from error
    episodes = {
        way: Episodes(**_read_columns(folder / f"{way}.npz", Episodes), scene_names=scenes, max_steps=steps)
        for way in wanted
    }
    exact = folder / f"{_EXACT}.npz"
    return Cell(
        experiment,
        name,
        info,
        episodes,
        ExactGoals(**_read_columns(exact, ExactGoals)) if exact.exists() else None,
    )


def read_cells(root: str | Path, experiment: str) -> list[Cell]:
    """All cells of an experiment, by name; none where there is no such folder.

    Raises:
        ResultError: see :func:`read_cell`.
    """
    folder = Path(root) / experiment
    names = sorted(path.parent.name for path in folder.glob("*/cell.json") if path.parent.name[0] != ".")
    return [read_cell(root, experiment, name) for name in names]


def _columns(table: type) -> list[str]:
    return [field.name for field in fields(table) if field.type in ("Tensor", Tensor)]


def _write_columns(path: Path, table: Any, names: Sequence[str]) -> None:
    columns = {name: _small(getattr(table, name).numpy()) for name in names}
    np.savez_compressed(path, allow_pickle=False, **columns)


def _small(column: np.ndarray) -> np.ndarray:
    """In the smallest type that holds the numbers; chances to seven digits."""
    if column.dtype.kind == "f":
        return column.astype(np.float32)
    if column.dtype.kind == "b" or not column.size:
        return column
    return column.astype(np.result_type(np.min_scalar_type(column.min()), np.min_scalar_type(column.max())))


def _read_columns(path: Path, kind: type) -> dict[str, Tensor]:
    content = read_npz(path)
    missing = [name for name in _columns(kind) if name not in content]
    if missing:
        raise ResultError(f"{path}: the column {missing[0]!r} is missing; run this cell again")
    known = {field.name for field in fields(kind)}
    columns = {name: column for name, column in content.items() if name in known}
    types = {"b": torch.bool, "f": torch.float64}
    return {
        name: torch.from_numpy(np.ascontiguousarray(column)).to(types.get(column.dtype.kind, torch.int64))
        for name, column in columns.items()
    }
