"""The tables that ``docs/*.md`` include: ``vusfa tables --docs docs/generated`` writes each to a file.

:data:`TABLES` lists those of experiments that share their episodes; :func:`write_documents` adds the tables
of ``vusfa transfer``, ``vusfa generalise`` and ``vusfa robustness``.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

from vusfa.evaluation.baselines import RANDOM_WALK
from vusfa.evaluation.long_table import MEAN_OF_STATES
from vusfa.experiments.runs import read_runs
from vusfa.files import write_text
from vusfa.modules.config import MODELS
from vusfa.report.experiment import Experiment, read_experiment
from vusfa.report.markdown import markdown
from vusfa.report.result_tables import comparison_rows, distance_rows, model_rows, run_rows
from vusfa.report.robustness import robustness_table
from vusfa.report.transfer_figure import transfer_tables
from vusfa.report.unseen import unseen_table
from vusfa.scenes import SceneSet

__all__ = ["COMMAND", "TABLES", "documents", "write_documents"]

COMMAND = "vusfa tables --docs docs/generated"

Rows = Callable[[Experiment], list[dict[str, Any]]]

_TABLE1 = ("table1", "hindsight", "replay-search")
_EVERY_GOAL = ("hindsight", "replay-search")
_RUNS = ["model", "seed", "frames", "checkpoint", "training_s", "trained", "exact_z"]
_MODELS = ["model", "seeds", "num_goals", "success_500", "success_100", "spl", "length_ratio"]
_DISTANCE = ["distance", "model", "num_goals", "success_500", "spl"]
_COMPARED = ["goals", "metric", "model", "against", "difference", "improvement"]


def _models(*subsets: str, mode: str = "sampled") -> Rows:
    def rows(experiment: Experiment) -> list[dict[str, Any]]:
        found = model_rows(experiment, mode, places=[MEAN_OF_STATES], metrics=_MODELS[3:])
        return [row for row in found if row["goals"] in subsets]

    return rows


def _distances(experiment: Experiment) -> list[dict[str, Any]]:
    rows = distance_rows(experiment, "sampled", models=[*MODELS, RANDOM_WALK], metrics=_DISTANCE[3:])
    return [row for row in rows if row["distance"] != "0"]


def _comparisons(experiment: Experiment) -> list[dict[str, Any]]:
    shown = {("trained", "spl"), ("unseen", "success_500"), ("unseen", "spl")}
    names = [name for name in MODELS if name in experiment.runs]
    pairs = [*zip(names[1:], names, strict=False), (names[-1], names[0])]
    rows = comparison_rows(experiment, "sampled", pairs=pairs)
    return [row for row in rows if (row["goals"], row["metric"]) in shown]


#: Name of the file, the experiments that it is made from, its rows and its columns.
TABLES: list[tuple[str, tuple[str, ...], Rows, list[str]]] = [
    ("table1", _TABLE1, _models("trained", "unseen", "all"), ["goals", *_MODELS]),
    ("table1-distance", _TABLE1, _distances, _DISTANCE),
    ("table1-compared", _TABLE1, _comparisons, _COMPARED),
    ("table1-runs", _TABLE1, run_rows, _RUNS),
    ("controlled", ("controlled",), _models("trained", "unseen", "all"), ["goals", *_MODELS]),
    ("controlled-distance", ("controlled",), _distances, _DISTANCE),
    ("controlled-compared", ("controlled",), _comparisons, _COMPARED),
    ("controlled-runs", ("controlled",), run_rows, _RUNS[:-1]),
    ("presets", ("paper", "reference"), _models("trained", "unseen"), ["goals", *_MODELS]),
    ("other-baselines", ("autoencoder", "pixels", "lstm"), _models("trained", "unseen"), ["goals", *_MODELS]),
    ("reach-every-goal", _EVERY_GOAL, _models("trained", "unseen", "all"), ["goals", *_MODELS]),
    ("reach-every-goal-greedy", _EVERY_GOAL, _models("all", mode="greedy"), _MODELS),
    ("reach-every-goal-runs", ("replay-search",), run_rows, _RUNS),
    ("hindsight-ablation", ("hindsight-half", "hindsight-none"), _models("all"), _MODELS),
]


def documents(results: str | Path) -> dict[str, str]:
    """All tables, Markdown, by the names of their files.

    Args:
        results: folder of results.

    Raises:
        ResultError: results are missing or damaged.
    """
    world = SceneSet.bundled()
    read = lru_cache(lambda names: read_experiment(results, names, world))
    texts = {f"{name}.md": markdown(rows(read(names)), columns) for name, names, rows, columns in TABLES}
    lengths, differences = transfer_tables(read_runs(results, "transfer"), world)
    texts |= {"transfer.md": lengths, "transfer-differences.md": differences}
    texts["generalise.md"] = unseen_table(read_runs(results, "generalise"))
    texts["robustness.md"] = robustness_table(read_runs(results, "robustness"))
    texts["robustness-one-room.md"] = robustness_table(read_runs(Path(results) / "one-room", "robustness"))
    return {name: f"<!-- {COMMAND} -->\n\n{text}\n" for name, text in texts.items()}


def write_documents(results: str | Path, folder: str | Path) -> list[Path]:
    """Write each of :func:`documents` into a folder, atomically.

    Returns:
        the paths.
    """
    return [write_text(Path(folder) / name, text) for name, text in documents(results).items()]
