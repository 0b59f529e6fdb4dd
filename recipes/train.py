"""Trains one of the four models: python recipes/train.py agent.model=vusfa scenes=[bathroom]

Settings are in vusfa/conf/train.yaml and the folders beside it. The run's folder gets metrics.csv and
checkpoint.pt, and at the end evaluation.csv, .json and evaluation_episodes.csv. To go on: python
recipes/train.py resume=RUN/checkpoint.pt
"""

from __future__ import annotations

from typing import Any

from vusfa.cli.launch import launch
from vusfa.experiments.training import train
from vusfa.files import say


def main(settings: dict[str, Any], overrides: list[str]) -> int:
    """Trains and evaluates, and says where the results are."""
    trainer, _, exit_code = train(settings, overrides)
    say(f"{trainer.settings['folder']}/checkpoint.pt")
    return exit_code


if __name__ == "__main__":
    launch(main)
