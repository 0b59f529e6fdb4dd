"""Agents of the package on a page, without a training."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from vusfa.errors import ConfigError
from vusfa.report import Options, read_source
from vusfa.report.cells import result_run
from vusfa.report.content import gather
from vusfa.report.run_agents import open_agent_of, pretrained_of, pretrained_run
from vusfa.scenes import SceneSet

RESULTS = Path(__file__).parents[2] / "results"


def test_a_name_is_a_source(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("vusfa.report.cells.pretrained_run", lambda *arguments: arguments)
    assert read_source("gvf") == [("gvf", "")]
    assert read_source("mine=gvf") == [("gvf", "mine")]
    (tmp_path / "gvf").mkdir()  # a folder of that name, but of nothing that a report reads
    assert read_source("gvf") == [("gvf", "")]
    for wrong in ("vusfe", str(tmp_path / "nothing")):
        with pytest.raises(ConfigError, match=r"or a pretrained agent \(gvf, "):
            read_source(wrong)


def test_a_pretrained_agent_has_all_that_a_run_has(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("vusfa.report.run_agents._EPISODES", 1)
    run = pretrained_run("gvf")
    assert (run.label, run.seed) == ("gvf (pretrained)", 0)
    assert run.episodes is not None
    assert len(run.episodes) == 1712
    assert run.episodes.success[run.episodes.trained].all()
    assert run.curves["frames"][-1] == run.frames
    content, rows = gather([run], Options(goals_per_scene=1, walks=1))
    (agent,) = content["agents"]
    assert agent["trained"]["bathroom"] == [0, 73, 96, 101, 173]
    assert {row["name"] for row in content["curves"]} >= {"success", "entropy"}
    assert len(rows["goals"]) == 1712


def test_results_have_the_agent_of_their_training():
    run = result_run(RESULTS / "table1" / "vusfa-0")
    assert run.checkpoint is not None
    assert run.checkpoint.name == "vusfa.safetensors"
    assert len(run.curves["frames"]) > 50
    world = SceneSet.bundled()
    saved = open_agent_of(run, {scene.name: scene for scene in world.scenes})
    assert saved.frames == run.frames
    assert saved.agent.config["model"] == "vusfa"
    assert torch.equal(saved.goals.unique(), saved.goals.sort().values)


@pytest.mark.parametrize("other", ["table1/vusfa-1", "hindsight/vusfa-0", "controlled/gvf-0"])
def test_results_of_another_training_have_none(other: str):
    assert result_run(RESULTS / other).checkpoint is None


def test_a_training_of_another_length_is_another():
    run = dataclasses.replace(result_run(RESULTS / "table1" / "gvf-0"), checkpoint=None)
    assert pretrained_of(run).checkpoint is not None
    for facts in (
        {"frames": run.frames, "seconds": run.seconds + 1},
        {"frames": 1.0, "seconds": run.seconds},
    ):
        assert pretrained_of(dataclasses.replace(run, facts=facts)).checkpoint is None
    assert pretrained_of(dataclasses.replace(run, seed=1)).checkpoint is None
