"""Reads cells of results (:mod:`vusfa.experiments.results`) as runs, and whatever a report is given."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vusfa.errors import ConfigError
from vusfa.experiments.results import read_cell
from vusfa.modules.presets import MODELS
from vusfa.report.runs import Run, read_curves, read_run, split_name

__all__ = ["cell_run", "read_source"]


def read_source(source: str | Path, way: str = "sampled", runs: str | Path = "runs") -> list[Run]:
    """Reads whatever a report may be given.

    Args:
        source: folder of a run of recipes/train.py, of a cell of results, or of an experiment, all of whose
            cells are read; ``NAME=FOLDER`` calls the model NAME.
        way: of evaluating cells, ``sampled`` or ``greedy``.
        runs: where the trainings of cells keep logs and checkpoints, ``RUNS/EXPERIMENT/CELL``.

    Raises:
        ConfigError: none of these, or files in it that cannot be read.
        ResultError: a cell that is damaged.

    >>> read_source("/no/such/folder")
    Traceback (most recent call last):
    ...
    vusfa.errors.ConfigError: /no/such/folder is not a folder; give the folder of a run or of results
    """
    label, folder = split_name(source)
    if not folder.is_dir():
        raise ConfigError(f"{folder} is not a folder; give the folder of a run or of results")
    if (folder / "cell.json").is_file():
        return [cell_run(folder, label, way, runs)]
    if (folder / "config.json").is_file():
        return [read_run(source)]
    cells = sorted(path.parent for path in folder.glob("*/cell.json") if path.parent.name[0] != ".")
    if not cells:
        raise ConfigError(
            f"{folder} holds neither a run (config.json) nor results (cell.json); give the folder of a run of"
            " recipes/train.py, or of a cell or an experiment of results"
        )
    return sorted((cell_run(cell, label, way, runs) for cell in cells), key=_order)


def cell_run(folder: Path, label: str = "", way: str = "sampled", runs: str | Path = "runs") -> Run:
    """A cell as a run; with its log and its checkpoint, where its training has kept them.

    Args:
        folder: ``.../EXPERIMENT/CELL``.
        label: what to call its model; its row's name when empty.
        way: which of its evaluations counts.
        runs: see :func:`read_source`.

    Raises:
        ConfigError: it was not evaluated in this way.
        ResultError: it is damaged.
    """
    folder = folder.absolute()
    cell = read_cell(folder.parent.parent, folder.parent.name, folder.name)
    if cell.episodes and way not in cell.episodes:
        raise ConfigError(
            f"{folder}: there are no episodes called {way!r}; give {' or '.join(cell.episodes)}"
        )
    info, episodes = cell.info, cell.episodes.get(way)
    kept = Path(runs) / cell.experiment / cell.name
    log, checkpoint = kept / "metrics.csv", kept / str(info.get("checkpoint", "checkpoint.pt"))
    scenes = info.get("scenes", episodes.scene_names if episodes else ())
    settings: dict[str, Any] = {"agent": {"model": info.get("model", cell.name)}, "scenes": list(scenes)}
    if (kept / "config.json").is_file():  # it names scenes' files, too
        settings = dict(read_run(kept).settings)
    return Run(
        label or _label(info, cell.name),
        int(info.get("seed") or 0),
        folder,
        settings,
        read_curves(log) if log.is_file() else {},
        episodes,
        (),
        checkpoint if checkpoint.is_file() else None,
        way,
        cell.exact if way == "sampled" else None,
        {"frames": _number(info, "frames"), "seconds": _number(info, "training_s")},
    )


def _order(run: Run) -> tuple[int, str, int]:
    """The paper's order of models, then seeds."""
    model = run.settings["agent"]["model"]
    return list(MODELS).index(model) if model in MODELS else len(MODELS), run.label, run.seed


def _label(info: Mapping[str, Any], name: str) -> str:
    row, preset = str(info.get("row") or info.get("model") or name), info.get("agent_preset") or "controlled"
    return row if preset == "controlled" else f"{row} ({preset})"


def _number(info: Mapping[str, Any], name: str) -> float:
    value = info.get(name)
    return float(value) if isinstance(value, int | float) else math.nan
