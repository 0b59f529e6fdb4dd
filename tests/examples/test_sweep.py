"""examples/sweep.yaml: what its agent would run is a command line of vusfa train."""

from __future__ import annotations

from pathlib import Path

import pytest
from wandb.sdk.launch.sweeps.utils import create_sweep_command_args, load_sweep_config

from vusfa.conf.schema import check_overrides, validated
from vusfa.training.run import SCORE

SWEEP = Path(__file__).parents[2] / "examples" / "sweep.yaml"


@pytest.mark.filterwarnings("default")  # wandb leaves the file open
@pytest.mark.parametrize("choose", [min, max])
def test_its_commands_are_settings_of_vusfa_train(settings, choose) -> None:
    sweep = load_sweep_config(str(SWEEP))
    assert sweep is not None
    assert (sweep["method"], sweep["metric"]) == ("bayes", {"name": SCORE, "goal": "maximize"})
    chosen = {
        name: {"value": choose(space.get("values") or (space["min"], space["max"]))}
        for name, space in sweep["parameters"].items()
    }
    start, *fixed, last = sweep["command"]
    assert (start, fixed[:2], last) == ("${env}", ["vusfa", "train"], "${args_no_hyphens}")
    overrides = [*fixed[2:], *create_sweep_command_args({"args": chosen})["args_no_hyphens"]]
    check_overrides(overrides)
    made = validated(settings(*overrides))
    assert made["logger"]["kinds"] == ["csv", "wandb"]
    assert made["optim"]["lr"] == chosen["optim.lr"]["value"]
    assert made["evaluation"]["interval"] == "auto"  # the sweep's metric is logged
