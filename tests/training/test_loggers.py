"""What loggers leave on disk."""

from __future__ import annotations

import csv
import io
import json
import math
import os
import time
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from vusfa import __version__
from vusfa.errors import ConfigError, ResultError, VusfaError
from vusfa.report.film import encode_gif
from vusfa.training import make_loggers
from vusfa.training.loggers import CSVLogger, Loggers
from vusfa.training.trackers import TensorBoardLogger, WandbLogger, sweep_run_id

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
        shows_media = False

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


def media() -> dict[str, bytes]:
    """A film of two pictures, and a picture."""
    pictures, still = [Image.new("RGB", (12, 8), color) for color in ("red", "blue")], io.BytesIO()
    pictures[0].save(still, format="PNG")
    return {"eval/walk": encode_gif(pictures), "eval/floor/hall": still.getvalue()}


@pytest.mark.filterwarnings("default")  # TensorBoard's own imports warn
def test_tensorboard(tmp_path: Path):
    log = TensorBoardLogger(tmp_path, CONFIG)
    log.log_metrics({"goal/hall/3/success": 0.25, "loss": math.nan, "kl": 0.5}, 10)
    log.log_checkpoint(tmp_path / "checkpoint.pt", 10, is_best=True)
    log.log_table("evaluation", TABLE, 10)
    log.log_media(media(), 10)
    log.close()
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(tmp_path))
    events.Reload()
    assert sorted(events.Tags()["scalars"]) == ["goal/hall/3/success", "train/kl"]
    assert [(e.step, e.value) for e in events.Scalars("goal/hall/3/success")] == [(10, 0.25)]
    texts = {
        tag: events.Tensors(tag)[0].tensor_proto.string_val[0].decode() for tag in events.Tags()["tensors"]
    }
    assert "| agent.model | vusfa |" in texts["config/text_summary"]
    assert "| hall | 0.5 |" in texts["evaluation/text_summary"]
    assert texts["checkpoint/text_summary"].endswith("checkpoint.pt (best so far)")
    for name, data in media().items():
        (image,) = events.Images(name)
        assert (image.step, image.width, image.height) == (10, 12, 8)
        assert image.encoded_image_string == data


@pytest.mark.filterwarnings("default")
def test_tensorboard_shows_no_frame_twice_after_a_kill(tmp_path: Path):
    for resumed, numbers in ((None, (10, 20, 30)), (20, (30, 40))):
        log = TensorBoardLogger(tmp_path, CONFIG, resumed)
        for frames in numbers:
            log.log_metrics({"kl": float(resumed or 0)}, frames)
        log.close()
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(tmp_path))
    events.Reload()
    shown = [(event.step, event.value) for event in events.Scalars("train/kl")]
    assert shown == [(10, 0.0), (20, 0.0), (30, 20.0), (40, 20.0)]


@pytest.fixture
def wandb_at_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """wandb keeps to the test's folder."""
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("WANDB_DATA_DIR", str(tmp_path / "data"))


