"""The configuration: every file says how it is used, and that is true; presets hold the numbers that they
promise."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from vusfa.cli.launch import compose
from vusfa.conf import FOLDER as CONF

RECIPES = Path(__file__).parents[2] / "recipes"
FILES = sorted(CONF.rglob("*.yaml"))


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(CONF)))
def test_every_file_opens_with_the_line_that_launches_it(path: Path):
    lines = [line for line in path.read_text().splitlines() if not line.startswith("# @package")]
    assert lines[0].startswith("# ")
    command = shlex.split(lines[0].rpartition("python recipes/")[2])
    recipe, overrides = command[0], command[1:]
    assert (RECIPES / recipe).is_file()
    compose(CONF, Path(recipe).stem, overrides)
    group = path.relative_to(CONF).parent
    if group != Path() and path.stem != "index":
        assert f"{group}={path.stem}" in overrides
    elif group == Path():
        assert Path(recipe).stem == path.stem


def test_the_groups_mirror_the_package():
    assert {path.name for path in CONF.iterdir() if path.is_dir() and path.name != "__pycache__"} == {
        "agent",
        "cluster",
        "collector",
        "env",
        "evaluation",
        "hindsight",
        "logger",
        "objective",
        "optim",
        "preset",
    }


@pytest.mark.parametrize(
    ("model", "num_envs", "total_frames", "successor"),
    [
        ("gvf", 100, 100_000_000, 0.0),
        ("usfa", 32, 10_000_000, 5e-4),
        ("sfdp", 64, 10_000_000, 5e-3),
        ("vusfa", 100, 100_000_000, 5e-4),
    ],
)
@pytest.mark.parametrize("preset", ["paper", "reference"])
def test_the_published_numbers(
    settings, preset: str, model: str, num_envs: int, total_frames: int, successor: float
):
    cfg = settings(f"preset={preset}", f"agent.model={model}")
    assert cfg.agent.architecture == preset
    assert (cfg.collector.num_envs, cfg.collector.rollout, cfg.total_frames) == (num_envs, 5, total_frames)
    optim = cfg.optim
    assert (optim.kind, optim.lr, optim.horizon, optim.max_grad_norm) == (
        "a3c_rmsprop",
        7e-4,
        total_frames,
        40.0,
    )
    assert optim.options == {
        "alpha": 0.99,
        "eps": 0.1,
        "initial_accumulator": 1.0,
        "threads_per_update": None,
    }
    objective = cfg.objective
    # sums over 5 steps, as means over steps times 5
    assert (objective.objective_coeff, objective.critic_coeff) == (5.0, 1.25)
    assert (cfg.entropy.start, cfg.entropy.horizon) == (0.05, None)
    assert (objective.successor_coeff, objective.gamma, objective.lmbda) == (successor, 0.99, 1.0)
    assert (objective.bottleneck_coeff, objective.bottleneck_step_size) == (0.0, 1e-6)
    assert objective.information_target == 0.2
    assert objective.normalize_advantage is False
    assert objective.bootstrap_at_timeout is (preset == "paper")
    assert (cfg.env.goal_reward, cfg.env.step_reward, cfg.env.collision_reward) == (1.0, -0.01, None)


def test_the_command_line_wins_over_the_preset(settings):
    cfg = settings(
        "preset=paper", "optim=adam", "total_frames=5000", "collector.num_envs=20", "collector=multi_async"
    )
    assert (cfg.optim.kind, cfg.total_frames, cfg.collector.num_envs, cfg.collector.kind) == (
        "adam",
        5000,
        20,
        "multi_async",
    )


def test_a_preset_does_not_depend_on_the_one_before(settings):
    assert settings("preset=fast", "folder=here") == settings("folder=here")


def test_fast_is_controlled_but_for_the_clock(settings):
    """The four models differ in nothing but their ideas: what fast changes, it changes for all of them."""
    fast, controlled = settings("preset=fast", "folder=here"), settings("preset=controlled", "folder=here")
    for key in fast:
        if key not in ("agent", "optim", "name"):
            assert fast[key] == controlled[key]
    assert {key for key in fast.agent if fast.agent[key] != controlled.agent[key]} == {"history"}
    assert (fast.agent.architecture, fast.agent.history, fast.agent.hidden_size) == ("controlled", 1, 256)
    assert {key for key in fast.optim if fast.optim[key] != controlled.optim[key]} == {"lr"}
    assert fast.optim.lr == 1e-3


def test_the_numbers_of_controlled(settings):
    cfg = settings("preset=controlled")
    assert (cfg.agent.history, cfg.agent.hidden_size, cfg.agent.embedding_size) == (None, 256, 256)
    assert cfg.optim == {
        "kind": "adam",
        "lr": 5e-4,
        "horizon": 6_000_000,
        "max_grad_norm": 1.0,
        "options": {"eps": 1e-5, "fused": True},
    }
    assert cfg.collector == {"kind": "single", "num_envs": 256, "rollout": 50, "num_workers": 1} | {
        "timeout": 300.0,
        "address": None,
        "resources": {},
    }
    assert cfg.env.goal_sampling == "episode"
    assert cfg.entropy == {"start": 0.005, "end": 0.001, "horizon": 6_000_000}
    assert (cfg.total_frames, cfg.autocast) == (6_000_000, "auto")


@pytest.mark.parametrize("preset", ["controlled", "paper", "reference"])
@pytest.mark.parametrize("optim", ["adam", "rmsprop", "tf_rmsprop"])
def test_a_chosen_optimizer_comes_with_its_numbers(settings, preset: str, optim: str):
    cfg = settings(f"preset={preset}", f"optim={optim}", "total_frames=5000")
    written = OmegaConf.load(CONF / "optim" / f"{optim}.yaml")
    assert cfg.optim == OmegaConf.merge({"total_frames": 5000, "optim": written}).optim


@pytest.mark.parametrize("collector", ["single", "multi_sync", "multi_async"])
def test_a_chosen_collector_steps_as_many_environments_as_the_preset_says(settings, collector: str):
    chosen, written = f"collector={collector}", OmegaConf.load(CONF / "collector" / f"{collector}.yaml")
    cfg = settings(chosen, "preset=controlled")
    assert (cfg.collector.kind, cfg.collector.num_workers) == (written.kind, written.num_workers)
    assert (cfg.collector.num_envs, cfg.collector.rollout) == (256, 50)
    cfg = settings(chosen, "preset=paper", "agent.model=gvf")
    assert (cfg.collector.kind, cfg.collector.num_envs, cfg.collector.rollout) == (collector, 100, 5)
