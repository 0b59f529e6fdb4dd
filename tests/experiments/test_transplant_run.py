"""Agents in rooms that they have never seen, as runs."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from vusfa.errors import ConfigError, SceneError
from vusfa.experiments.training import compose_settings, train
from vusfa.experiments.transplant_run import transplant_run
from vusfa.experiments.zero_shot import zero_shot
from vusfa.report.command import report_runs
from vusfa.scenes import Scene
from vusfa.training import load_agent

SMALL = ["agent.model=vusfa", "agent.hidden_size=8", "agent.embedding_size=8", "evaluation=none"]
SMALL += ["total_frames=200", "collector.num_envs=8", "collector.rollout=5"]


def trained(folder: Path, scene: Path, *overrides: str) -> Path:
    train(compose_settings([*SMALL, f"scenes=[{scene}]", f"folder={folder}", *overrides]))
    return folder


@pytest.fixture
def attic(make_scene: Callable[..., Scene], tmp_path: Path) -> Path:
    make_scene("attic", 3, 2).save(tmp_path / "attic.h5")
    return tmp_path / "attic.h5"


def test_its_weights_are_the_same_and_no_goal_of_the_rooms_is_trained(
    scene_file: Path, attic: Path, tmp_path: Path
) -> None:
    run = trained(tmp_path / "run", scene_file, "preset=imitation", "agent.fusion=concatenation")
    path = transplant_run(run, [str(attic)], folder=tmp_path / "runs" / "elsewhere")
    agent, scenes, state = load_agent(path)
    before, _, _ = load_agent(run / "checkpoint.pt")
    assert scenes.names == ("attic",)
    assert len(state["goals"]) == 0
    assert state["scenes"]["sources"] == [str(attic)]
    for name, weight in before.state_dict().items():
        assert torch.equal(agent.state_dict()[name], weight)
    config = json.loads((path.parent / "config.json").read_text())
    assert config["scenes"] == ["../../attic.h5"]
    zero_shot([path.parent], episodes=1)  # type: ignore[list-item]
    report_runs([str(path.parent)], out=tmp_path / "page.html", goals_per_scene=2, walks=1)
    assert "attic" in (tmp_path / "page.html").read_text()
    with pytest.raises(ConfigError, match=r"which holds a run \(checkpoint.pt\); give another folder"):
        transplant_run(run, [str(attic)], folder=path.parent)


def test_a_bundled_room_keeps_its_name(tmp_path: Path) -> None:
    run = trained(tmp_path / "run", Path("bathroom"), "agent.shared_heads=true")
    path = transplant_run(run, ["bedroom"], folder=tmp_path / "other")
    assert json.loads((path.parent / "config.json").read_text())["scenes"] == ["bedroom"]
    assert load_agent(path)[1].names == ("bedroom",)


def test_what_cannot_be_taken_leaves_nothing(scene_file: Path, attic: Path, tmp_path: Path) -> None:
    own = trained(tmp_path / "own", scene_file)
    with pytest.raises(ConfigError, match=r"has heads of its own for each scene; .* agent.shared_heads=true"):
        transplant_run(own, [str(attic)], folder=tmp_path / "a")
    shared = trained(tmp_path / "shared", scene_file, "agent.shared_heads=true")
    with pytest.raises(ConfigError, match="does not fit the scenes' features"):
        transplant_run(shared, ["bathroom"], folder=tmp_path / "b")
    with pytest.raises(SceneError, match=r"nowhere.h5"):
        transplant_run(shared, [str(tmp_path / "nowhere.h5")], folder=tmp_path / "c")
    assert not [path for path in tmp_path.glob("[abc]/*") if path.is_file()]
