"""recipes/demo.py, small."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image


def test_the_demo_leaves_a_film_a_curve_and_tables(
    recipe, settings, small, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    small.remove("evaluation=none")
    more = [
        "total_frames=1200",
        "evaluation.episodes_per_goal=4",
        "evaluation.max_steps=60",
        f"folder={tmp_path / 'demo'}",
    ]
    assert recipe("demo").demo(settings(*small, *more, name="demo"), []) == 0
    printed = capsys.readouterr().out
    for name in ("curve.png", "walk.gif", "evaluation.csv", "checkpoint.pt"):
        assert (tmp_path / "demo" / name).is_file()
        assert name in printed.replace("\n", "")
    with Image.open(tmp_path / "demo" / "walk.gif") as film:
        assert film.n_frames >= 2
    assert "trained goals" in printed
    assert "random walk" in printed


def test_its_settings_are_the_bathrooms_five_goals(settings):
    cfg = settings(name="demo")
    assert (list(cfg.scenes), cfg.env.goals, cfg.agent.model, cfg.agent.architecture) == (
        ["bathroom"],
        "paper",
        "vusfa",
        "controlled",
    )
    assert (cfg.evaluation.goals, cfg.folder) == ("all", "demo")
