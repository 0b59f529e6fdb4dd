"""Every suite runs small and yields the rows and requirements that it promises. Nothing is said of speed."""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

import pytest
import torch
from tensordict.nn import TensorDictModule
from typer.testing import CliRunner

from benchmarks.peers.sb3 import make_sb3, sb3_actions
from benchmarks.report import Options, Report, read_reports, write_reports
from benchmarks.solve_checks import check_of_sb3, check_of_trainer
from benchmarks.solve_suite import Outcome, make_report, train_until
from benchmarks.trainer import running
from benchmarks.worlds import tiled
from vusfa.envs import resolve_goals
from vusfa.evaluation import evaluate
from vusfa.evaluation.metrics import get_metric
from vusfa.scenes import SceneSet

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


def test_checks_count_for_the_cap_and_not_for_the_result():
    now = [0.0]
    told: list[Outcome] = []

    def update() -> int:
        now[0] += 1.0
        return 10

    def check(*values: tuple[float, float], seconds: float = 2.0) -> Callable[[], tuple[float, float]]:
        later = iter(values)

        def checked() -> tuple[float, float]:
            now[0] += seconds
            return next(later, (0.5, 1.0))

        return checked

    clock = {"clock": lambda: now[0]}
    solved = train_until(update, check((0.5, 1.0), (0.96, 1.2)), cap=50, every=5, tell=told.append, **clock)
    assert (solved.seconds, solved.frames) == (10.0, 100)  # with its checks 14 seconds
    assert [outcome.frames for outcome in told] == [50, 100]
    began = now[0]
    given_up = train_until(update, check(), cap=12, every=5, **clock)
    assert math.isnan(given_up.seconds)
    # 5 s and a check of 2, 3 s and the last check: any later would end after the cap
    assert (given_up.spent, now[0] - began) == (8.0, 12.0)
    ended = train_until(update, check(), cap=99, every=99, most_frames=30, **clock)
    assert ended.frames == 30
    slow: list[Outcome] = []
    train_until(update, check(seconds=10.0), cap=60, every=2, tell=slow.append, **clock)
    # 2 s, then as many seconds of training as a check takes: checks are half at most, but for the first
    assert [outcome.spent for outcome in slow] == [2.0, 12.0, 22.0]


def outcome(seconds: float, spent: float | None = None) -> Outcome:
    return Outcome(seconds, seconds if spent is None else spent, 100, 0.5, 1.2)


def test_an_interrupted_measurement_has_what_has_ended():
    assert make_report({"SB3 A2C": [], "gvf": []}).rows == []
    nan = math.nan
    done = {
        "SB3 A2C": [outcome(nan, 50.0), outcome(40.0)],
        "SB3 PPO": [outcome(nan, 60.0)],  # the second repetition has not come so far
        "gvf": [outcome(5.0)],
        "usfa": [],
    }
    report = make_report(done)
    assert [row.name.removeprefix("time to solve, ") for row in report.rows] == ["gvf", "SB3 A2C", "SB3 PPO"]
    gvf, a2c, ppo = report.rows
    assert (gvf.value, gvf.ratio, gvf.samples) == (5.0, 10.0, (5.0,))  # 50 s: the least that SB3 needed
    assert math.isnan(a2c.value)
    assert "1 of 2 solved" in a2c.note
    assert math.isnan(ppo.value)
    assert [line.value for line in report.requirements] == [5 / 60, 0.1]
    alone = make_report({"SB3 A2C": [], "gvf": [outcome(5.0)]})
    assert alone.rows[0].ratio is None


def test_exact_checks_agree_with_episodes():
    """With as many sampled episodes as leave an error of a few percent."""
    scenes = SceneSet.bundled(["bathroom"])
    model = make_sb3("A2C", scenes, num_envs=4, width=8, history=1, n_steps=3)
    goals = resolve_goals(scenes, "paper")
    exact = check_of_sb3(model, scenes, goals, 1, Options())()
    walked = _sampled_sb3(model, scenes, goals)
    assert exact[0] == pytest.approx(walked[0], abs=0.08)
    assert exact[1] == pytest.approx(walked[1], rel=0.25)
    recipe = ["scenes=[bathroom]", "agent.hidden_size=8", "agent.embedding_size=8", "collector.num_envs=4"]
    with running(recipe) as ours:
        trainer = ours.trainer
        own = check_of_trainer(trainer, Options())()
        episodes = evaluate(trainer.actor, scenes, trainer.goals, episodes_per_goal=40, history=1)
        assert trainer.agent.training
    assert own[0] == pytest.approx(get_metric("success_500").value(episodes), abs=0.08)
    assert own[1] == pytest.approx(get_metric("length_ratio").value(episodes), rel=0.25)


def _sampled_sb3(model: Any, scenes: SceneSet, goals: torch.Tensor) -> tuple[float, float]:
    def act(state: torch.Tensor, goal: torch.Tensor, scene: torch.Tensor) -> torch.Tensor:
        return sb3_actions(model, {"state_id": state, "goal_id": goal, "scene_id": scene})

    policy = TensorDictModule(act, in_keys=["state_id", "goal_id", "scene_id"], out_keys=["action"])
    episodes = evaluate(policy, scenes, goals, episodes_per_goal=40, history=1)
    return get_metric("success_500").value(episodes), get_metric("length_ratio").value(episodes)


@pytest.mark.filterwarnings("ignore")  # of Stable-Baselines3
def test_results_are_written_as_soon_as_they_are_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    import benchmarks.solve_suite as suite
    from benchmarks import run

    def die(*_: object, **__: object) -> NoReturn:
        raise KeyboardInterrupt

    trained = iter([lambda *_, **__: outcome(7.0), die])
    monkeypatch.setattr(suite, "train_until", lambda *args, **options: next(trained)(*args, **options))
    with pytest.raises(KeyboardInterrupt):
        run.measure("solve", QUICK, partial(write_reports, tmp_path / "solve.json", {}, QUICK))
    (report,) = read_reports(tmp_path / "solve.json")
    assert [row.name for row in report.rows] == ["time to solve, SB3 A2C"]


def test_tiles_are_rooms_of_their_own():
    scenes = tiled(9)
    assert scenes.num_states == 2 * 1712 + 176
    assert scenes.distance(torch.tensor([0]), torch.tensor([1712])).item() == -1
