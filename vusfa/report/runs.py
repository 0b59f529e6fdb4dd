"""Runs of ``vusfa train`` and ``vusfa evaluate``, read for a report."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from vusfa.envs.dynamics import MAX_STEPS
from vusfa.errors import CheckpointError, ConfigError
from vusfa.evaluation import Episodes
from vusfa.evaluation.exact import ExactGoals
from vusfa.evaluation.long_table import WITHIN, episode_rows, exact_rows, join_tables, row_label
from vusfa.files import plain_cell
from vusfa.limits import MAX_EPISODE_STEPS, brief
from vusfa.reading import check_fields, read_csv, read_json
from vusfa.report.curve import read_metrics
from vusfa.training import row_name
from vusfa.training.scene_files import find_given

__all__ = ["LoggedRun", "read_episodes", "read_run", "run_label", "split_name"]

_EVALUATIONS = ("zero_shot", "evaluation")
_AGAIN = "evaluate the run again with vusfa evaluate"
#: Types of the settings that a report reads from a run, if present.
_SETTINGS: dict[str, Any] = {
    "agent": dict,
    "env": dict,
    "scenes": (str, list),
    "seed": (int, type(None)),
    "device": str,
    "total_frames": int,
}
_AGENT: dict[str, Any] = {
    "model": str,
    "architecture": (str, type(None)),
    "preset": (str, type(None)),  # the architecture, in version 0.1
    "history": (int, type(None)),
}
_COLUMNS = ("goal", "start", "success", "length", "shortest", "collisions", "trained")


@dataclass(frozen=True, eq=False)
class LoggedRun:
    """One training: its log, its checkpoint and its evaluation.

    Args:
        label: label of its model; runs of one label are seeds of one model.
        seed: seed of the training.
        folder: folder of the run.
        settings: settings of the training, plain.
        curves: columns of metrics.csv by name, each (n,) float64 with NaN where nothing was logged.
        episodes: those of its evaluation, or None.
        references: rows of the evaluation's other policies (random walk, shortest path, ...).
        checkpoint: path of its weights, or None.
        variant: how actions were taken in the evaluation: "sampled" or "greedy".
        exact: its goals' exact probabilities, or None.
        facts: frames and seconds of the training, if there is no log.
        fingerprint: hash of the scenes of the training, if known; that of the checkpoint comes first.
    """

    label: str
    seed: int
    folder: Path
    settings: Mapping[str, Any]
    curves: Mapping[str, np.ndarray] = field(default_factory=dict)
    episodes: Episodes | None = None
    references: Sequence[Mapping[str, Any]] = ()
    checkpoint: Path | None = None
    variant: str = "sampled"
    exact: ExactGoals | None = None
    facts: Mapping[str, float] = field(default_factory=dict)
    fingerprint: str = ""

    def rows(self, within: Sequence[int] = WITHIN) -> pd.DataFrame:
        """Its evaluation as a long table, see :mod:`vusfa.evaluation.long_table`.

        Raises:
            ValueError: the run has no evaluation.
        """
        if self.episodes is None:
            raise ValueError(f"{self.name} has no evaluation")
        head: dict[str, Any] = {"model": self.label, "run": str(self.folder), "seed": self.seed}
        table = episode_rows(self.episodes, mode=self.variant, within=within, **head)
        if self.exact is None:
            return table
        goals = table[["scene", "goal", "trained"]].drop_duplicates()
        return join_tables([table, exact_rows(self.exact, goals, self.episodes.scene_names, **head)])

    @property
    def name(self) -> str:
        """Label and seed."""
        return f"{self.label}, seed {self.seed}"

    @property
    def frames(self) -> float:
        """Frames of the training; NaN if unknown."""
        return self.facts.get("frames", _last(self.curves, "frames"))

    @property
    def seconds(self) -> float:
        """Wall-clock seconds of the training; NaN if unknown."""
        return self.facts.get("seconds", _last(self.curves, "seconds"))

    @property
    def scenes(self) -> list[str]:
        """Names or files of the scenes of the training."""
        scenes = self.settings.get("scenes", [])
        given = [scenes] if isinstance(scenes, str) else [str(scene) for scene in scenes]
        return [find_given(scene, self.folder / "checkpoint.pt") for scene in given]


def _last(curves: Mapping[str, np.ndarray], name: str) -> float:
    column = curves.get(name)
    return float(column[-1]) if column is not None and len(column) else math.nan


def read_run(source: str | Path) -> LoggedRun:
    """Read one run.

    Args:
        source: its folder; ``LABEL=FOLDER`` labels its model LABEL.

    Raises:
        ConfigError: there is no such folder, no config.json in it, or a file cannot be read.

    >>> read_run("vusfa=/no/such/folder")
    Traceback (most recent call last):
    ...
    vusfa.errors.ConfigError: /no/such/folder is not a folder; give the folder of a run of vusfa train
    """
    label, folder = split_name(source)
    if not folder.is_dir():
        raise ConfigError(f"{folder} is not a folder; give the folder of a run of vusfa train")
    settings, named = _read_settings(folder / "config.json")
    log, checkpoint = folder / "metrics.csv", folder / "checkpoint.pt"
    episodes, references, variant = _evaluation(folder)
    return LoggedRun(
        label or named,
        int(settings.get("seed") or 0),
        folder,
        settings,
        read_metrics(log) if log.is_file() else {},
        episodes,
        references,
        checkpoint if checkpoint.is_file() else None,
        variant,
    )


def _read_settings(path: Path) -> tuple[dict[str, Any], str]:
    """A run's settings, checked as far as a report reads them, and its label."""
    mend = "give the folder of a run of vusfa train"
    settings = read_json(path, ConfigError, mend)
    check_fields(settings, _SETTINGS, path, ConfigError, mend)
    agent = settings.get("agent", {})
    if "model" not in agent:
        raise ConfigError(f"{path}: field 'agent.model' is missing; it is no run's settings")
    check_fields(agent, _AGENT, f"{path}, agent", ConfigError, mend)
    if not all(isinstance(scene, str) for scene in settings.get("scenes", ())):
        raise ConfigError(f"{path}: field 'scenes' is {brief(settings['scenes'])}; {mend}")
    try:
        return settings, run_label(settings)
    except CheckpointError as error:
        raise ConfigError(f"{path}: {error}") from error
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ConfigError(f"{path}: these are no settings of vusfa train ({error!r}); {mend}") from error