def history(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [record["history"]["item"] for record in records if record["type"] == "history"]


@pytest.mark.usefixtures("wandb_at_home")
@pytest.mark.filterwarnings("default")  # wandb's own
def test_wandb_read_back(tmp_path: Path, wandb_records):
    """A run that ended after its checkpoint, and the resumed one: two folders, one run, no frame twice."""
    checkpoint = tmp_path / "checkpoint.pt"
    checkpoint.write_bytes(b"weights")
    given = {"run_id": "abc12345", "project": "test", "mode": "offline"}
    given |= {"entity": "team", "group": "seeds", "tags": ["small", "hall"]}
    log = WandbLogger(tmp_path / "run", CONFIG, **given)
    log.log_metrics({"success": 0.5, "loss": math.nan, "goal/hall/3/success": 0.25}, 10)
    log.log_media(media(), 10)
    log.log_table("evaluation", TABLE, 10)
    log.log_checkpoint(checkpoint, 10, is_best=True)
    log.log_metrics({"success": 0.6}, 20)
    log.close(exit_code=1)  # before another checkpoint
    time.sleep(1.1 - time.time() % 1)  # a folder is called after its second
    log = WandbLogger(tmp_path / "run", CONFIG, **given)
    for frames in (20, 30):
        log.log_metrics({"success": frames / 100}, frames)
    checkpoint.write_bytes(b"other weights")
    log.log_checkpoint(checkpoint, 30)
    log.close()

    first, second = (
        wandb_records(path) for path in sorted((tmp_path / "run" / "wandb").glob("offline-run-*"))
    )
    (run,) = (record["run"] for record in first if record["type"] == "run")
    assert (run["run_id"], run["project"], run["entity"]) == ("abc12345", "test", "team")
    assert (run["run_group"], sorted(run["tags"]), run["resume"]) == ("seeds", ["hall", "small"], True)
    config = run["config"]["update"]
    assert (config["agent"], config["seed"]) == ({"model": "vusfa"}, 3)
    assert config["versions"]["vusfa"] == __version__
    axes = [record["metric"] for record in first if record["type"] == "metric"]
    assert {axis.get("step_metric") for axis in axes if axis.get("glob_name") == "*"} == {"frames"}
    (row,) = history(first)
    assert (row["frames"], row["_step"], row["train/success"], row["goal/hall/3/success"]) == (
        10,
        10,
        0.5,
        0.25,
    )
    assert "train/loss" not in row
    assert row["eval/walk._type"] == "video-file"
    assert row["eval/floor/hall._type"] == "image-file"
    assert row["evaluation.nrows"] == 2
    assert [(row["frames"], row["_step"]) for row in history(second)] == [(20, 20), (30, 30)]
    assert {record["run"]["run_id"] for record in second if record["type"] == "run"} == {"abc12345"}
    aliases = [
        record["artifact"]["aliases"]
        for record in [*first, *second]
        if record["type"] == "artifact" and record["artifact"]["type"] == "model"
    ]
    assert [set(names) for names in aliases] == [{"latest", "best"}, {"latest"}]


@pytest.mark.usefixtures("wandb_at_home")
def test_wandb_sends_or_leaves_out_what_it_should(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Rows of a run without a checkpoint; online, those that W&B does not have; a table at the end."""
    sent: list[tuple[Any, int]] = []

    class Run:
        id, offline, starting_step = "a", True, 0

        def log(self, row: dict[str, Any], step: int, commit: bool) -> None:
            sent.append((row["frames"], step))

        def finish(self, exit_code: int) -> None:
            pass

        log_artifact = define_metric = lambda *_, **__: None

    run = Run()
    monkeypatch.setattr("wandb.init", lambda **_: run)

    def rows(**facts: Any) -> WandbLogger:
        vars(run).update(facts)
        sent.clear()
        log = WandbLogger(tmp_path, CONFIG, run_id="a")
        for frames in (10, 20):
            log.log_metrics({"success": 0.5}, frames)
        return log

    log = rows()
    assert sent == []
    log.close(exit_code=1)
    assert sent == [(10, 10), (20, 20)]
    log = rows()
    log.log_checkpoint(Path(__file__), 20)
    log.log_metrics({"success": 0.5}, 30)
    log.close(exit_code=1)
    assert sent == [(10, 10), (20, 20)]
    log = rows(offline=False, starting_step=11)
    assert sent == [(20, 20)]
    log.log_table("evaluation", TABLE, 20)
    log.close()
    assert sent == [(20, 20), (20, 21)]


@pytest.mark.usefixtures("wandb_at_home")
@pytest.mark.filterwarnings("default")
def test_wandb_disabled_does_nothing(tmp_path: Path):
    log = WandbLogger(tmp_path / "other", CONFIG, run_id="abc12346", mode="disabled")
    log.log_metrics({"success": 0.5}, 10)
    log.log_media(media(), 10)
    log.close()
    assert not list(tmp_path.rglob("*.wandb"))


def test_a_sweeps_run_has_the_id_of_its_agent(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("WANDB_SWEEP_ID", raising=False)
    monkeypatch.setenv("WANDB_RUN_ID", "abc")
    assert sweep_run_id() is None
    monkeypatch.setenv("WANDB_SWEEP_ID", "sweep")
    assert sweep_run_id() == "abc"


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
        shows_media = False

        def close(self, exit_code: int = 0) -> None:
            codes.append(exit_code)

    with Loggers([Recorder()]) as log:
        log.exit_code = 143
    with pytest.raises(RuntimeError, match="lost"), Loggers([Recorder()]):
        raise RuntimeError("lost")
    assert codes == [143, 1]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"frames,loss\n24,0.5\n\xff\xfe\x00junk\n", "cannot be read, row 1 ('utf-8' codec can't decode"),
        (b"frames,loss\n24,0.5\nx,0.5\n", "cannot be read, row 3 (invalid literal for int()"),
        (b"frames,loss\n" + b"9" * 5000 + b",0.5\n", "cannot be read, row 2 (Exceeds the limit"),
        (b"loss\n0.5\n", "cannot be read, row 1 ('frames' is not in list)"),
        (b"frames\n" + b"1" * 200_000, "cannot be read, row 1 (field larger than field limit"),
        ("pipe", "is no regular file"),
        ("folder", "is a folder"),
        ("huge", f"it has more than {1 << 28} bytes"),
    ],
)
def test_a_log_that_is_none_ends_a_resumed_run_before_its_first_update(
    tmp_path: Path, content: Any, words: str
) -> None:
    path = tmp_path / "metrics.csv"
    if content == "pipe":
        os.mkfifo(path)
    elif content == "folder":
        path.mkdir()
    elif content == "huge":
        path.touch()
        os.truncate(path, 2 << 30)
    else:
        path.write_bytes(content)
    with pytest.raises(VusfaError) as error:
        make_loggers(["csv"], tmp_path, {}, run_id="a", resume_frames=24)
    assert str(error.value).startswith(f"{path}: ")
    assert words in str(error.value)
    assert [place.name for place in tmp_path.iterdir()] == ["metrics.csv"]


@pytest.mark.parametrize("mode", ["", "nonsense", "x" * 5000])
def test_a_mode_of_the_environment_that_wandb_does_not_know_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: str
) -> None:
    monkeypatch.setenv("WANDB_MODE", mode)
    words = "WANDB_MODE is '.*'; set it to one of online, offline, disabled, or unset it"
    with pytest.raises(ConfigError, match=words) as error:
        make_loggers(["wandb"], tmp_path / "run", {}, run_id="a", mode="offline")
    assert len(str(error.value)) < 500
    assert not (tmp_path / "run").exists()
