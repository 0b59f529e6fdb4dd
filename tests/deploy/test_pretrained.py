"""Pretrained agents: their numbers come out again, and damaged files are refused."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from typer.testing import CliRunner

import vusfa
from vusfa.cli.app import app
from vusfa.deploy import Navigator, open_agent, pretrained_names
from vusfa.deploy.agents import PRETRAINED, read_agent, rounded, save_agent
from vusfa.deploy.cards import TOLERANCE, card_head, make_pretrained, write_log
from vusfa.errors import CheckpointError, ConfigError, ResultError, SceneError
from vusfa.evaluation import Episodes
from vusfa.evaluation.exact import exact_goals, expected_walks
from vusfa.experiments.runs import Run, write_run
from vusfa.modules import TabularPolicy
from vusfa.scenes import SceneSet
from vusfa.training import load_agent

COMMIT = "8642415ac9d1665c120192b0c2643104459e785c"
NAMES = ["gvf", "sfdp", "usfa", "vusfa"]


@pytest.fixture(scope="module")
def rooms() -> SceneSet:
    return SceneSet.bundled()


@pytest.fixture
def command() -> Callable[..., Any]:
    return lambda *arguments: CliRunner().invoke(app, ["pretrained", *map(str, arguments)])


def test_the_four_models_are_there_and_small() -> None:
    assert set(NAMES) <= set(pretrained_names())
    assert sum(path.stat().st_size for path in PRETRAINED.iterdir()) < 15e6
    assert {path.suffix for path in PRETRAINED.iterdir()} == {".safetensors", ".md", ".csv"}


@pytest.mark.parametrize("name", pretrained_names())
def test_the_cards_numbers_come_out_again(name: str, rooms: SceneSet) -> None:
    found = vusfa.load_pretrained(name, rooms)
    assert {weight.dtype for weight in load_file(PRETRAINED / f"{name}.safetensors").values()} == {
        torch.float16
    }
    exact = card_head(found.card)["vusfa"]["exact"]
    for group, goals in (("bathroom", torch.arange(176)), ("trained", found.goals)):
        policy = TabularPolicy(found.agent, rooms, goals).probabilities
        for steps in (100, 500) if group == "bathroom" else (500,):
            walks = expected_walks(policy, rooms, goals, steps)
            wanted = exact[group][f"success_{steps}"][0]
            assert walks.success.mean().item() == pytest.approx(wanted, abs=TOLERANCE)


@pytest.mark.parametrize("name", pretrained_names())
def test_a_card_says_where_its_agent_comes_from(name: str, rooms: SceneSet) -> None:
    agent, _, goals, card = vusfa.load_pretrained(name, rooms)
    head = card_head(card)
    facts = head["vusfa"]
    assert (head["license"], head["library_name"]) == ("mit", "vusfa")
    assert facts["model"] == agent.config["model"]
    assert facts["scenes_fingerprint"] == rooms.fingerprint
    assert facts["trained_goals"] == len(goals) == 20
    assert facts["bytes"] == (PRETRAINED / f"{name}.safetensors").stat().st_size
    assert facts["rounding_deviation"] <= facts["tolerance"] == TOLERANCE
    assert facts["command"].startswith("vusfa table1 ")
    assert len(facts["commit"]) == 40
    for words in ("## Limits", "## Data", facts["processor"], facts["command"], facts["commit"]):
        assert words in card
    unseen = head["model-index"][0]["results"][1]
    assert unseen["dataset"]["name"] == "bundled rooms, unseen goals"
    value, low, high = facts["exact"]["unseen"]["success_500"]
    assert unseen["metrics"][0]["value"] == value
    assert low <= value <= high
    assert f"{100 * value:.1f} % ({100 * low:.1f} to {100 * high:.1f})" in card


def test_a_name_loads_wherever_a_checkpoint_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "vusfa").mkdir()  # a folder of this name changes nothing
    assert open_agent("vusfa").agent.config["model"] == "vusfa"
    assert Navigator.load("gvf").scenes.num_scenes == 4


def test_list_and_show_read_the_cards(command: Any) -> None:
    lines = command("list").stdout.splitlines()
    assert [line.split()[0] for line in lines] == pretrained_names()
    assert all(" MB " in line and "success" in line for line in lines)
    assert command("show", "gvf").stdout.startswith("---\nlicense: mit\n")
    result = command("show", "gvv")
    assert (result.exit_code, result.stderr) == (
        1,
        "error: no pretrained agent is called 'gvv'; did you mean 'gvf'?\n",
    )
    with pytest.raises(ConfigError, match=r"is called 'none at all'; there are .*gvf, sfdp, usfa, vusfa"):
        vusfa.load_pretrained("none at all")


def test_rounding_keeps_the_error_within_the_noise() -> None:
    weights = {"matrix": torch.randn(2, 50, 60) * 0.02, "bias": torch.rand(60), "nothing": torch.zeros(2, 2)}
    found = rounded(weights, 0.01)
    error = (found["matrix"].float() - weights["matrix"]).square().mean().sqrt()
    assert 0.002 < error / weights["matrix"].square().mean().sqrt() < 0.01
    assert torch.equal(found["bias"], weights["bias"].half())
    assert not found["nothing"].any()


@pytest.fixture
def cell(world: Any, tmp_path: Path) -> Path:
    """Results of a small agent with its checkpoint, as vusfa table1 leaves them."""
    path = world.checkpoint("sfdp", history=1)
    agent, scenes, state = load_agent(path, world.scenes)
    exact = exact_goals(TabularPolicy(agent, scenes).probabilities, scenes)
    one = torch.ones(1, dtype=torch.int64)
    walks = Episodes(one, one, one, one > 0, one * 9, one * 3, one, one > 0, scenes.names, 500)
    info = {
        "model": "sfdp",
        "row": "sfdp + small",
        "seed": 7,
        "overrides": ["preset=fast", "agent.model=sfdp", "seed=7"],
        "scenes": list(scenes.names),
        "scenes_fingerprint": scenes.fingerprint,
        "trained_goals": state["goals"].tolist(),
        "frames": 0,
        "training_s": 1.5,
        "threads": 1,
        "processor": "Abacus",
        "versions": {"vusfa": vusfa.__version__},
        "checkpoint": "checkpoint-90.pt",
        "validation_spl": {"checkpoint-90.pt": 0.25},
    }
    (tmp_path / "runs" / "small" / "sfdp-7").mkdir(parents=True)
    shutil.copy(path, tmp_path / "runs" / "small" / "sfdp-7" / "checkpoint-90.pt")
    return write_run(tmp_path / "results", Run("small", "sfdp-7", info, {"sampled": walks}, exact))


def test_make_writes_an_agent_and_its_card_from_a_cell(cell: Path, tmp_path: Path, command: Any) -> None:
    out = tmp_path / "out"
    result = command("make", cell, "--runs", tmp_path / "runs", "--commit", COMMIT, "--out", out)
    assert result.exit_code == 0, result.stderr
    assert result.stdout == f"{out / 'sfdp-small.safetensors'}: 0.0 MB, card sfdp-small.md\n"
    found, card = read_agent(out / "sfdp-small.safetensors"), (out / "sfdp-small.md").read_text("utf-8")
    before, scenes, _ = load_agent(tmp_path / "runs" / "small" / "sfdp-7" / "checkpoint-90.pt")
    for name, value in before.state_dict().items():
        assert torch.allclose(found.agent.state_dict()[name], value, atol=0.03 * value.abs().max().item())
    facts = card_head(card)["vusfa"]
    assert facts["command"] == "vusfa table1 preset=fast --experiment small --models sfdp --seeds 7"
    assert "Abacus, 1 thread" in card
    exact = exact_goals(TabularPolicy(before, scenes).probabilities, scenes)
    attic = exact.metrics["spl"][exact.scene == 1].mean().item()
    assert facts["exact"]["attic"]["spl"][0] == pytest.approx(attic, abs=1e-5)
    unseen = ~torch.isin(scenes.offsets[exact.scene] + exact.goal, torch.tensor([3, 20]))
    assert facts["exact"]["unseen"]["success_100"][0] == pytest.approx(
        exact.metrics["success_100"][unseen].mean().item(), abs=1e-5
    )
    assert sorted(path.name for path in out.iterdir()) == ["sfdp-small.md", "sfdp-small.safetensors"]


def test_make_refuses_what_does_not_belong_together(
    cell: Path, world: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs, out = tmp_path / "runs", tmp_path / "out"
    with pytest.raises(ResultError, match="commit is 'main'; give the hexadecimal digits"):
        make_pretrained(cell, runs, "main", out)
    with pytest.raises(CheckpointError, match="no such checkpoint"):
        make_pretrained(cell, tmp_path, COMMIT, out)
    with pytest.raises(ResultError, match=r"cell\.json"):
        make_pretrained(tmp_path, runs, COMMIT, out)
    other = cell.with_name("sfdp-8")
    shutil.copytree(cell, other)
    shutil.copytree(runs / "small" / "sfdp-7", runs / "small" / "sfdp-8")
    content = json.loads((other / "cell.json").read_text())
    content["info"]["frames"] = 5
    (other / "cell.json").write_text(json.dumps(content))
    with pytest.raises(CheckpointError, match=r"is not the checkpoint of .*sfdp-8 \(frames differs\)"):
        make_pretrained(other, runs, COMMIT, out)
    (other / "exact.npz").unlink()
    with pytest.raises(ResultError, match="has no exact values"):
        make_pretrained(other, runs, COMMIT, out)
    monkeypatch.setattr("vusfa.deploy.agents._rounded", lambda value, noise: -value.half())
    with pytest.raises(CheckpointError, match=r"rounded to float16 a mean is 0\.\d+ off"):
        make_pretrained(cell, runs, COMMIT, out)
    assert not out.exists() or not list(out.iterdir())


def test_damaged_files_and_files_of_others_are_one_error(world: Any, tmp_path: Path) -> None:
    path, trained = tmp_path / "agent.safetensors", open_agent(world.checkpoint(), world.scenes)
    save_agent(path, *trained[:3])
    assert torch.equal(read_agent(path).goals, trained.goals)
    content = path.read_bytes()
    weights, bad = load_file(path), tmp_path / "bad.safetensors"

    def written(**changes: Any) -> Path:
        header = {
            "agent_config": trained.agent.config,
            "scenes": {
                "sources": [str(file) for file in world.files],
                "names": list(world.scenes.names),
                "fingerprint": world.scenes.fingerprint,
            },
            "goals": [1],
        }
        save_file(weights, bad, {"vusfa": json.dumps({**header, **changes})})
        return bad

    read_agent(written())
    with pytest.raises(CheckpointError, match="its entry 'goals' is 'all'"):
        read_agent(written(goals="all"))
    with pytest.raises(CheckpointError, match=r"agent_config\.hidden_size"):
        read_agent(written(agent_config={**trained.agent.config, "hidden_size": 10**9}))
    with pytest.raises(CheckpointError, match=r"'agent\.\S+' is float32"):
        read_agent(written(agent_config={**trained.agent.config, "hidden_size": 24}))
    with pytest.raises(CheckpointError, match="knows no field 'colour'"):
        read_agent(written(agent_config={**trained.agent.config, "colour": 1}))
    with pytest.raises(CheckpointError, match="graphs or features"):
        read_agent(
            written(scenes={"sources": [], "names": ["hall", "attic"], "fingerprint": "0"}), world.scenes
        )
    hall = str(world.files[0])
    for sources, fault in [
        ([hall] * 100_000, r"100000 scenes are called '\w+', of one file; name it once"),
        (["bathroom", "./../" + "a" * 5000], r"there is no such file"),
    ]:
        with pytest.raises(SceneError, match=fault):
            read_agent(written(scenes={"sources": sources, "names": ["hall", "attic"], "fingerprint": "0"}))
    weights["fusion.linear.bias"][0] = torch.nan
    with pytest.raises(CheckpointError, match="its weights hold NaN or infinity"):
        read_agent(written())
    bad.write_bytes(content[: len(content) // 2])
    with pytest.raises(CheckpointError, match=r"bad\.safetensors: no agent of vusfa"):
        read_agent(bad)
    save_file(weights, bad)
    with pytest.raises(CheckpointError, match="no agent of vusfa"):
        open_agent(bad)
    with pytest.raises(CheckpointError, match="no such file; vusfa pretrained list"):
        open_agent(tmp_path / "none.safetensors")


def test_a_learning_curve_ends_with_its_checkpoint(tmp_path: Path) -> None:
    log = tmp_path / "metrics.csv"
    rows = [f"{100 * k},{k / 1000},,0.5" for k in range(1, 501)]
    log.write_text("\n".join(["frames,success,entropy,goal/hall/3/success", *rows]))
    kept = write_log(log, tmp_path / "agent.csv", 40_000).read_text().splitlines()
    assert kept[0] == "frames,success"
    assert len(kept) == 121
    assert kept[1].startswith("100.0,0.001")
    assert kept[-1] == "40000.0,0.4"
    log.write_text("success\n0.5\n")
    with pytest.raises(ResultError, match="column 'frames' is missing"):
        write_log(log, tmp_path / "none.csv", 1)
    assert not (tmp_path / "none.csv").exists()


@pytest.mark.parametrize("name", NAMES)
def test_a_learning_curve_is_that_of_the_agent(name: str) -> None:
    frames = [float(line.split(",")[0]) for line in (PRETRAINED / f"{name}.csv").read_text().splitlines()[1:]]
    facts = card_head((PRETRAINED / f"{name}.md").read_text())["vusfa"]
    assert frames == sorted(frames)
    assert frames[-1] == facts["frames"]
