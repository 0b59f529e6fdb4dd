"""What the benchmarks train is what the recipe trains."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch

from benchmarks.trainer import recipe_settings, running
from vusfa.training import load_checkpoint


@pytest.mark.parametrize("model", ["gvf", "vusfa"])
def test_weights_are_those_of_the_recipe(model: str, tiny, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "recipes"))
    from train import train

    overrides = tiny(f"agent.model={model}", "total_frames=72", "evaluation=none")
    threads = torch.get_num_threads()
    train(recipe_settings([*overrides, f"folder={tmp_path}"]), overrides)
    sys.modules.pop("train")
    theirs = load_checkpoint(tmp_path / "checkpoint.pt")["agent"]
    # with the recipe's number of threads still: another one sums in another order
    with running(overrides) as measured:
        assert [measured.update() for _ in range(3)] == [24, 24, 24]
    torch.set_num_threads(threads)
    ours = measured.trainer.agent.state_dict()
    assert ours.keys() == theirs.keys()
    for name, value in ours.items():
        torch.testing.assert_close(value, theirs[name], rtol=0, atol=0)
