"""``vusfa train`` in an empty folder."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from vusfa.training import load_checkpoint


@pytest.fixture
def vusfa(program: Callable[..., Any], tmp_path: Path) -> Callable[..., Any]:
    """The program, in an empty folder."""
    return partial(program, "vusfa", folder=tmp_path, code="from vusfa.cli import main; main()")


SMALL = ["agent.hidden_size=8", "agent.embedding_size=8", "collector.num_envs=5", "collector.rollout=4"]


def test_it_trains_and_resumes(vusfa: Callable[..., Any], tmp_path: Path):
    done = vusfa("train", "scenes=[bathroom]", *SMALL, "total_frames=20", "evaluation.max_steps=5")
    assert done.returncode == 0, done.stderr
    path = tmp_path / done.stderr.splitlines()[-1]
    assert path.with_name("evaluation.csv").is_file()
    done = vusfa("train", f"resume={path.parent}", "total_frames=40")  # a folder will do
    assert done.returncode == 0, done.stderr
    assert load_checkpoint(path)["frames"] == 40


def test_a_sweep(vusfa: Callable[..., Any], tmp_path: Path):
    more = ["scenes=[bathroom]", *SMALL, "total_frames=20", "evaluation=none"]
    done = vusfa("train", "--multirun", "seed=0,1", *more)
    assert done.returncode == 0, done.stderr
    assert sorted(path.parent.name for path in tmp_path.rglob("checkpoint.pt")) == ["0", "1"]


def test_a_mistake_is_one_line(vusfa: Callable[..., Any], tmp_path: Path):
    done = vusfa("train", "agent.modle=gvf")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "did you mean 'agent.model'?" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_help_lists_settings_and_choices(vusfa: Callable[..., Any], tmp_path: Path):
    text = vusfa("train", "--help").stdout
    assert text.lstrip().startswith("vusfa train SETTING=VALUE")
    for words in (
        "algorithm: autoencoder, contrastive, forward_backward, hindsight, imitation, implicit_q,"
        " replay_search, usf",
        "total_frames: 6000000",
        "--multirun",
    ):
        assert words in text
