"""What loggers leave on disk."""

from __future__ import annotations

import csv
import json
import math
import os
import time
from pathlib import Path

import pytest

from vusfa.errors import ConfigError, ResultError
from vusfa.training import make_loggers
from vusfa.training.loggers import CSVLogger, Loggers
from vusfa.training.trackers import TensorBoardLogger, WandbLogger

CONFIG = {"agent": {"model": "vusfa"}, "seed": 3}
TABLE = [{"scene": "hall", "success": 0.5}, {"scene": "attic", "success": math.nan}]


def rows(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def test_csv(tmp_path: Path):
    with make_loggers(["csv"], tmp_path / "run", CONFIG, run_id="a") as log:
        assert not (tmp_path / "run").exists()  # a training that cannot begin leaves nothing
        log.log_metrics({"success": math.nan, "loss": 2.0}, 10)
        log.log_metrics({"success": 0.5, "loss": 1.0}, 20)
        log.log_checkpoint(tmp_path / "run" / "checkpoint.pt", 20)
        log.log_table("evaluation", TABLE, 20)
    assert rows(tmp_path / "run" / "metrics.csv") == [
        {"frames": "10", "success": "", "loss": "2.0"},
        {"frames": "20", "success": "0.5", "loss": "1.0"},
    ]
    assert json.loads((tmp_path / "run" / "config.json").read_text()) == CONFIG
    assert rows(tmp_path / "run" / "evaluation.csv")[1] == {"scene": "attic", "success": ""}


def test_csv_takes_out_what_came_after_the_checkpoint(tmp_path: Path):
    log = CSVLogger(tmp_path, CONFIG)
    for frames in (10, 20, 30):
        log.log_metrics({"loss": frames / 10, "kl": 0.0}, frames)
    with open(tmp_path / "metrics.csv", "a") as file:
        file.write("40,4.")  # the process died here
    resumed = CSVLogger(tmp_path, CONFIG, resume_frames=20)
    resumed.log_metrics({"kl": 0.0, "loss": 9.0}, 30)
    assert [(row["frames"], row["loss"]) for row in rows(tmp_path / "metrics.csv")] == [
        ("10", "1.0"),
        ("20", "2.0"),
        ("30", "9.0"),
    ]


def test_a_new_csv_run_begins_a_new_file(tmp_path: Path):
    for loss in (1.0, 2.0):
        CSVLogger(tmp_path, CONFIG).log_metrics({"loss": loss}, 10)
    assert [row["loss"] for row in rows(tmp_path / "metrics.csv")] == ["2.0"]


def test_csv_takes_a_new_column(tmp_path: Path):
    log = CSVLogger(tmp_path, CONFIG)
    log.log_metrics({"loss": 1.0}, 10)
    log.log_metrics({"loss": 2.0, "kl": 0.5}, 20)
    resumed = CSVLogger(tmp_path, CONFIG, resume_frames=20)
    resumed.log_metrics({"entropy": 3.0, "loss": 4.0}, 30)
    assert rows(tmp_path / "metrics.csv") == [
        {"frames": "10", "loss": "1.0", "kl": "", "entropy": ""},
        {"frames": "20", "loss": "2.0", "kl": "0.5", "entropy": ""},
        {"frames": "30", "loss": "4.0", "kl": "", "entropy": "3.0"},
    ]


@pytest.mark.parametrize("gone", ["file", "folder"])
def test_csv_that_was_removed_does_not_come_back_without_a_header(tmp_path: Path, gone: str):
    log = CSVLogger(tmp_path / "run", CONFIG)
    log.log_metrics({"loss": 1.0}, 10)
    if gone == "file":
        (tmp_path / "run" / "metrics.csv").unlink()
    else:
        (tmp_path / "run").rename(tmp_path / "elsewhere")
    with pytest.raises(ResultError, match=r"metrics\.csv: removed or renamed since the run began"):
        log.log_metrics({"loss": 1.0}, 20)


def test_a_tracker_that_fails_is_left_behind(capsys: pytest.CaptureFixture[str]):
    heard = []

    class Steady:
        def log_metrics(self, metrics, frames: int) -> None:
            heard.append(frames)

        def close(self, exit_code: int = 0) -> None:
            pass

    class Full(Steady):
        def log_metrics(self, metrics, frames: int) -> None:
            raise OSError(28, "No space left on device")

    with Loggers([Full(), Steady()]) as log:
        log.log_metrics({}, 10)
        log.log_metrics({}, 20)
    assert heard == [10, 20]
    assert capsys.readouterr().err.count("warning: Full has failed ([Errno 28] No space left on device)") == 1


@pytest.mark.filterwarnings("default")  # TensorBoard's own imports warn
def test_tensorboard(tmp_path: Path):
    log = TensorBoardLogger(tmp_path, CONFIG)
    log.log_metrics({"goal/hall/3/success": 0.25, "loss": math.nan}, 10)
    log.log_checkpoint(tmp_path / "checkpoint.pt", 10)
    log.log_table("evaluation", TABLE, 10)
    log.close()
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(tmp_path))
    events.Reload()
    assert events.Tags()["scalars"] == ["goal/hall/3/success"]
    assert [(e.step, e.value) for e in events.Scalars("goal/hall/3/success")] == [(10, 0.25)]
    texts = {
        tag: events.Tensors(tag)[0].tensor_proto.string_val[0].decode() for tag in events.Tags()["tensors"]
    }
    assert "| agent.model | vusfa |" in texts["config/text_summary"]
    assert "| hall | 0.5 |" in texts["evaluation/text_summary"]
    assert texts["checkpoint/text_summary"].endswith("checkpoint.pt")


