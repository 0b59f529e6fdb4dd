"""Trains one of the four models: python recipes/train.py agent.model=vusfa scenes=[bathroom]

Settings are in vusfa/conf/train.yaml and the folders beside it. The run's folder gets metrics.csv,
checkpoint.pt and best.pt, and at the end evaluation.csv, .json and evaluation_episodes.csv. To go on: python
recipes/train.py resume=RUN/checkpoint.pt
"""

from __future__ import annotations

from typing import Any

from vusfa.cli.launch import launch
from vusfa.cli.ray_train import train_on_ray
from vusfa.experiments.training import train
from vusfa.report.media import draw_media


def main(settings: dict[str, Any], overrides: list[str]) -> int:
    """Train and evaluate, here or on a cluster."""
    if settings["cluster"]["kind"]:
        return train_on_ray(settings, overrides, draw_media)
    return train(settings, overrides, draw_media).exit_code


if __name__ == "__main__":
    launch(main)
