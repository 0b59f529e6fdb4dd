"""Trains VUSFA on the bundled bathroom's five goals, evaluates it, films a walk: make demo, or python
recipes/demo.py

Settings are in vusfa/conf/demo.yaml. Everything goes to the folder demo: the checkpoint, the tables,
walk.gif, curve.png.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from vusfa.cli.launch import launch
from vusfa.evaluation.baselines import RANDOM_WALK
from vusfa.experiments.training import train
from vusfa.report.curve import plot_curve
from vusfa.report.film import draw_film, longest_success, record_walk, write_gif
from vusfa.report.media import draw_media


def demo(settings: dict[str, Any], overrides: list[str]) -> int:
    """Trains as recipes/train.py does; then the film and the curve."""
    trainer, result, exit_code = train(settings, overrides, draw_media)
    if result is None:
        return exit_code
    folder, agent, scenes = Path(trainer.settings["folder"]), trainer.agent.eval(), trainer.scenes
    made, within = [], f"success_{settings['evaluation']['max_steps']}"
    if (folder / "metrics.csv").is_file():  # nothing is logged when there was nothing left to train
        rows = [row for row in result.rows if (row["policy"], row["goals"]) == (RANDOM_WALK, "trained")]
        random_walk = rows[0][within] if rows else None
        model = settings["agent"]["model"]
        made.append(plot_curve(folder / "metrics.csv", folder / "curve.png", random_walk, model))
    found = longest_success(result.episodes, scenes)
    if found is not None:
        start, goal = found
        trail = record_walk(agent.get_policy_operator(), scenes, start, goal, history=agent.config["history"])
        made.append(write_gif(folder / "walk.gif", draw_film(scenes, trail, goal)))
    for path in [*made, folder / "evaluation.csv", folder / "checkpoint.pt"]:
        print(path)
    return exit_code


if __name__ == "__main__":
    launch(demo, name="demo")