@pytest.mark.filterwarnings("default")  # wandb's own
def test_wandb_offline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wandb_content):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.delenv("WANDB_DATA_DIR", raising=False)
    checkpoint = tmp_path / "checkpoint.pt"
    checkpoint.write_bytes(b"weights")
    log = WandbLogger(tmp_path / "run", CONFIG, run_id="abc12345", project="test", mode="offline")
    log.log_metrics({"success": 0.5, "loss": math.nan, "goal/hall/3/success": 0.25}, 10)
    log.log_checkpoint(checkpoint, 10)
    log.log_table("evaluation", TABLE, 10)
    summary = dict(log.run.summary)
    assert summary["success"] == 0.5
    assert summary["goal/hall/3/success"] == 0.25
    assert summary["frames"] == 10
    assert "loss" not in summary
    assert log.run.config["agent"] == {"model": "vusfa"}
    assert log.run.id == "abc12345"
    log.close()
    (stored,) = (tmp_path / "run" / "wandb").glob("offline-run-*/run-abc12345.wandb")
    words = (b"checkpoint-abc12345", b"evaluation", b"goal/hall/3/success")
    # wandb's service writes the file, in a process of its own, and on a busy machine some seconds late
    deadline = time.monotonic() + 60.0
    while not all(word in stored.read_bytes() for word in words) and time.monotonic() < deadline:
        time.sleep(0.2)
    content = wandb_content(stored)
    assert [word for word in words if word not in content] == []
    monkeypatch.delenv("WANDB_DATA_DIR", raising=False)
    os.environ.pop("WANDB_DATA_DIR", None)


def test_an_unknown_logger_is_named(tmp_path: Path):
    with pytest.raises(ConfigError, match="'wandbb'; it may hold csv, tensorboard, wandb"):
        make_loggers(["csv", "wandbb"], tmp_path / "run", CONFIG, run_id="a")
    assert not (tmp_path / "run").exists()


def test_a_missing_library_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(__import__("sys").modules, "wandb", None)
    with pytest.raises(ConfigError, match="wandb needs wandb; pip install"):
        make_loggers(["wandb"], tmp_path / "run", CONFIG, run_id="a")


def test_an_exception_closes_loggers_with_a_failure():
    codes = []

    class Recorder:
        def close(self, exit_code: int = 0) -> None:
            codes.append(exit_code)

    with Loggers([Recorder()]) as log:
        log.exit_code = 143
    with pytest.raises(RuntimeError, match="lost"), Loggers([Recorder()]):
        raise RuntimeError("lost")
    assert codes == [143, 1]
