"""``vusfa train`` in an empty folder."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from vusfa.training import load_checkpoint


def vusfa(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "vusfa.cli", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True)


SMALL = ["agent.hidden_size=8", "agent.embedding_size=8", "collector.num_envs=5", "collector.rollout=4"]


def test_it_trains_and_resumes(tmp_path: Path):
    done = vusfa(
        "train", "scenes=[bathroom]", *SMALL, "total_frames=20", "evaluation.max_steps=5", folder=tmp_path
    )
    assert done.returncode == 0, done.stderr
    path = tmp_path / done.stderr.splitlines()[-1]
    assert path.with_name("evaluation.csv").is_file()
    done = vusfa("train", f"resume={path.parent}", "total_frames=40", folder=tmp_path)  # a folder will do
    assert done.returncode == 0, done.stderr
    assert load_checkpoint(path)["frames"] == 40


def test_a_sweep(tmp_path: Path):
    more = ["scenes=[bathroom]", *SMALL, "total_frames=20", "evaluation=none"]
    done = vusfa("train", "--multirun", "seed=0,1", *more, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert sorted(path.parent.name for path in tmp_path.rglob("checkpoint.pt")) == ["0", "1"]


def test_a_mistake_is_one_line(tmp_path: Path):
    done = vusfa("train", "agent.modle=gvf", folder=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "did you mean 'agent.model'?" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_help_lists_settings_and_choices(tmp_path: Path):
    text = vusfa("train", "--help", folder=tmp_path).stdout
    assert text.lstrip().startswith("vusfa train SETTING=VALUE")
    for words in (
        "algorithm: autoencoder, hindsight, replay_search, usf",
        "total_frames: 6000000",
        "--multirun",
    ):
        assert words in text
