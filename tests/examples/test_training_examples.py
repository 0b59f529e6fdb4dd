"""Examples of a model, an algorithm and a loss term: trained as a script, resumed, evaluated like any."""

from __future__ import annotations

import csv
import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from vusfa.errors import VusfaError
from vusfa.modules import MODELS
from vusfa.training import load_agent, load_checkpoint

EXAMPLES = Path(__file__).parents[2] / "examples" / "extending"


@pytest.fixture
def start(program: Any) -> Callable[..., None]:
    """Runs an example, which has to succeed."""

    def run(example: str, *overrides: str, folder: Path) -> None:
        done = program(
            f"examples/extending/{example}.py", *overrides, f"folder={folder}", folder=folder.parent
        )
        assert done.returncode == 0, done.stderr

    return run


@pytest.mark.parametrize(
    ("example", "chosen", "column"),
    [
        ("algorithm", ["algorithm=ppo", "algorithm.epochs=3", "algorithm.clip=0.1"], "loss_objective"),
        ("loss_term", ["objective.terms.successor_size=0.01"], "loss_successor_size"),
        ("model", ["agent.model=gated"], "loss_successor"),
    ],
)
def test_trained_resumed_and_evaluated(
    scene_file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    start: Callable[..., None],
    example: str,
    chosen: list[str],
    column: str,
):
    settings = [
        *chosen,
        f"scenes=[{scene_file}]",
        "env.goals=[3,9,12]",
        "agent.hidden_size=8",
        "agent.embedding_size=8",
        "collector.num_envs=6",
        "collector.rollout=4",
        "optim.horizon=null",
        "entropy.horizon=null",
        "log_every=24",
        "evaluation.episodes_per_goal=1",
        "evaluation.max_steps=5",
    ]
    start(example, *settings, "total_frames=96", folder=tmp_path / "whole")
    start(example, *settings, "total_frames=48", folder=tmp_path / "parts")
    path = tmp_path / "parts" / "checkpoint.pt"
    start(example, f"resume={path}", "total_frames=96", folder=tmp_path / "parts")
    whole, parts = load_checkpoint(tmp_path / "whole" / "checkpoint.pt"), load_checkpoint(path)
    assert (whole["frames"], parts["frames"]) == (96, 96)
    for name, value in whole["agent"].items():
        assert torch.equal(value, parts["agent"][name]), name
    steps = max(int(state["step"]) for state in whole["optimizer"]["state"].values())
    assert steps == (12 if example == "algorithm" else 4)
    with open(tmp_path / "parts" / "metrics.csv", newline="") as file:
        assert all(float(row[column]) != 0 for row in csv.DictReader(file))
    assert (tmp_path / "parts" / "evaluation.csv").is_file()
    if example == "model":
        with pytest.raises(VusfaError, match="model is 'gated'"):  # nothing is imported for it
            load_agent(path)
        monkeypatch.setattr("vusfa.modules.config.MODELS", dict(MODELS))
        runpy.run_path(str(EXAMPLES / "model.py"))
    load_agent(path)


def test_what_a_script_does_not_register_is_refused(
    scene_file: Path, tmp_path: Path, start: Callable[..., None], program: Any
):
    """A checkpoint names an algorithm; nothing is imported for it."""
    sizes = ["agent.hidden_size=8", "agent.embedding_size=8", "collector.num_envs=5", "collector.rollout=4"]
    more = ["algorithm=ppo", f"scenes=[{scene_file}]", "total_frames=20", "evaluation=none"]
    start("algorithm", *sizes, *more, "env.goals=[3,9,12]", folder=tmp_path / "run")
    resume = f"resume={tmp_path / 'run' / 'checkpoint.pt'}"
    done = program("examples/extending/loss_term.py", resume, folder=tmp_path)
    assert done.returncode == 2
    assert "algorithm.name is 'ppo': no such algorithm is registered" in done.stderr
    assert done.stderr.count("\n") == 1
