"""Evaluation during a training: exact, due when it should be, no part of the training; the best is kept."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf
from PIL import Image

from vusfa.cli.launch import compose
from vusfa.errors import ResultError, SceneError
from vusfa.evaluation.exact import exact_goals, expected_walks, sampled_walks, uniform_probabilities
from vusfa.evaluation.navigation import evaluate
from vusfa.experiments import training as training_module
from vusfa.experiments.manifest import read_manifest
from vusfa.experiments.training import train
from vusfa.experiments.validation import Validation
from vusfa.modules import InferencePolicy, TabularPolicy
from vusfa.report.media import draw_media
from vusfa.scenes import SceneSet
from vusfa.training import Trainer, load_checkpoint, make_loggers, make_trainer
from vusfa.training.run import SCORE

Made = Callable[..., dict[str, Any]]


@pytest.fixture
def made(scene_file: Path, tmp_path: Path) -> Made:
    """Settings of a training of a second."""

    def make(*overrides: str, folder: str = "run") -> dict[str, Any]:
        small = [f"scenes=[{scene_file}]", "env.goals=[3,9,12]", "env.max_steps=20", "agent.hidden_size=8"]
        small += ["agent.embedding_size=8", "agent.history=1", "collector.num_envs=6", "collector.rollout=4"]
        small += ["total_frames=240", "log_every=24", "evaluation.goals=null", "evaluation.max_steps=40"]
        small += ["autocast=false", f"folder={tmp_path / folder}"]
        return OmegaConf.to_container(compose(overrides=[*small, *overrides]), resolve=True)  # type: ignore[return-value]

    return make


def log(folder: Path) -> list[dict[str, str]]:
    with open(folder / "metrics.csv", newline="") as file:
        return [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)]


@pytest.fixture
def validation(made: Made) -> Validation:
    return Validation(make_trainer(made()), make_loggers([], "run", {}, run_id="a"))


@pytest.mark.parametrize(
    "options",
    [
        [],
        ["agent.history=2", "agent.model=vusfa"],
        ["agent.model=vusfa", "algorithm=hindsight", "hindsight.batch_size=16", "hindsight.updates=2"],
    ],
    ids=["one frame", "two frames", "hindsight"],
)
def test_it_does_not_touch_the_training(made: Made, tmp_path: Path, options: list[str]) -> None:
    states = []
    for interval in ("null", "72"):
        train(made(*options, f"evaluation.interval={interval}", folder=interval))
        states.append(load_checkpoint(tmp_path / interval / "checkpoint.pt"))
    without, with_ = states
    assert without["validation"]["frames"] == 0
    assert with_["validation"]["frames"] == 240
    for part in ("agent", "rng"):
        assert str(without[part]) == str(with_[part]), part
    for name, weight in without["agent"].items():
        assert torch.equal(weight, with_["agent"][name]), name
    plain, evaluated = log(tmp_path / "null"), log(tmp_path / "72")
    assert plain == [{k: row[k] for k in plain[0]} for row in evaluated]
    pairs = [(row["eval/validation/spl"], row["eval/validation/success"]) for row in evaluated]
    assert [bool(spl) for spl, _ in pairs] == [False] * 2 + [True, False, False] * 2 + [True] * 2
    assert all(0 <= float(spl) <= float(success) <= 1 for spl, success in pairs if spl)


def test_the_best_checkpoint_is_kept_beside_the_last(made: Made, tmp_path: Path) -> None:
    train(made("evaluation.interval=24", "optim.lr=0.01"))
    rows = log(tmp_path / "run")
    scores = [float(row[SCORE]) for row in rows]
    best, last = (load_checkpoint(tmp_path / "run" / name) for name in ("best.pt", "checkpoint.pt"))
    assert best["frames"] == int(rows[scores.index(max(scores))]["frames"])
    assert last["validation"]["best"] == max(scores) == best["validation"]["best"]
    assert last["frames"] == 240


def test_resuming_goes_on_with_it(made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options = ["evaluation.interval=48", "optim.lr=0.01", "checkpoint_every=1000"]
    train(made(*options, folder="whole"))

    class Interruption:
        exit_code, asked = 143, 0
        __enter__ = lambda self: self  # noqa: E731
        __exit__ = lambda self, *_: None  # noqa: E731

        @property
        def received(self) -> bool:
            self.asked += 1
            return self.asked > 9

    with monkeypatch.context() as patch:
        patch.setattr(training_module, "StopOnSignal", Interruption)
        assert train(made(*options, folder="parts")).exit_code == 143
    path = tmp_path / "parts" / "checkpoint.pt"
    assert load_checkpoint(path)["validation"]["frames"] == 192
    train(made(*options, f"resume={path}", folder="parts"))
    assert log(tmp_path / "parts") == log(tmp_path / "whole")
    whole, parts = (load_checkpoint(tmp_path / name / "best.pt") for name in ("whole", "parts"))
    assert whole["frames"] == parts["frames"]
    for name, weight in whole["agent"].items():
        assert torch.equal(weight, parts["agent"][name]), name


def test_auto_takes_a_twentieth_of_the_time_at_most(validation: Validation) -> None:
    trainer = validation._trainer
    trainer.settings = {**trainer.settings, "total_frames": 2000}
    spent = trainer.validation
    trainer.frames, trainer.seconds = 99, 0.0
    assert not validation._is_due(False)
    trainer.frames = 100
    assert validation._is_due(False)  # the first, whatever it takes
    spent |= {"frames": 100, "seconds": 1.0, "last_seconds": 1.0}
    trainer.frames, trainer.seconds = 250, 39.0
    assert not validation._is_due(False)
    trainer.seconds = 41.0  # a twentieth is more than what two take
    assert validation._is_due(False)
    trainer.frames, trainer.seconds = 199, 1000.0
    assert not validation._is_due(False)
    assert validation._is_due(True)  # the last, whatever it takes
    validation.interval, trainer.seconds = 150, 0.0
    assert validation._is_due(False)
    validation.interval = None
    assert not validation._is_due(True)


def test_not_due_is_nan_under_the_same_names(validation: Validation) -> None:
    nothing = validation(False)
    assert all(math.isnan(value) for value in nothing.values())
    assert nothing.keys() == validation.measure().keys()
    assert SCORE in nothing


def test_validation_goals_are_none_of_the_trained(validation: Validation, made: Made) -> None:
    trained, unseen = (set(validation.goals[chosen].tolist()) for chosen in validation.subsets.values())
    assert trained == {3, 9, 12}
    assert len(unseen) == 5
    assert not trained & unseen
    every = Validation(make_trainer(made("env.goals=all")), make_loggers([], "run", {}, run_id="a"))
    assert [int(chosen.sum()) for chosen in every.subsets.values()] == [16, 5]


def test_in_the_bundled_rooms_they_are_those_that_choose_the_checkpoints_of_table_1() -> None:
    overrides = ["agent.hidden_size=8", "agent.embedding_size=8", "autocast=false"]
    settings: Any = OmegaConf.to_container(compose(overrides=overrides), resolve=True)
    trainer = make_trainer(settings)
    validation = Validation(trainer, make_loggers([], "run", {}, run_id="a"))
    held_out = read_manifest().episodes(trainer.scenes, validation=True)[1].unique()
    assert torch.equal(validation.goals[validation.subsets["validation"]], held_out)
    assert torch.equal(validation.goals[validation.subsets["trained"]], trainer.goals.unique())


def test_exact_and_sampled_agree(rooms: SceneSet, validation: Validation) -> None:
    trainer = validation._trainer
    table = TabularPolicy(trainer.agent, trainer.scenes)
    goals = torch.tensor([3, 9])
    exact = expected_walks(table.probabilities, trainer.scenes, goals, 30)
    policy = InferencePolicy(trainer.agent)
    episodes = evaluate(policy, trainer.scenes, goals, episodes_per_goal=3000, max_steps=30, history=1)
    sampled = sampled_walks(episodes, trainer.scenes, goals)
    for name in ("length", "success", "spl", "shortest", "from_start"):
        one, other = getattr(exact, name), getattr(sampled, name)
        torch.testing.assert_close(one, other, rtol=0.08, atol=0.08, equal_nan=True)
    assert exact.length_ratio == pytest.approx(sampled.length_ratio, rel=0.08)


def test_spl_and_success_by_start_are_those_of_the_table_of_all_goals(rooms: SceneSet) -> None:
    walk = uniform_probabilities(4)
    every, goals = exact_goals(walk, rooms, within=(), max_steps=40), torch.tensor([2, 7, 18])
    first = rooms.scenes[0].num_states
    rows = [
        int(((every.scene == s) & (every.goal == g)).nonzero()) for s, g in ((0, 2), (0, 7), (1, 18 - first))
    ]
    walks = expected_walks(None, rooms, goals, 40)
    torch.testing.assert_close(walks.spl, every.metrics["spl"][rows], atol=1e-9, rtol=1e-9)
    here = rooms.scenes[1].distance[:, 18 - first] > 0
    torch.testing.assert_close(walks.from_start[first:][here].mean(), walks.success[2], atol=1e-9, rtol=1e-9)


@pytest.mark.parametrize("algorithm", ["usf", "hindsight"])
def test_an_agent_below_the_random_walk_gets_advice(
    made: Made, algorithm: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    measure = Validation.measure

    def lost(self: Validation) -> dict[str, float]:
        self.latest = measure(self) | {"eval/validation/success": 0.25}
        return self.latest

    monkeypatch.setattr(Validation, "measure", lost)
    train(made(f"algorithm={algorithm}", "hindsight.batch_size=8"))
    line = capsys.readouterr().err.splitlines()[-1]
    assert "below the random walk: the agent reaches 25.0 % of the validation goals, a random walk 7" in line
    assert ("preset=replay_search" in line) == (algorithm == "usf")
    assert ("total_frames" in line) == (algorithm == "hindsight")


def test_no_advice_above_it_and_without_evaluation(
    made: Made, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    train(made("evaluation.interval=null"))
    assert capsys.readouterr().err.splitlines()[-1] == str(tmp_path / "run" / "checkpoint.pt")
    validation = Validation(make_trainer(made()), make_loggers([], "run", {}, run_id="a"))
    validation.latest = {f"eval/{name}/success": 1.0 for name in ("trained", "validation")}
    assert validation.advice() is None


def test_a_full_disk_leaves_the_checkpoint_and_no_part_of_the_best(
    made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(source: Path, target: Path) -> None:
        Path(target).write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("shutil.copyfile", full)
    with pytest.raises(ResultError, match=r"best\.pt: cannot be written \(No space left on device\)"):
        train(made("evaluation.interval=24", "total_frames=48"))
    assert not list((tmp_path / "run").glob(".best*"))
    assert not (tmp_path / "run" / "best.pt").exists()
    assert load_checkpoint(tmp_path / "run" / "checkpoint.pt")["frames"] == 24


@pytest.mark.parametrize("error", [SceneError("hall.h5: no such file"), OSError(5, "Input/output error")])
def test_pictures_that_cannot_be_drawn_end_no_training(
    made: Made, error: Exception, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[int] = []

    def draw(trainer: Trainer, *_: torch.Tensor) -> dict[str, bytes]:
        asked.append(trainer.frames)
        raise error

    settings = made("evaluation.interval=24", "total_frames=72", "logger=tensorboard")
    assert train(settings, [], draw).exit_code == 0
    assert asked == [24]
    assert "warning: films and maps cannot be drawn" in capsys.readouterr().err


def test_media_show_the_floor_by_place_and_a_walk(validation: Validation) -> None:
    trainer, goals = validation._trainer, torch.tensor([5])
    before = torch.get_rng_state()
    media = draw_media(trainer, (torch.arange(16) < 4).double(), goals)  # success from the first place only
    assert torch.equal(before, torch.get_rng_state())
    floor = Image.open(io.BytesIO(media["eval/floor/hall"])).convert("RGB")
    dark, light = floor.getpixel((100, 200)), floor.getpixel((200, 100))  # lower left, upper right
    assert sum(dark) < 200
    assert sum(light) > 600
    with Image.open(io.BytesIO(media["eval/walk"])) as film:
        assert 2 <= film.n_frames <= 41
