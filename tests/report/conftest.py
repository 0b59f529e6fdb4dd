"""Three tiny trained runs, the page made of them, and a browser to open it in."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from vusfa.cli.launch import compose
from vusfa.conf import FOLDER as CONF
from vusfa.evaluation import Episodes
from vusfa.report import Options, read_run, write_report
from vusfa.report.runs import LoggedRun

RECIPES = Path(__file__).parents[2] / "recipes"


@pytest.fixture(scope="session")
def train_run() -> Callable[[Path, list[str]], Path]:
    """Trains a small agent for 2000 frames into a folder, and makes every state a goal once."""
    sys.path.insert(0, str(RECIPES))
    train = import_module("train").train
    sys.path.remove(str(RECIPES))
    sys.modules.pop("train")

    def made(folder: Path, options: list[str]) -> Path:
        overrides = [
            f"folder={folder}",
            "env.max_steps=20",
            "agent.hidden_size=8",
            "agent.embedding_size=8",
            "collector.num_envs=10",
            "collector.rollout=10",
            "total_frames=2000",
            "log_every=200",
            "evaluation=all",
            "evaluation.episodes_per_goal=1",
            "evaluation.max_steps=20",
            *options,
        ]
        cfg = compose(CONF, "train", overrides)
        OmegaConf.resolve(cfg)
        train(cfg, overrides)
        return folder

    return made


@pytest.fixture(scope="session")
def run_folders(
    train_run: Callable[[Path, list[str]], Path], tmp_path_factory: pytest.TempPathFactory
) -> list[Path]:
    """Two seeds of vusfa, one of gvf, in two bundled rooms."""
    root, scenes = tmp_path_factory.mktemp("runs"), ["scenes=[bathroom,bedroom]", "agent.history=1"]
    wanted = [("vusfa", 0), ("vusfa", 1), ("gvf", 0)]
    return [
        train_run(root / f"{model}-{seed}", [*scenes, f"agent.model={model}", f"seed={seed}"])
        for model, seed in wanted
    ]


@pytest.fixture(scope="session")
def runs(run_folders: list[Path]) -> list[LoggedRun]:
    """Those runs, read."""
    return [read_run(folder) for folder in run_folders]


@pytest.fixture(scope="session")
def page(runs: list[LoggedRun], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Their page, with a title that is no HTML."""
    out = tmp_path_factory.mktemp("report") / "page.html"
    options = Options(title="A <b>title</b> & </script>", goals_per_scene=8, walks=2, max_steps=30)
    write_report(runs, out, options)
    return out


@pytest.fixture
def corridor_run() -> Callable[..., LoggedRun]:
    """A run with episodes: rows of goal, start, success, length, shortest, collisions, trained."""

    def made(
        label: str, seed: int, rows: list[tuple[int, ...]], scene: str = "hall", limit: int = 100
    ) -> LoggedRun:
        goal, start, success, length, shortest, collisions, trained = torch.tensor(rows).T
        table = Episodes(
            torch.zeros_like(goal),
            goal,
            start,
            success > 0,
            length,
            shortest,
            collisions,
            trained > 0,
            (scene,),
            limit,
        )
        return LoggedRun(
            label, seed, Path(f"{label}-{seed}"), {"agent": {"model": label}, "scenes": []}, {}, table
        )

    return made


@pytest.fixture(scope="session")
def chromium() -> Iterator[Any]:
    """A headless Chromium."""
    reason, program = "", shutil.which("chromium") or shutil.which("chromium-browser")
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        reason = "not installed: playwright (of the extra dev)"
    if not reason and program is None:
        reason = "not installed: Chromium (Debian's chromium)"
    if reason:
        (pytest.fail if os.environ.get("CI") else pytest.skip)(reason)
    switches = ["--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking"]
    switches += ["--disable-component-update", "--disable-sync", "--disable-quic"]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=switches)
        yield browser
        browser.close()
