"""The model of many learners, from constants of which the answer is known."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from benchmarks.scaling_model import BEGIN, END, NETWORKS, Network, Update, check, predict, reduce

NAME = "ids, 4 frames"
VALUES = {
    "an update's fixed time": 0.1, "an update's time per frame": 1e-5, "frames of an update per rank": 10_000,
    "gradient": 4e6, "operations of an update": 1e6, "torch calls of an update": 1000,
    "steps of a rollout": 50, "opening scenes": 1e-4, "features of a state": 8192,
    "all-reduce of one number": 2e-4, "all-reduce of the gradient": 4.2e-3,
    f"{NAME}: 1 rank": 50_000.0, f"{NAME}: 2 ranks, as many environments each": 90_000.0,
    f"{NAME}: 2 ranks, as many in all": 60_000.0,
}  # fmt: skip


@pytest.fixture
def constants(tmp_path: Path) -> Path:
    path = tmp_path / "ranks.json"
    rows = [{"name": name, "value": value} for name, value in VALUES.items()]
    path.write_text(json.dumps({"suites": [{"rows": rows}]}))
    return path


def test_one_learner_is_what_was_measured_and_two_pay_the_all_reduce(constants: Path):
    update = Update.read(constants)
    assert update.seconds(1, update.loopback) == pytest.approx(0.2)
    assert reduce(update.gradient, 2, update.loopback) == pytest.approx(4.2e-3)
    found = check(update)
    assert found["1 rank"] == (pytest.approx(50_000), 50_000)
    assert found["2 ranks, as many environments each"][0] == pytest.approx(20_000 / 0.2042)
    assert found["2 ranks, as many in all"][0] == pytest.approx(10_000 / 0.1542)


def test_more_learners_never_beat_as_many_times_one_and_a_fixed_batch_saturates(constants: Path):
    update = Update.read(constants)
    curves = predict(update)
    bound = curves.pop("N times one")
    assert all(rate <= bound[n] * (1 + 1e-9) for curve in curves.values() for n, rate in curve.items())
    for name, network in NETWORKS.items():
        fixed = curves[f"{name}, 10,000 frames in all"]
        assert max(fixed.values()) < 10_000 / update.fixed
        assert fixed[1000] < max(fixed.values())  # the ring's latency
        assert update.seconds(1000, network) > update.seconds(2, network)
    assert update.on_gpus(8, 1000) < 8 * update.on_gpus(1, 1000)
    assert reduce(1e6, 1, Network(1.0, 1.0)) == 0


def test_the_page_gets_the_tables_that_are_printed(constants: Path, tmp_path: Path):
    import typer

    from benchmarks.scaling_model import main

    page = tmp_path / "page.md"
    page.write_text(f"before\n\n{BEGIN}\nold\n{END}\n\nafter\n")
    app = typer.Typer()
    app.command()(main)
    for _ in range(2):
        result = CliRunner().invoke(app, [str(constants), "--docs", str(page)])
        assert result.exit_code == 0, result.output
    text = page.read_text()
    assert text.startswith("before\n\n")
    assert text.endswith(f"{END}\n\nafter\n")
    assert "old" not in text
    assert "| 1 rank | 50,000 | 50,000 | 1.00 |" in text
    assert (tmp_path / "page.png").stat().st_size > 10_000
