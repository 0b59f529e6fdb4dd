"""Runs that are seeds of one model: those of one label that agree in training and evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from vusfa.conf.settings import flat
from vusfa.limits import brief
from vusfa.report.runs import LoggedRun

__all__ = ["separate_runs"]

#: Settings that do not affect learning, or that differ between seeds.
_IGNORED = ("seed", "folder", "resume", "threads", "device", "log_every", "checkpoint_every")
_IGNORED_GROUPS = ("logger.", "evaluation.")
_SAME_LENGTH = 0.98  # of the longest training
_SHOWN = 2  # differences in a label


def separate_runs(runs: Sequence[LoggedRun]) -> tuple[list[LoggedRun], list[str]]:
    """Relabel runs of one label that are not comparable.

    Runs are comparable if they agree in every setting, in the length of their training, and in the goals and
    the limit of actions of their evaluations. What a run does not record is ignored.

    Args:
        runs: runs of any labels.

    Returns:
        the runs, relabelled where needed, and a line per label that was split, which says what differs.

    >>> runs = [LoggedRun("gvf", seed, Path(), {"optim": {"lr": lr}}) for seed, lr in enumerate((0.1, 0.2))]
    >>> [run.label for run in separate_runs(runs)[0]]
    ['gvf, optim.lr=0.1', 'gvf, optim.lr=0.2']
    """
    separated, notes = list(runs), []
    for label in dict.fromkeys(run.label for run in runs):
        places = [place for place, run in enumerate(runs) if run.label == label]
        longest = max(runs[place].frames if runs[place].curves else 0 for place in places)
        facts = [_facts(runs[place], longest) for place in places]
        _spread_overrides(facts)
        told = dict.fromkeys(name for found in facts for name in found)
        names = [name for name in told if _differ(name, facts)]
        if not names:
            continue
        kinds = [tuple(repr(found.get(name)) for name in names) for found in facts]
        for place, found, kind in zip(places, facts, kinds, strict=True):
            words = [f"{name}={_short(found[name])}" for name in names[:_SHOWN] if name in found]
            number = list(dict.fromkeys(kinds)).index(kind) + 1
            ending = f" ({number})" if len(names) > _SHOWN or len(words) < len(names) else ""
            separated[place] = replace(runs[place], label=", ".join([label, *words]) + ending)
        rest = f" and {len(names) - 5} more settings" if len(names) > 5 else ""
        notes.append(f"Runs of {label} differ in {', '.join(names[:5])}{rest}; each kind is shown apart.")
    return separated, notes


def _facts(run: LoggedRun, longest: float) -> dict[str, Any]:
    facts = {
        name: value
        for name, value in flat(run.settings).items()
        if name not in _IGNORED and not name.startswith(_IGNORED_GROUPS)
    }
    facts["scenes"] = sorted(Path(scene).stem for scene in run.scenes)
    if run.curves:
        facts["frames"] = longest if run.frames >= _SAME_LENGTH * longest else run.frames
    if run.episodes is not None:
        facts["evaluation.max_steps"] = run.episodes.max_steps
        goals = torch.stack([run.episodes.scene, run.episodes.goal]).unique(dim=1)
        facts["evaluated goals"] = (run.episodes.scene_names, goals.tolist())
    return facts


def _spread_overrides(facts: Sequence[dict[str, Any]]) -> None:
    """Add missing overrides to results, which record their command line instead of all settings."""
    given = [
        dict(str(text).partition("=")[::2] for text in found.pop("overrides"))
        if "overrides" in found
        else None
        for found in facts
    ]
    names = dict.fromkeys(name for overrides in given for name in overrides or ())
    for found, overrides in zip(facts, given, strict=True):
        if overrides is not None:
            found |= {name: overrides.get(name, "default") for name in names}


def _differ(name: str, facts: Sequence[dict[str, Any]]) -> bool:
    values = [found[name] for found in facts if name in found]
    return any(value != values[0] for value in values)


def _short(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, tuple):  # goals: as many as there are
        return str(len(value[1][0]))
    return value if isinstance(value, str) and len(value) < 40 else brief(value)
