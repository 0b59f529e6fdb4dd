"""Agents in changed renderings of their rooms."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from vusfa.cli.launch import compose
from vusfa.deploy.robustness import changed_rooms, in_changed_rooms, robustness
from vusfa.errors import ConfigError, ResultError, SceneError
from vusfa.experiments.runs import read_run, read_runs
from vusfa.report.robustness import robustness_table
from vusfa.scenes import Scene, SceneSet
from vusfa.training import make_trainer

SMALL = ["env.goals=[3,9,12]", "agent.hidden_size=8", "agent.embedding_size=8", "agent.history=1"]
SMALL += ["collector.num_envs=6", "collector.rollout=4", "total_frames=24", "evaluation=none"]


@pytest.fixture
def places(make_scene: Callable[..., Scene], tmp_path: Path) -> Path:
    """Two rooms as trained in, the same ones changed, and a checkpoint."""
    for folder in ("own", "same", "dark"):
        (tmp_path / folder).mkdir()
        for name, width in (("hall", 2), ("attic", 3)):
            scene = make_scene(name, width)
            features = scene.features * (-1 if folder == "dark" else 1)
            Scene(name, scene.graph, features).save(tmp_path / folder / f"{name}.h5")
    rooms = [str(tmp_path / "own" / f"{name}.h5") for name in ("hall", "attic")]
    cfg = compose(overrides=[f"scenes=[{','.join(rooms)}]", *SMALL])
    settings: Any = OmegaConf.to_container(cfg, resolve=True)
    trainer = make_trainer(settings)
    with trainer.collecting() as batches:
        trainer.update(batches)
        trainer.save(tmp_path / "checkpoint.pt")
    return tmp_path


def test_the_same_agent_in_every_change(places: Path, capsys: pytest.CaptureFixture[str]) -> None:
    results = places / "results"
    asked: dict[str, Any] = {"episodes": 2, "results": results}
    robustness(places / "checkpoint.pt", [places / "same", places / "dark"], **asked)
    found = read_run(results, "robustness", "plain-0")
    assert found.info["changes"] == ["unchanged", "same", "dark"]
    own, same, dark = (found.episodes[name] for name in found.info["changes"])
    assert own.equal(same)
    assert not own.equal(dark)
    assert torch.equal(own.goal, dark.goal)
    assert torch.equal(own.start, dark.start)
    assert found.episodes["unchanged-greedy"].equal(found.episodes["same-greedy"])
    out = capsys.readouterr().out
    assert "random walk" in out
    assert "shortest path" in out
    table = robustness_table(read_runs(results, "robustness")).splitlines()
    assert [line.split("|")[2].strip() for line in table[2:]] == ["unchanged", "same", "dark", "–", "–"]
    assert [line.split("|")[1].strip() for line in table[2:]] == 3 * ["plain"] + [
        "random walk",
        "shortest path",
    ]


def test_the_changed_agent_reads_the_changed_features(places: Path) -> None:
    from vusfa.training import load_agent

    agent, own, _ = load_agent(places / "checkpoint.pt")
    dark = changed_rooms(own, places / "dark")
    moved = in_changed_rooms(agent, dark)
    frames = moved.encoder.frames
    assert not moved.training
    assert torch.allclose(frames.lookup(None), frames.encode(dark.features[:, 0]), atol=1e-6)
    assert torch.equal(frames.mean, agent.encoder.frames.mean)
    assert dark.names == own.names


def test_rooms_that_are_not_the_agents(
    places: Path, make_scene: Callable[..., Scene], tmp_path: Path
) -> None:
    own = SceneSet.open([places / "own" / f"{name}.h5" for name in ("hall", "attic")])
    (places / "dark" / "attic.h5").unlink()
    with pytest.raises(SceneError, match=r"dark: has no scene 'attic', .* it has hall"):
        changed_rooms(own, places / "dark")
    make_scene("attic", 2).save(places / "dark" / "attic.h5")
    with pytest.raises(SceneError, match=r"own/attic\.h5 and .*dark/attic\.h5 are of different rooms"):
        changed_rooms(own, places / "dark")
    make_scene("attic", 3, features=5).save(places / "dark" / "attic.h5")
    with pytest.raises(SceneError, match=r"(?s)attic.*feature"):
        changed_rooms(own, places / "dark")


@pytest.mark.parametrize("name", ["unchanged", "exact", "a b", "dark-greedy"])
def test_names_that_a_change_cannot_have(places: Path, name: str) -> None:
    (places / "same").rename(places / name)
    with pytest.raises(ConfigError, match="cannot be called"):
        robustness(places / "checkpoint.pt", [places / name], results=places / "results")
    assert not (places / "results").exists()


@pytest.mark.parametrize("name", ["../elsewhere", "a/b", "x" * 300])
def test_names_that_results_cannot_have(places: Path, name: str) -> None:
    with pytest.raises(ResultError, match="a run cannot be called"):
        robustness(places / "checkpoint.pt", [places / "same"], name=name, results=places / "results")
    assert not (places / "results").exists()


def test_two_changes_of_one_name(places: Path) -> None:
    with pytest.raises(ConfigError, match="two changes are called 'dark'"):
        robustness(places / "checkpoint.pt", [places / "dark", places / "dark"], results=places / "results")
