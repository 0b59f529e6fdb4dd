"""Every suite runs small and yields the rows and requirements that it promises. Nothing is said of speed."""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
import torch
from typer.testing import CliRunner

from benchmarks.report import Options, Report, read_reports
from benchmarks.solve_suite import train_until
from benchmarks.worlds import tiled

QUICK = Options(quick=True, repetitions=1, seconds=0.0, threads=1, cap=1.0)

PROMISED = {
    "env_suite": [
        "TargetNavEnv, 16 environments",
        "bare loop, 16",
        "ParallelEnv, 2 workers",
        "AsyncVectorEnv, 2",
    ],
    "collect_suite": ["collection, 8 environments", "collection, bare loop", "collection, features"],
    "update_suite": [
        "updates, 1 frame",
        "updates, 4 frames, SB3 A2C, 5 steps",
        "updates, 4 frames, features",
        "updates, preset=paper, bare update",
    ],
    "solve_suite": [
        "time to solve, gvf",
        "time to solve, vusfa",
        "time to solve, SB3 A2C",
        "time to solve, SB3 PPO",
    ],
    "precision_suite": [r"updates, AVX2 alone \(imitated\), autocast=auto"],
    "memory_suite": [
        "collector: a frame as ids",
        "worker pipes: a frame as features",
        "peak",
        "growth over 20",
    ],
    "scaling_suite": [
        r"rooms in memory \(580 states\)",
        r"rooms in files \(240 states\)",
        "in files, to open",
    ],
}


@pytest.fixture(autouse=True)
def _threads():
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.filterwarnings("ignore")  # of Gymnasium and Stable-Baselines3
@pytest.mark.usefixtures("fast_workers")
@pytest.mark.parametrize("name", PROMISED)
def test_a_suite_yields_its_rows(name: str):
    if name == "memory_suite":  # whose workers begin in processes of the server
        torch.multiprocessing.set_start_method("fork", force=True)
    report: Report = import_module(f"benchmarks.{name}").run(QUICK)
    names = [row.name for row in report.rows]
    for pattern in PROMISED[name]:
        assert any(re.search(pattern, found) for found in names), (pattern, names)
    assert all(row.value > 0 or math.isnan(row.value) or "growth" in row.name for row in report.rows)
    assert all(row.ratio is None or row.ratio > 0 for row in report.rows)


def test_the_gpu_suite_says_why_it_is_skipped(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert import_module("benchmarks.gpu_suite").run(QUICK).skipped == "this machine has no CUDA device"


def test_the_command_writes_a_file(tmp_path: Path):
    import typer

    from benchmarks.run import main

    app = typer.Typer()
    app.command()(main)
    result = CliRunner().invoke(app, ["--suite", "eval", "--quick", "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    assert "zero-shot evaluation" in result.output
    (report,) = read_reports(tmp_path / "eval.json")
    assert report.suite == "eval"
    assert any(re.search("zero-shot evaluation, .*one episode at a time", row.name) for row in report.rows)
    assert all(row.value > 0 and (row.ratio is None or row.ratio > 0) for row in report.rows)


@pytest.mark.skipif(
    torch.backends.cpu.get_cpu_capability() not in ("AVX2", "AVX512"), reason="a processor without AVX2"
)
def test_a_processor_without_bfloat16_is_imitated_in_a_process_of_its_own(tmp_path: Path):
    script = Path(__file__).parents[2] / "benchmarks" / "run.py"
    command = [sys.executable, str(script), "--suite", "gpu", "--quick", "--avx2", "--out", str(tmp_path)]
    subprocess.run(command, check=True, capture_output=True, env={**os.environ, "CUDA_VISIBLE_DEVICES": ""})
    content = json.loads((tmp_path / "gpu-avx2.json").read_text())
    assert content["options"]["avx2"]
    assert content["machine"]["capability"] == "AVX2"


def test_time_of_checks_does_not_count_and_the_cap_does():
    now = [0.0]

    def update() -> int:
        now[0] += 1.0
        return 10

    def check() -> tuple[float, float]:
        now[0] += 100.0
        return (0.96, 1.2) if now[0] > 250 else (0.5, 1.0)

    solved = train_until(update, check, cap=50, every=5, clock=lambda: now[0])
    assert (solved.seconds, solved.frames) == (15.0, 150)
    given_up = train_until(update, lambda: (0.5, 1.0), cap=7, every=5, clock=lambda: now[0])
    assert math.isnan(given_up.seconds)
    assert given_up.spent == 7
    ended = train_until(update, lambda: (0.5, 1.0), cap=99, every=99, most_frames=30, clock=lambda: now[0])
    assert ended.frames == 30


def test_tiles_are_rooms_of_their_own():
    scenes = tiled(9)
    assert scenes.num_states == 2 * 1712 + 176
    assert scenes.distance(torch.tensor([0]), torch.tensor([1712])).item() == -1
