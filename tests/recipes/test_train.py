"""recipes/train.py: the four models, the three collectors, what a run leaves behind."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import pytest
import torch

from vusfa.evaluation import evaluate
from vusfa.report.media import draw_media
from vusfa.training import load_agent, load_checkpoint, make_observation

MODELS = ("gvf", "usfa", "sfdp", "vusfa")


def rows(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.usefixtures("fast_workers")
@pytest.mark.parametrize(
    ("model", "kind"),
    [*((model, "single") for model in MODELS), ("vusfa", "multi_sync"), ("gvf", "multi_async")],
)
def test_every_model_and_every_collector_trains(
    recipe, settings, small, tmp_path: Path, capfd: pytest.CaptureFixture[str], model: str, kind: str
):
    frames = 20 * (12 if kind == "multi_async" else 24)
    options = [
        f"agent.model={model}",
        f"collector={kind}",
        f"total_frames={frames}",
        f"folder={tmp_path / 'run'}",
    ]
    cfg = settings(*small, *options)
    trainer, result, code = recipe("train").train(cfg, options)
    assert (trainer.updates, trainer.frames, result, code) == (20, frames, None, 0)
    assert all(bool(param.isfinite().all()) for param in trainer.agent.parameters())

    agent, scenes, state = load_agent(tmp_path / "run" / "checkpoint.pt")
    assert state["frames"] == frames
    for name, value in agent.state_dict().items():
        assert torch.equal(value, trainer.agent.state_dict()[name]), name
    table = evaluate(
        agent.get_policy_operator(), scenes, state["goals"], episodes_per_goal=2, max_steps=9, history=2
    )
    assert len(table) == 6
    (line, *_) = rows(tmp_path / "run" / "metrics.csv")
    assert {
        "success",
        "scene/hall/success",
        "goal/hall/3/success",
        "loss_critic",
        "grad_norm",
        "lr",
    } <= line.keys()
    out, err = capfd.readouterr()
    assert "warning" not in (out + err).lower()


def test_a_run_learns_and_tells(recipe, settings, small, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    options = [
        "agent.model=gvf",
        "agent.hidden_size=32",
        "agent.embedding_size=32",
        "collector.num_envs=12",
        "collector.rollout=10",
        "total_frames=24000",
        "log_every=2400",
        "optim.lr=0.003",
        "evaluation=trained",
        "evaluation.episodes_per_goal=30",
        "evaluation.max_steps=60",
        f"folder={tmp_path / 'run'}",
    ]
    _, result, _ = recipe("train").train(settings(*small, *options), options)
    log = rows(tmp_path / "run" / "metrics.csv")
    assert [int(line["frames"]) for line in log] == list(range(2400, 24001, 2400))
    (row,) = [row for row in result.rows if (row["policy"], row["goals"]) == ("gvf", "trained")]
    assert row["success_60"] > 0.95
    assert float(log[-1]["length_ratio"]) < float(log[0]["length_ratio"])
    assert rows(tmp_path / "run" / "evaluation.csv")[0]["policy"] == "gvf"
    assert len(rows(tmp_path / "run" / "evaluation_episodes.csv")) == 90
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert (config["agent"]["model"], config["total_frames"]) == ("gvf", 24000)
    assert str(tmp_path) not in str(config)
    written = capsys.readouterr()
    assert "trained goals" in written.out
    assert "random walk" in written.out
    assert "24,000 of 24,000 frames" in written.err
    state = load_checkpoint(tmp_path / "run" / "checkpoint.pt")
    assert state["overrides"][:2] == options[:2]
    assert str(tmp_path) not in f"{state['config']} {state['overrides']}"  # an absolute path of its author's
    assert state["scenes"]["names"] == ["hall"]


@pytest.mark.parametrize(
    "options",
    [
        ["autocast=true", "agent.model=vusfa"],
        ["agent=lstm", "agent.model=usfa"],
        ["agent=pixels", "agent.model=gvf", "agent.picture_size=[36,44]"],
        ["agent.observation=features", "env.crop=random"],
        ["agent.observation=pixels", "agent.picture_size=[36,44]"],
        ["preset=paper", "agent.model=sfdp", "collector.num_envs=6", "env.max_steps=20"],
        ["preset=reference", "agent.model=vusfa", "collector.num_envs=6"],
        ["env.goal_sampling=episode", "env.goals=all", "optim=rmsprop", "objective.lmbda=0.9"],
    ],
    ids=lambda options: "-".join(options[:2]),
)
def test_options_train(recipe, settings, small, tmp_path: Path, options: list[str]):
    kept = [item for item in small if item.partition("=")[0] not in {o.partition("=")[0] for o in options}]
    if any("lstm" in option or "reference" in option for option in options):
        kept.remove("agent.history=2")
    cfg = settings(*kept, *options, "total_frames=480", f"folder={tmp_path / 'run'}")
    trainer, _, _ = recipe("train").train(cfg, options)
    assert trainer.updates == 20
    assert all(bool(param.isfinite().all()) for param in trainer.agent.parameters())
    agent, scenes, _ = load_agent(tmp_path / "run" / "checkpoint.pt")
    history, observe = agent.config["history"], make_observation(agent, scenes)
    evaluate(agent.get_policy_operator(), scenes, [3], max_steps=9, history=history, observe=observe)


@pytest.mark.filterwarnings("default")  # TensorBoard and wandb themselves
def test_all_loggers_hear_of_a_run(
    recipe, settings, small, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wandb_records
):
    monkeypatch.setenv("WANDB_DATA_DIR", str(tmp_path / "data"))
    options = [
        "logger.kinds=[csv,tensorboard,wandb]",
        "logger.mode=offline",
        "logger.tags=[small]",
        "agent.history=1",
        "evaluation=trained",
        "evaluation.interval=240",
        "evaluation.episodes_per_goal=2",
        "evaluation.max_steps=20",
        f"folder={tmp_path / 'run'}",
    ]
    small.remove("agent.history=2")
    trainer, _, _ = recipe("train").train(settings(*small, *options), options, draw_media)
    records = wandb_records(next((tmp_path / "run" / "wandb").glob(f"offline-run-*-{trainer.run_id}")))
    rows = [record["history"]["item"] for record in records if record["type"] == "history"]
    *rows, last = rows
    assert [row["frames"] for row in rows] == [row["_step"] for row in rows] == list(range(48, 481, 48))
    assert (last["frames"], last["_step"], last["evaluation._type"]) == (480, 481, "table-file")
    logged = {"train/loss_critic", "train/success", "goal/hall/3/length_ratio", "scene/hall/length_ratio"}
    evaluated = {"eval/validation/spl", "scene/hall/eval/trained/success", "validation.nrows"}
    evaluated |= {"eval/walk.path", "eval/floor/hall.path"}
    assert logged <= set().union(*rows)
    assert [row["frames"] for row in rows if evaluated <= row.keys()] == [240, 480]
    assert not any(evaluated & row.keys() for row in rows if row["frames"] not in (240, 480))
    aliases = [r["artifact"]["aliases"] for r in records if r.get("artifact", {}).get("type") == "model"]
    assert set(aliases[0]) == {"latest", "best"}  # wandb keeps them in no order
    assert "latest" in aliases[-1]
    assert (tmp_path / "run" / "best.pt").is_file()
    assert list((tmp_path / "run" / "tensorboard").glob("events*"))


def test_the_multiplier_moves_and_the_rate_falls(recipe, settings, small, tmp_path: Path):
    options = [
        "agent.model=vusfa",
        "objective.bottleneck_step_size=0.5",
        "objective.information_target=0.0",
        "optim.horizon=480",
        f"folder={tmp_path / 'run'}",
    ]
    trainer, _, _ = recipe("train").train(settings(*small, *options), options)
    log = rows(tmp_path / "run" / "metrics.csv")
    betas = [float(line["beta"]) for line in log]
    assert betas == sorted(betas)
    assert betas[-1] > betas[0]
    assert float(trainer.algorithm.loss.bottleneck_coeff) > betas[-1]
    rates = [float(line["lr"]) for line in log]
    lr = settings(*small).optim.lr
    assert rates[0] == pytest.approx(lr * (1 - 24 / 480))
    assert rates[-1] == pytest.approx(lr * (1 - 456 / 480))
    assert all(not math.isnan(float(line["kl"])) for line in log)
