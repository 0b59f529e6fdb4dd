"""Pretrained agents and their model cards, made from results and checkpoints by one command.

The numbers of a card are the exact ones of its run: expectations over all starts, with a 95 % interval over
goals. Before anything is written the rounded agent is evaluated as the run was, and must give the same.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
import yaml

from vusfa.deploy.agents import PRETRAINED, TrainedAgent, read_agent, save_agent
from vusfa.errors import CheckpointError, ResultError
from vusfa.evaluation.exact import ExactGoals, exact_goals, uniform_probabilities
from vusfa.evaluation.long_table import SUBSETS, exact_rows, goal_sums, select_goals
from vusfa.evaluation.statistics import bootstrap_mean
from vusfa.experiments.runs import Run, read_run
from vusfa.files import check_folder, replacing, write_csv
from vusfa.modules import TabularPolicy
from vusfa.reading import read_csv
from vusfa.scenes import SceneSet
from vusfa.training import load_agent

__all__ = ["TOLERANCE", "card_head", "make_pretrained", "numbers", "write_log"]

#: Largest difference of a mean between the rounded agent and its run, success and SPL in 0..1.
TOLERANCE = 0.005
METRICS = ("success_500", "success_100", "spl")
_LOGGED = 120  # rows of a learning curve
_HEAD = re.compile(r"\A---\n(.*?)\n---\n", re.DOTALL)


def card_head(card: str) -> dict[str, Any]:
    """The YAML head of a model card.

    >>> card_head("---\\nlicense: mit\\n---\\n# An agent")
    {'license': 'mit'}
    """
    found = _HEAD.match(card)
    return yaml.safe_load(found[1]) if found else {}


def numbers(exact: ExactGoals, scenes: SceneSet, trained: torch.Tensor) -> dict[str, dict[str, list[float]]]:
    """Mean and 95 % interval of every metric, over all goals, the trained, the unseen, and each room's.

    Args:
        exact: exact values of all goals.
        scenes: the world.
        trained: (G,) global ids of the trained goals.

    Returns:
        per group of goals and metric: value, low, high; six digits.
    """
    ids = scenes.offsets[exact.scene] + exact.goal
    goals = pd.DataFrame(
        {
            "scene": [scenes.names[index] for index in exact.scene.tolist()],
            "goal": exact.goal.numpy(),
            "trained": torch.isin(ids, trained).numpy(),
        }
    )
    table = exact_rows(exact, goals, scenes.names, "agent")
    groups = {subset: select_goals(table, subset) for subset in SUBSETS}
    groups |= {name: table[table.scene == name] for name in scenes.names}
    found: dict[str, dict[str, list[float]]] = {}
    for group, rows in groups.items():
        found[group] = {}
        for metric in METRICS:
            sums = goal_sums([rows], metric)
            assert sums is not None
            estimate = bootstrap_mean(*sums)
            found[group][metric] = [round(value, 6) for value in estimate]
    return found


def make_pretrained(cell: Path, runs: Path, commit: str, out: Path = PRETRAINED) -> Path:
    """Write NAME.safetensors, its model card NAME.md and, where the training's log lies beside its
    checkpoint, its learning curve NAME.csv.

    Args:
        cell: folder of the results, RESULTS/EXPERIMENT/RUN, such as ``results/table1/vusfa-0``.
        runs: folder of the trainings; the checkpoint is RUNS/EXPERIMENT/RUN/NAME, with NAME from the results.
        commit: commit of the code that trained.
        out: folder to write to.

    Returns:
        the safetensors file.

    Raises:
        ResultError: the results are missing or damaged, or have no exact values.
        CheckpointError: the checkpoint is missing, damaged or of another run, or its rounded weights give
            other numbers than the results.
    """
    cell = cell.resolve()
    run = read_run(cell.parent.parent, cell.parent.name, cell.name)
    if run.exact is None:
        raise ResultError(f"{cell}: has no exact values; take the run of an agent of one frame")
    if not re.fullmatch(r"[0-9a-f]{7,40}", commit):
        raise ResultError(f"commit is {commit!r}; give the hexadecimal digits of the commit that trained")
    check_folder(out, "out")
    checkpoint = runs / cell.parent.name / cell.name / str(run.info["checkpoint"])
    agent, scenes, state = load_agent(checkpoint)
    for name in ("frames", "scenes_fingerprint", "trained_goals"):
        saved = {
            "frames": state["frames"],
            "scenes_fingerprint": scenes.fingerprint,
            "trained_goals": state["goals"].tolist(),
        }[name]
        if run.info.get(name) != saved:
            raise CheckpointError(
                f"{checkpoint}: is not the checkpoint of {cell} ({name} differs); give its runs"
            )
    label = re.sub(r"[^a-z0-9]+", "-", run.label.lower()).strip("-")
    target = out / f"{label}.safetensors"
    with replacing(target) as unfinished:
        save_agent(unfinished, agent, scenes, state["goals"])
        again = read_agent(unfinished, scenes)
        wanted = numbers(run.exact, scenes, state["goals"])
        worst = _deviation(again, wanted)
        if worst > TOLERANCE:
            raise CheckpointError(
                f"{checkpoint}: rounded to float16 a mean is {worst:.4f} off, at most {TOLERANCE} is allowed"
            )
        wanted["all, random walk"] = _random_walk(scenes)
        text = _card(label, run, state["goals"], wanted, worst, commit, unfinished.stat().st_size)
        with replacing(target.with_suffix(".md")) as card:
            card.write_text(text, encoding="utf-8")
    log = checkpoint.with_name("metrics.csv")
    if log.is_file():
        write_log(log, target.with_suffix(".csv"), state["frames"])
    return target


def write_log(log: Path, out: Path, frames: int) -> Path:
    """Write at most 120 rows of a training's metrics.csv, spread evenly, without the columns per goal.

    Args:
        log: the file.
        out: file to write.
        frames: frames of the checkpoint; later rows are left out.

    Raises:
        ResultError: the log is damaged.
    """
    columns = read_csv(log, ResultError, "give the log of a run of vusfa train")
    if "frames" not in columns:
        raise ResultError(f"{log}: column 'frames' is missing; give the log of a run of vusfa train")
    rows = np.flatnonzero(columns["frames"] <= frames)
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(len(rows), _LOGGED)).round().astype(int))]
    names = [name for name in columns if not name.startswith("goal/") and np.isfinite(columns[name]).any()]
    digits = {name: ".0f" if name == "frames" else ".4g" for name in names}
    kept = [{name: float(format(columns[name][row], digits[name])) for name in names} for row in rows]
    return write_csv(out, kept, names)


def _deviation(found: TrainedAgent, wanted: Mapping[str, Mapping[str, list[float]]]) -> float:
    exact = exact_goals(TabularPolicy(found.agent, found.scenes).probabilities, found.scenes)
    again = numbers(exact, found.scenes, found.goals)
    return max(
        abs(again[g][m][0] - value[0]) for g, metrics in wanted.items() for m, value in metrics.items()
    )


def _random_walk(scenes: SceneSet) -> dict[str, list[float]]:
    exact = exact_goals(uniform_probabilities(scenes.num_actions), scenes)
    return numbers(exact, scenes, torch.tensor([0]))["all"]


def _command(run: Run) -> str:
    info = run.info
    settings = [item for item in info["overrides"] if not item.startswith(("agent.model=", "seed="))]
    return " ".join(
        ["vusfa table1", *settings, "--experiment", run.experiment]
        + ["--models", info["model"], "--seeds", str(run.seed)]
    )


def _card(
    name: str,
    run: Run,
    goals: torch.Tensor,
    found: Mapping[str, Mapping[str, list[float]]],
    worst: float,
    commit: str,
    size: int,
) -> str:
    info = run.info
    processor = f"{info['processor']}, {info['threads']} thread" + "s" * (info["threads"] != 1)
    results = [
        {
            "task": {"type": "reinforcement-learning", "name": "Target-driven visual navigation"},
            "dataset": {
                "type": "vusfa-bundled-rooms",
                "name": f"bundled rooms, {group} goals",
                "revision": info["scenes_fingerprint"],
            },
            "metrics": [
                {"type": metric, "name": _WORDS[metric], "value": found[group][metric][0]}
                for metric in METRICS
            ],
        }
        for group in SUBSETS
    ]
    head = {
        "license": "mit",
        "library_name": "vusfa",
        "pipeline_tag": "reinforcement-learning",
        "tags": ["visual-navigation", "successor-features", "torchrl", "reinforcement-learning"],
        "model-index": [{"name": name, "results": results}],
        "vusfa": {
            "model": info["model"],
            "row": run.label,
            "seed": run.seed,
            "frames": info["frames"],
            "trained_goals": len(goals),
            "scenes": list(info["scenes"]),
            "scenes_fingerprint": info["scenes_fingerprint"],
            "command": _command(run),
            "checkpoint": info["checkpoint"],
            "commit": commit,
            "processor": processor,
            "training_s": info["training_s"],
            "versions": dict(info["versions"]),
            "bytes": size,
            "rounding_deviation": round(worst, 6),
            "tolerance": TOLERANCE,
            "exact": {group: dict(metrics) for group, metrics in found.items()},
        },
    }
    lines = ["| goals | success within 500 | success within 100 | SPL |", "|---|---|---|---|"]
    for group, metrics in found.items():
        cells = [_percent(*metrics[metric]) for metric in METRICS]
        lines.append(f"| {group.replace('_', ' ')} | {' | '.join(cells)} |")
    yaml_head = yaml.safe_dump(head, sort_keys=False, allow_unicode=True, width=100)
    validated = ", ".join(f"{file} {100 * spl:.2f} %" for file, spl in info.get("validation_spl", {}).items())
    return _TEXT.format(
        head=yaml_head.rstrip(),
        name=name,
        table="\n".join(lines),
        rooms=", ".join(info["scenes"]),
        goals=len(goals),
        command=_command(run),
        checkpoint=info["checkpoint"],
        validated=validated or "none was chosen among several",
        commit=commit,
        processor=processor,
        seconds=info["training_s"],
        frames=f"{info['frames']:,}",
        seed=run.seed,
        worst=f"{100 * worst:.2f}",
        row=run.label,
    )


def _percent(value: float, low: float, high: float) -> str:
    return f"{100 * value:.1f} % ({100 * low:.1f} to {100 * high:.1f})"


_WORDS = {
    "success_500": "Success within 500 actions",
    "success_100": "Success within 100 actions",
    "spl": "SPL",
}
_TEXT = """---
{head}
---

