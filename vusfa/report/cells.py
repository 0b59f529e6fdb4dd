"""Readers of a report's sources: folders of runs, and of results (:mod:`vusfa.experiments.runs`)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from vusfa.deploy.agents import pretrained_names
from vusfa.errors import ConfigError
from vusfa.experiments import runs as results
from vusfa.modules.config import MODELS
from vusfa.report.curve import read_metrics
from vusfa.report.run_agents import pretrained_of, pretrained_run
from vusfa.report.runs import LoggedRun, read_run, split_name

__all__ = ["read_source", "result_run"]


def read_source(source: str | Path, mode: str = "sampled", runs: str | Path = "runs") -> list[LoggedRun]:
    """Read the runs of one source of a report.

    Args:
        source: folder of a run of vusfa train, of one run of results, or of a sweep or an experiment, all of
            whose runs are read; or the name of a pretrained agent, see
            :func:`~vusfa.report.run_agents.pretrained_run`. ``NAME=FOLDER`` labels the model NAME. A sweep's
            ``multirun.yaml`` is no run.
        mode: of the evaluation, ``sampled`` or ``greedy``.
        runs: folder of logs and checkpoints, ``RUNS/EXPERIMENT/RUN``.

    Raises:
        ConfigError: the source is none of these, or a file cannot be read.
        ResultError: the results are damaged.

    >>> read_source("/no/such/folder")
    Traceback (most recent call last):
    ...
    vusfa.errors.ConfigError: /no/such/folder is not a folder; give the folder of a run or of results, ...
    """
    label, folder = split_name(source)
    if folder.name == "multirun.yaml" and folder.is_file():
        return []
    known = str(folder) in pretrained_names()
    if not folder.is_dir() and not known:
        raise ConfigError(
            f"{folder} is not a folder; give the folder of a run or of results, or a pretrained agent"
            f" ({', '.join(pretrained_names())})"
        )
    if (folder / "cell.json").is_file():
        return [result_run(folder, label, mode, runs)]
    if (folder / "config.json").is_file():
        return [read_run(source)]
    sweep = sorted(path.parent for path in folder.glob("*/config.json") if path.parent.name[0] != ".")
    folders = sorted(path.parent for path in folder.glob("*/cell.json") if path.parent.name[0] != ".")
    if sweep and not folders:
        return [replace(run, label=label or run.label) for run in map(read_run, sweep)]
    if not folders and known:  # a folder of runs of that name comes first
        return [pretrained_run(str(folder), label)]
    if not folders:
        raise ConfigError(
            f"{folder} holds neither a run (config.json) nor results (cell.json); give the folder of a run of"
            " vusfa train, or of results"
        )
    return sorted((result_run(path, label, mode, runs) for path in folders), key=_order)


def result_run(folder: Path, label: str = "", mode: str = "sampled", runs: str | Path = "runs") -> LoggedRun:
    """Results as a run, with the log and the checkpoint of its training where they exist.

    Args:
        folder: ``.../EXPERIMENT/RUN``.
        label: label of its model; its row's name by default.
        mode, runs: see :func:`read_source`.

    Raises:
        ConfigError: there is no evaluation of this mode.
        ResultError: the results are damaged.
    """
    folder = folder.absolute()
    run = results.read_run(folder.parent.parent, folder.parent.name, folder.name)
    if run.episodes and mode not in run.episodes:
        raise ConfigError(
            f"{folder}: there are no episodes called {mode!r}; give {' or '.join(run.episodes)}"
        )
    info, episodes = run.info, run.episodes.get(mode)
    kept = Path(runs) / run.experiment / run.name
    log, checkpoint = kept / "metrics.csv", kept / str(info.get("checkpoint", "checkpoint.pt"))
    scenes = info.get("scenes", episodes.scene_names if episodes else ())
    settings: dict[str, Any] = {"agent": {"model": info.get("model", run.name)}, "scenes": list(scenes)}
    settings["overrides"] = [text for text in info.get("overrides", ()) if not str(text).startswith("seed=")]
    if (kept / "config.json").is_file():  # it has the scenes' files, too
        settings = dict(read_run(kept).settings)
    logged = LoggedRun(
        label or run.label,
        run.seed,
        folder,
        settings,
        read_metrics(log) if log.is_file() else {},
        episodes,
        (),
        checkpoint if checkpoint.is_file() else None,
        mode,
        run.exact if mode == "sampled" else None,
        {"frames": _number(info, "frames"), "seconds": _number(info, "training_s")},
        info.get("scenes_fingerprint", ""),
    )
    return pretrained_of(logged)


def _order(run: LoggedRun) -> tuple[int, str, int]:
    """The paper's order of models, then seeds."""
    model = run.settings["agent"]["model"]
    return list(MODELS).index(model) if model in MODELS else len(MODELS), run.label, run.seed


def _number(info: Mapping[str, Any], name: str) -> float:
    value = info.get(name)
    return float(value) if isinstance(value, int | float) else math.nan
