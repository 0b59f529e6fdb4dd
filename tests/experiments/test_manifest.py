from __future__ import annotations

from pathlib import Path

import pytest
import torch

from vusfa.envs import resolve_goals
from vusfa.errors import ResultError
from vusfa.evaluation import evaluate
from vusfa.experiments.manifest import make_manifest, read_manifest, write_manifest
from vusfa.modules import InferencePolicy, make_agent
from vusfa.scenes import SceneSet


def test_the_bundled_one_is_made_by_the_function() -> None:
    rooms = SceneSet.bundled()
    made, read = make_manifest(rooms, resolve_goals(rooms, "paper")), read_manifest()
    assert torch.equal(made.start, read.start)
    assert torch.equal(made.goal, read.goal)
    assert torch.equal(made.validation, read.validation)
    assert (made.seed, made.fingerprint) == (read.seed, read.fingerprint)


def test_what_the_bundled_one_holds() -> None:
    rooms, manifest = SceneSet.bundled(), read_manifest()
    trained = resolve_goals(rooms, "paper")
    start, goal = manifest.episodes(rooms)
    assert bool((rooms.distance(start, goal) > 0).all())
    assert goal.bincount(minlength=rooms.num_states).unique().tolist() == [0, 10]
    assert bool(torch.isin(trained, goal).all())
    kept = manifest.episodes(rooms, validation=True)[1].unique()
    assert rooms.scene_id[kept].bincount().tolist() == [5, 5, 5, 5]
    assert not torch.isin(kept, torch.cat([trained, goal])).any()


def test_other_scenes_are_refused() -> None:
    with pytest.raises(ResultError, match="other scenes"):
        read_manifest().episodes(SceneSet.bundled(["bathroom"]))


def test_written_and_read(tmp_path: Path) -> None:
    rooms = SceneSet.bundled(["bathroom"])
    manifest = make_manifest(rooms, torch.tensor([2]), episodes_per_goal=3, validation_goals=1, seed=7)
    again = read_manifest(write_manifest(tmp_path / "my.npz", manifest))
    assert torch.equal(again.goal, manifest.goal)
    assert again.seed == 7
    (tmp_path / "my.npz").write_bytes(b"PK")
    with pytest.raises(ResultError, match=r"my\.npz"):
        read_manifest(tmp_path / "my.npz")


def test_evaluate_walks_its_episodes_and_no_others() -> None:
    rooms = SceneSet.bundled(["bathroom"])
    manifest = make_manifest(rooms, torch.tensor([2]), episodes_per_goal=1)
    start, goal = manifest.episodes(rooms)
    agent = make_agent("gvf", scenes=rooms, history=1, hidden_size=8, embedding_size=8)
    table = evaluate(InferencePolicy(agent), rooms, episodes=(start, goal), max_steps=5, history=1)
    assert torch.equal(table.start, start)
    assert torch.equal(table.goal, goal)
