"""Bands of learning curves."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vusfa.report.curves import band, learning_curves
from vusfa.report.runs import LoggedRun


def test_a_band_goes_as_far_as_all_of_its_curves():
    short = (np.array([10.0, 20.0]), np.array([1.0, 3.0]))
    long = (np.array([0.0, 20.0, 40.0]), np.array([0.0, 2.0, np.nan]))
    found = band([short, long, (np.array([15.0]), np.array([np.nan]))])
    assert found["x"] == [10, 20]
    assert found["mean"] == [1, 2.5]
    assert found["low"] == [1, 2]
    assert found["high"] == [1, 3]
    assert band([(np.array([0.0, 5.0]), np.ones(2)), (np.array([6.0, 9.0]), np.ones(2))])["x"] == []


def test_long_logs_are_thinned():
    x = np.arange(5000.0)
    found = band([(x, x)], points=100)
    assert 50 <= len(found["x"]) <= 100
    assert found["x"][0] == 0
    assert found["x"][-1] == 4999
    assert band([]) == {"x": [], "mean": [], "low": [], "high": []}


def test_seeds_of_one_model_are_one_curve():
    def run(label: str, seed: int, success: list[float]) -> LoggedRun:
        log = {"frames": np.array([100.0, 200.0]), "seconds": np.array([60.0, 180.0 + 120 * seed])}
        log |= {"success": np.array(success), "scene/hall/success": np.array(success), "unknown": np.ones(2)}
        return LoggedRun(label, seed, Path(), {}, log)

    found = learning_curves([run("a", 0, [0.0, 1.0]), run("a", 1, [1.0, 1.0]), run("b", 0, [0.5, np.nan])])
    curves = {(curve["model"], curve["name"]): curve for curve in found}
    assert curves.keys() == {(m, n) for m in "ab" for n in ("success", "scene/hall/success")}
    assert curves["a", "success"]["mean"] == [0.5, 1.0]
    assert curves["a", "success"]["low"] == [0.0, 1.0]
    assert curves["a", "success"]["minutes"] == [1.0, 4.0]
    assert curves["a", "success"]["seeds"] == 2
    assert curves["b", "success"]["x"] == [100]


def test_a_run_without_a_log_has_no_curve():
    assert learning_curves([LoggedRun("a", 0, Path(), {})]) == []
