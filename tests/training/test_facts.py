from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import pytest
import torch

from vusfa.training import machine_facts, run_facts


def test_facts_of_a_checkpoint() -> None:
    state: dict[str, Any] = {
        "config": {
            "agent": {"model": "usfa", "architecture": "paper"},
            "hindsight": {"updates": 0},
            "seed": 4,
            "threads": 1,
            "autocast": True,
            "device": "cpu",
        },
        "scenes": {"names": ["hall"], "fingerprint": "abc"},
        "goals": torch.tensor([3, 5]),
        "frames": 1280,
        "updates": 1,
        "seconds": 2.34,
    }
    facts = run_facts(state, ["seed=4"])
    wanted = {"model": "usfa", "row": "usfa", "seed": 4, "trained_goals": [3, 5], "frames": 1280}
    assert {key: facts[key] for key in wanted} == wanted
    assert facts["training_s"] == pytest.approx(2.3)
    assert (facts["overrides"], facts["precision"]) == (["seed=4"], "bfloat16")


def test_facts_of_the_machine() -> None:
    facts = machine_facts()
    assert facts["versions"]["torch"] == torch.__version__
    assert facts["cores"] >= 1
    assert facts["processor"]


def test_facts_name_the_commit_of_a_checkout(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def git(*words: str) -> str:
        command = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b.c", *words]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    monkeypatch.setattr("vusfa.training.facts.__file__", str(tmp_path / "vusfa" / "training" / "facts.py"))
    assert machine_facts()["commit"] is None
    git("init", "-q")
    assert machine_facts()["commit"] is None  # nothing is committed yet
    git("commit", "-q", "--allow-empty", "-m", "first")
    assert machine_facts()["commit"] == git("rev-parse", "HEAD")
