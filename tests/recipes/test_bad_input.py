"""Bad input: one line that names the culprit and the mend, exit code not 0, nothing left behind."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from vusfa.cli.launch import launch
from vusfa.conf import FOLDER as CONF
from vusfa.scenes import Scene

RECIPES = Path(__file__).parents[2] / "recipes"


@pytest.fixture
def run(recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]):
    """``recipes/train.py`` in an empty folder; gives exit code and standard error."""
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)
    module = recipe("train")

    def launched(*arguments: str) -> str:
        monkeypatch.setattr("sys.argv", ["train.py", *arguments])
        with pytest.raises(SystemExit) as end:
            launch(module.main, CONF, "train")
        out, err = capfd.readouterr()
        assert end.value.code == 2, err
        assert list(work.rglob("*")) == []
        assert out == ""
        assert err.startswith("error: ")
        assert err.count("\n") == 1, err
        return err

    return launched


def test_a_truncated_scene(run, scene_file: Path):
    content = scene_file.read_bytes()
    scene_file.write_bytes(content[: len(content) // 2])
    text = run(f"scenes=[{scene_file}]")
    assert "hall.h5" in text
    assert "truncated" in text


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda file: file.pop("graph"), ["hall.h5", "'graph'", "missing"]),
        (lambda file: file["graph"].__setitem__((5, 2), 99), ["hall.h5", "'graph'", "state 5", "99"]),
        (
            lambda file: file["resnet_feature"].__setitem__((7, 0, 1), np.nan),
            ["'resnet_feature'", "state 7", "NaN"],
        ),
        (
            lambda file: file["shortest_path_distance"].__setitem__((2, 9), 1),
            ["shortest_path_distance", "state 2"],
        ),
    ],
    ids=["missing dataset", "index out of range", "NaN feature", "wrong distance"],
)
def test_a_damaged_scene(run, scene_file: Path, damage: Callable, words: list[str]):
    with h5py.File(scene_file, "r+") as file:
        damage(file)
    text = run(f"scenes=[{scene_file}]")
    for word in words:
        assert word in text


def test_an_unreachable_goal(run, tmp_path: Path):
    Scene("trap", torch.tensor([[1, -1], [0, -1], [0, -1]]), torch.rand(3, 1, 4)).save(tmp_path / "trap.h5")
    for kind in ("single", "multi_async"):
        text = run(
            f"scenes=[{tmp_path / 'trap.h5'}]",
            "env.goals=[2]",
            f"collector={kind}",
            "agent.hidden_size=8",
        )
        assert "scene 'trap': no other state can reach goal 2" in text


def test_a_goal_that_does_not_exist(run, scene_file: Path):
    assert "goal 16 is out of range" in run(f"scenes=[{scene_file}]", "env.goals=[3,16]")


def test_an_unknown_scene(run):
    text = run("scenes=[bathrom]")
    assert "'bathrom' is neither a bundled scene (bathroom" in text
    assert "none.h5" in run("scenes=[none.h5]")


@pytest.mark.parametrize(
    ("argument", "words"),
    [
        ("agent.modle=gvf", "no setting is called 'agent.modle'; did you mean 'agent.model'?"),
        ("optim.learning_rate=1", "no setting is called 'optim.learning_rate'"),
        ("agent.model=vufsa", "model is 'vufsa'; did you mean 'vusfa'"),
        ("preset=papr", "preset=papr: there is no such choice; did you mean 'paper'?"),
        ("collector.num_envs=many", "collector.num_envs is 'many'; it must be a whole number"),
        (
            "collector.kind=multi",
            "collector.kind is 'multi'; it must be one of single, multi_sync, multi_async, ray, hogwild",
        ),
        ("logger.kinds=[cvs]", "logger.kinds holds 'cvs'"),
        ("objective.gamma=1.5", "objective: USFEstimator: gamma is 1.5"),
        (
            "env.goal_sampling=fixed collector.num_envs=3",
            "leaves some of the 20 goals without an environment",
        ),
        ("agent.memory=gru", "memory is 'gru'"),
        ("device=gpu", "device is 'gpu'"),
        ("threads=0", "threads is 0; give 1 to 1,024"),
        ("+objective.foo=1", "no setting is called 'objective.foo'"),
        ("+foo=1", "no setting is called 'foo'"),
        ("++agnt.model=gvf", "no setting is called 'agnt.model'; did you mean 'agent.model'?"),
        ("+optim.foo=1", "no setting is called 'optim.foo'"),
        ("+evaluation.foo=1", "no setting is called 'evaluation.foo'"),
        ("+logger.foo=1", "no setting is called 'logger.foo'"),
        ("+agent.histroy=1", "no setting is called 'agent.histroy'; did you mean 'agent.history'?"),
        ("+optim.options.foo=1", "optim.kind=adam does not take"),
        ("log_every=0", "log_every is 0; it must be more than 0"),
        ("checkpoint_every=-5", "checkpoint_every is -5; it must be more than 0"),
        ("optim.horizon=0", "optim.horizon is 0; it must be more than 0"),
        ("entropy.horizon=-1", "entropy.horizon is -1; it must be more than 0"),
        ("agent.shared_heads=off", "agent.shared_heads is 'off'; it must be true or false"),
        ("agent.shared_heads=no", "agent.shared_heads is 'no'; it must be true or false"),
        ("objective.normalize_advantage=1", "objective.normalize_advantage is 1; it must be true or false"),
        ("early_stopping.success=1.5", "early_stopping.success is 1.5; it is a share of episodes, at most 1"),
        ("early_stopping.success=0", "early_stopping.success is 0.0; it must be more than 0"),
        ("early_stopping.every=-1", "early_stopping.every is -1; it must be more than 0"),
        ("autocast=off", "autocast is 'off'; give true, false or auto"),
        ("agent.history=abc", "agent.history is 'abc'; it must be a whole number, such as 1 or null"),
        ("algorithm=hindsite", "algorithm=hindsite: there is no such choice; did you mean 'hindsight'?"),
        ("+algorithm.foo=1", "no setting is called 'algorithm.foo'"),
        ("objective.terms.rewart=1", "no setting is called 'objective.terms.rewart'; did you mean"),
        ("env.collision_reward=abc", "env.collision_reward is 'abc'; it must be a number or null"),
        ("agent.initial_scale=abc", "agent.initial_scale is 'abc'; it must be a number"),
        ("scenes=null", "scenes is null; it must be a list, such as [bathroom"),
        ("scenes=[1]", "scenes is [1]; each entry must be as in [bathroom"),
        ("logger.kinds=null", "logger.kinds is null; it must be a list, such as [csv]"),
        ("logger.kinds=csv", "logger.kinds is 'csv'; it must be a list, such as [csv]"),
        ("optim.options=null", "optim.options is null; it is a group of settings: give optim.options.eps="),
        ("agent.model=null", "agent.model is null; it must be text, such as 'vusfa'"),
        ("agent.model=null preset=paper", "agent.model is null; it must be text, such as 'vusfa'"),
    ],
)
def test_an_unknown_key_or_value(run, argument: str, words: str):
    assert words in run(*argument.split())


@pytest.mark.parametrize("key", ["optim.horizon", "entropy.horizon", "optim.max_grad_norm"])
def test_a_documented_null_is_taken(
    recipe,
    small,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    key: str,
):
    arguments = [*small, "total_frames=48", f"folder={tmp_path / 'run'}", f"{key}=null"]
    monkeypatch.setattr("sys.argv", ["train.py", *arguments])
    with pytest.raises(SystemExit) as end:
        launch(recipe("train").main, CONF, "train")
    assert end.value.code == 0, capfd.readouterr().err


def test_a_damaged_checkpoint(run, tmp_path: Path):
    path = tmp_path / "checkpoint.pt"
    torch.save({"format": 1, "agent": torch.zeros(1000)}, path)
    path.write_bytes(path.read_bytes()[:3000])
    assert "checkpoint.pt: not a whole checkpoint (3000 bytes)" in run(f"resume={path}")
    assert "no such checkpoint" in run("resume=none.pt")


def test_as_a_command(tmp_path: Path):
    done = subprocess.run(
        [sys.executable, str(RECIPES / "train.py"), "scenes=[bathrom]"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2
    assert done.stderr.startswith("error: 'bathrom' is neither")
    assert done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
