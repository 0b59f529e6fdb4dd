"""Results on disk, ``results/EXPERIMENT/RUN/``: every table is computed from them.

A run is one trained agent. Its folder holds

``cell.json``    facts: model, seed, settings, trained goals, frames, seconds, machine, versions
``NAME.npz``     the episodes of one mode of evaluation (``sampled``, ``greedy``), columns of small integers
``exact.npz``    where it can be computed, :class:`~vusfa.evaluation.exact.ExactGoals`

The folder appears at once and complete, or not at all.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from vusfa.deprecated import moved_names
from vusfa.errors import ResultError
from vusfa.evaluation.episodes import Episodes
from vusfa.evaluation.exact import ExactGoals
from vusfa.evaluation.long_table import episode_rows, exact_rows, join_tables, row_label
from vusfa.files import write_json
from vusfa.limits import MAX_EPISODE_STEPS, brief, listing
from vusfa.reading import check_fields, read_json, read_npz

__all__ = ["Run", "check_run_name", "no_results", "read_run", "read_runs", "write_run"]

_EXACT = "exact"
_AGAIN = "delete the folder and run it again"
_FIELDS = {"info": dict, "episodes": list, "scenes": list, "max_steps": int}
#: What is read of ``info``, where it is there.
_FACTS: dict[str, Any] = {
    "model": str,
    "row": (str, type(None)),
    "architecture": (str, type(None)),
    "agent_preset": (str, type(None)),  # the architecture, in results of version 0.1
    "seed": (int, type(None)),
    "scenes": list,
    "scenes_fingerprint": str,
    "overrides": list,
    "checkpoint": str,
    "curves": list,
}
_EPISODES = ("scene", "goal", "start", "success", "length", "shortest", "collisions", "trained")


@dataclass(frozen=True, eq=False)
class Run:
    """The results of one trained agent.

    Attributes:
        experiment, name: of its folder.
        info: facts of cell.json, plain data.
        episodes: tables by mode of evaluation.
        exact: exact values per goal, or None.
    """

    experiment: str
    name: str
    info: Mapping[str, Any]
    episodes: Mapping[str, Episodes]
    exact: ExactGoals | None = None

    @property
    def seed(self) -> int:
        """Seed of the training."""
        return int(self.info.get("seed") or 0)

    @property
    def label(self) -> str:
        """Label of its model in tables."""
        name = str(self.info.get("row") or self.info.get("model") or self.name)
        return row_label(name, self.info.get("architecture", self.info.get("agent_preset")))

    def rows(self, goals: pd.DataFrame | None = None) -> pd.DataFrame:
        """Its long table, see :mod:`vusfa.evaluation.long_table`.

        Args:
            goals: rows with scene, goal and trained of the exact values; those of the episodes by default.
        """
        head: Any = {"model": self.label, "run": f"{self.experiment}/{self.name}", "seed": self.seed}
        tables = [episode_rows(table, mode=mode, **head) for mode, table in self.episodes.items()]
        if self.exact is not None:
            goals = tables[0][["scene", "goal", "trained"]].drop_duplicates() if goals is None else goals
            names = next(iter(self.episodes.values())).scene_names
            tables.append(exact_rows(self.exact, goals, names, **head))
        return join_tables(tables)


def write_run(root: str | Path, run: Run) -> Path:
    """Write a run's folder, replacing one of the same name.

    Raises:
        ResultError: a mode of evaluation is called ``exact``, or it or the run cannot be the name of a file.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as root:
    ...     _ = write_run(root, Run("table1", "walk", {"model": "random walk"}, {}))
    ...     read_run(root, "table1", "walk").info
    {'model': 'random walk'}
    """
    for name in run.episodes:
        _check_mode(name, root)
    check_run_name(run.name)
    folder = Path(root) / run.experiment / run.name
    folder.parent.mkdir(parents=True, exist_ok=True)
    unfinished = Path(tempfile.mkdtemp(prefix=f".{run.name}.", dir=folder.parent))
    try:
        unfinished.chmod(0o755)
        tables = {name: (table.scene_names, table.max_steps) for name, table in run.episodes.items()}
        if len(set(tables.values())) > 1:
            raise ResultError(f"the episodes of {folder} are of different scenes or lengths")
        scenes, steps = next(iter(tables.values()), ((), 0))
        facts = {"scenes": list(scenes), "max_steps": steps, "episodes": list(tables)} if tables else {}
        write_json(unfinished / "cell.json", {"info": dict(run.info), **facts})
        for name, table in run.episodes.items():
            columns = {column: getattr(table, column) for column in table.columns}
            _write_columns(unfinished / f"{name}.npz", columns)
        if run.exact is not None:
            exact = {"scene": run.exact.scene, "goal": run.exact.goal, **run.exact.metrics}
            _write_columns(unfinished / f"{_EXACT}.npz", exact)
        if folder.exists():
            shutil.rmtree(folder)
        unfinished.rename(folder)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return folder


def check_run_name(name: str) -> None:
    """Refuse with a ResultError what cannot be the name of a run's folder.

    >>> check_run_name("../elsewhere-0")
    Traceback (most recent call last):
    ...
    vusfa.errors.ResultError: a run cannot be called '../elsewhere-0'; give the name of a folder, without /
    """
    if "/" in name or "\0" in name or name.strip(".") == "" or len(name.encode("utf-8", "replace")) > 200:
        raise ResultError(f"a run cannot be called {brief(name)}; give the name of a folder, without /")


def _check_mode(name: Any, path: str | Path) -> None:
    if not isinstance(name, str) or name == _EXACT or not name.replace("-", "_").isidentifier():
        raise ResultError(f"{path}: episodes are called {brief(name)}; give a name of letters, digits and -")


def read_run(root: str | Path, experiment: str, name: str) -> Run:
    """Read a run's folder.

    Raises:
        ResultError: something is missing or damaged; the file is named.
    """
    folder = Path(root) / experiment / name
    path = folder / "cell.json"
    if not os.path.lexists(path):
        if folder.is_dir():
            raise ResultError(f"{path}: there is no such file, so the folder holds no results; {_AGAIN}")
        raise no_results(folder.parent, name)
    content = read_json(path, ResultError, _AGAIN)
    content = {"episodes": [], "scenes": [], "max_steps": 0, **content}
    check_fields(content, _FIELDS, path, ResultError, _AGAIN)
    check_fields(content.get("info", {}), _FACTS, path, ResultError, _AGAIN)
    if "info" not in content:
        raise ResultError(f"{path}: field 'info' is missing; {_AGAIN}")
    if not bool(content["episodes"]) <= content["max_steps"] <= MAX_EPISODE_STEPS:
        raise ResultError(f"{path}: field 'max_steps' is {brief(content['max_steps'])}; {_AGAIN}")
    episodes = {}
    for mode in content["episodes"]:
        _check_mode(mode, path)
        file = folder / f"{mode}.npz"
        columns = _read_columns(file, _EPISODES)
        try:
            episodes[mode] = Episodes(
                **columns, scene_names=tuple(content["scenes"]), max_steps=content["max_steps"]
            )
        except (TypeError, ValueError) as error:
            raise ResultError(f"{file}: {error}; {_AGAIN}") from error
    return Run(experiment, name, content["info"], episodes, _read_exact(folder / f"{_EXACT}.npz"))


def no_results(folder: str | Path, *names: str, command: str = "") -> ResultError:
    """The error of runs or experiments that are not there; it says which there are, and what makes them.

    >>> str(no_results("/no/such", "table1"))
    '/no/such: no results of table1; there are none'
    """
    mend = f"; run {command} first" if command else ""
    places = [place for depth in ("*", "*/*") for place in Path(folder).glob(f"{depth}/cell.json")]
    there = {place.relative_to(folder).parts[0] for place in places}
    return ResultError(
        f"{folder}: no results of {' or '.join(names)}; there are {listing(sorted(there)) or 'none'}{mend}"
    )


def _read_exact(path: Path) -> ExactGoals | None:
    if not path.exists():
        return None
    columns = _read_columns(path, ["scene", "goal"])
    scene, goal = columns.pop("scene"), columns.pop("goal")
    return ExactGoals(scene, goal, columns)


def read_runs(root: str | Path, experiment: str) -> list[Run]:
    """All runs of an experiment, by name; none where there is no such folder.

    Raises:
        ResultError: see :func:`read_run`.
    """
    folder = Path(root) / experiment
    names = sorted(path.parent.name for path in folder.glob("*/cell.json") if path.parent.name[0] != ".")
    return [read_run(root, experiment, name) for name in names]


def _write_columns(path: Path, columns: Mapping[str, Tensor]) -> None:
    small = {name: _small(column.numpy()) for name, column in columns.items()}
    np.savez_compressed(path, allow_pickle=False, **small)


def _small(column: np.ndarray) -> np.ndarray:
    """The smallest type that holds the numbers; float32 for probabilities."""
    if column.dtype.kind == "f":
        return column.astype(np.float32)
    if column.dtype.kind == "b" or not column.size:
        return column
    return column.astype(np.result_type(np.min_scalar_type(column.min()), np.min_scalar_type(column.max())))


def _read_columns(path: Path, required: Sequence[str]) -> dict[str, Tensor]:
    content = read_npz(path)
    missing = [name for name in required if name not in content]
    if missing:
        raise ResultError(f"{path}: the column {missing[0]!r} is missing; {_AGAIN}")
    for name, column in content.items():
        if column.dtype.kind not in "biuf" or column.shape != (content[required[0]].size,):
            raise ResultError(
                f"{path}: the column {name!r} is {column.dtype} of shape {column.shape}; {_AGAIN}"
            )
    types = {"b": torch.bool, "f": torch.float64}
    return {
        name: torch.from_numpy(np.ascontiguousarray(column)).to(types.get(column.dtype.kind, torch.int64))
        for name, column in content.items()
    }


__getattr__ = moved_names(
    __name__,
    {
        old: f"{__name__}.{new}"
        for old, new in (
            ("Cell", "Run"),
            ("read_cell", "read_run"),
            ("read_cells", "read_runs"),
            ("write_cell", "write_run"),
        )
    },
)
