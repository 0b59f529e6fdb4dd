"""The example of a new metric: it appears in zero-shot's table, in the tables and on the page."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import torch

from vusfa.evaluation import evaluate
from vusfa.evaluation.exact import exact_goals, uniform_probabilities
from vusfa.experiments.runs import Run, write_run
from vusfa.experiments.training import compose_settings, train
from vusfa.modules import make_agent
from vusfa.scenes import SceneSet

EXAMPLE = Path(__file__).parents[2] / "examples" / "extending" / "metric.py"


def test_it_appears_everywhere(scene_file: Path, tmp_path: Path, program: Any) -> None:
    def command(*arguments: object) -> str:
        done = program("examples/extending/metric.py", *arguments, folder=tmp_path)
        assert done.returncode == 0, done.stderr
        return done.stdout

    overrides = ["agent.hidden_size=8", "agent.embedding_size=8", "agent.history=1", "total_frames=48"]
    overrides += [f"scenes=[{scene_file}]", "env.goals=[3,9]", "collector.num_envs=6", "collector.rollout=4"]
    train(compose_settings([*overrides, "evaluation=none", f"folder={tmp_path / 'run'}"]), overrides)
    assert "perfect" in command("evaluate", tmp_path / "run" / "checkpoint.pt", "--episodes", 1)
    with open(tmp_path / "run" / "zero_shot.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert {row["perfect"] for row in rows if row["policy"] == "shortest path"} == {"1.0"}
    command("report", tmp_path / "run", "--out", tmp_path / "page.html", "--goals-per-scene", 1, "--walks", 1)
    assert '"name":"perfect"' in (tmp_path / "page.html").read_text(encoding="utf-8")

    rooms = SceneSet.open([scene_file])
    agent = make_agent("gvf", scenes=rooms, history=1, hidden_size=8)
    walked = evaluate(agent.get_policy_operator(), rooms, history=1, trained=torch.tensor([3]))
    exact = exact_goals(uniform_probabilities(4), rooms)
    info = {"model": "gvf", "seed": 0, "scenes": [str(scene_file)]}
    write_run(tmp_path / "results", Run("a", "gvf-0", info, {"sampled": walked}, exact))
    printed = command("tables", "a", "--results", tmp_path / "results", "--resamples", 20)
    assert "| perfect, % |" in printed
    assert any("| random walk | – |" in line and line.count("[") >= 4 for line in printed.splitlines())


def test_it_is_one_short_file() -> None:
    assert len(EXAMPLE.read_text(encoding="utf-8").splitlines()) <= 81  # 80 lines and the registry line
