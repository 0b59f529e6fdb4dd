from __future__ import annotations

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