def run_label(settings: Mapping[str, Any]) -> str:
    """Default label of a run's model, see :func:`~vusfa.evaluation.long_table.row_label`.

    >>> run_label({"agent": {"model": "usfa", "architecture": "paper"}})
    'usfa (paper)'
    """
    agent = settings["agent"]
    return row_label(row_name(settings), agent.get("architecture", agent.get("preset")))


def read_episodes(path: Path, max_steps: int) -> Episodes:
    """Read an ``..._episodes.csv`` of :class:`~vusfa.evaluation.Episodes`.

    Args:
        path: the file.
        max_steps: limit of actions per episode.

    Raises:
        ConfigError: a column is missing, or holds anything but integers.
    """
    content = read_csv(path, ConfigError, _AGAIN, words=["scene"])
    missing = [name for name in ("scene", *_COLUMNS) if name not in content]
    if missing or not content["scene"]:
        lacks = f"column {missing[0]!r} is missing" if missing else "it has no episodes"
        raise ConfigError(f"{path}: {lacks}; {_AGAIN}")
    names = tuple(dict.fromkeys(content["scene"]))
    index = {name: place for place, name in enumerate(names)}
    names = tuple(plain_cell(name) for name in names)
    columns = {}
    for name in [*_COLUMNS, *({"remaining"} & content.keys())]:
        whole = np.abs(content[name]) < 2**53
        whole &= content[name] == np.floor(content[name])
        if not whole.all():
            wrong = content[name][~whole][0]
            raise ConfigError(f"{path}: column {name!r} holds {wrong}, no whole number; {_AGAIN}")
        kind = torch.bool if name in ("success", "trained") else torch.int64
        columns[name] = torch.from_numpy(content[name]).to(kind)
    scene = torch.tensor([index[name] for name in content["scene"]])
    return Episodes(scene=scene, **columns, scene_names=names, max_steps=max_steps)


def split_name(source: str | Path) -> tuple[str, Path]:
    """Split ``NAME=FOLDER``; the name is empty by default.

    >>> split_name("ours=runs/a")
    ('ours', PosixPath('runs/a'))
    """
    text = str(source)
    if "=" in text and not Path(text).exists():
        label, _, rest = text.partition("=")
        return label.strip(), Path(rest)
    return "", Path(text)


def _evaluation(folder: Path) -> tuple[Episodes | None, list[dict[str, Any]], str]:
    """The run's evaluation with the most goals; among equals, that of ``vusfa evaluate``."""
    found: list[tuple[int, Episodes, list[dict[str, Any]], str]] = []
    for stem in _EVALUATIONS:
        table, summary = folder / f"{stem}_episodes.csv", folder / f"{stem}.json"
        if not table.is_file() or not summary.is_file():
            continue
        content = read_json(summary, ConfigError, _AGAIN)
        check_fields(content, {"settings": dict, "rows": list}, summary, ConfigError, _AGAIN)
        settings, rows = content.get("settings", {}), content.get("rows", [])
        check_fields(settings, {"max_steps": int, "sample": bool}, summary, ConfigError, _AGAIN)
        if not 1 <= settings.get("max_steps", MAX_STEPS) <= MAX_EPISODE_STEPS:
            raise ConfigError(
                f"{summary}: field 'max_steps' is {brief(settings['max_steps'])}; it is from 1 to"
                f" {MAX_EPISODE_STEPS:,}; {_AGAIN}"
            )
        if not all(_is_summary(row) for row in rows):
            raise ConfigError(f"{summary}: a row of 'rows' is no row of a summary; {_AGAIN}")
        episodes = read_episodes(table, settings.get("max_steps", MAX_STEPS))
        own = rows[0]["policy"] if rows else ""
        others = [_with_nan(row) for row in rows if row["policy"] != own]
        variant = "sampled" if settings.get("sample", True) else "greedy"
        num_goals = int(torch.stack([episodes.scene, episodes.goal]).unique(dim=1).shape[1])
        found.append((num_goals, episodes, others, variant))
    if not found:
        return None, [], "sampled"
    return max(found, key=lambda item: item[0])[1:]


def _is_summary(row: Any) -> bool:
    words = ("policy", "goals", "scene")
    return (
        isinstance(row, Mapping)
        and all(isinstance(row.get(name), str) for name in words)
        and all(isinstance(v, int | float | None) for name, v in row.items() if name not in words)
    )


def _with_nan(row: Mapping[str, Any]) -> dict[str, Any]:
    return {key: math.nan if value is None else value for key, value in row.items()}