# {name}

An agent that walks to the place where a picture was taken: model {row}, seed {seed}, trained towards {goals}
goals in the rooms that come with the package vusfa ({rooms}). The models are those of
[arXiv 1908.06376](https://arxiv.org/abs/1908.06376).

```python
import vusfa

agent, rooms, goals, card = vusfa.load_pretrained("{name}")
```

At a camera: `vusfa run {name} --goal goal.jpg --camera FOLDER`.

## Numbers

Exact expectations over all starts, actions drawn; in brackets the 95 % interval over goals. One seed: how far
another training would be off is in the tables of results, not here. The random walk is computed alike.

{table}

## Training

- Command: `{command}`
- Checkpoint: {checkpoint}, the one with the best SPL towards the validation goals ({validated})
- Commit: `{commit}`
- {frames} frames in {seconds} s on {processor}

## Data

The bundled rooms: rendered pictures of rooms made of 3D models (CC BY 3.0 and CC0; CREDITS.md of the package
names every author), features by EfficientNet-lite0. The weights here are under the MIT licence, as the code
is.

## Limits

- It knows these rooms alone: every room has layers of its own; a goal's picture of another room is refused.
- Its actions are moves on a grid and quarter turns; it knows of no obstacle that moves.
- Other lamps, lenses and places between the grid's states have not been measured.
- Weights are float16, rounded to about one percent of each matrix; no mean above changes by more than {worst}
  percentage points.
"""
