from __future__ import annotations

from pathlib import Path

import pytest
import torch

from vusfa.evaluation import evaluate, get_metric
from vusfa.experiments import measure
from vusfa.experiments.manifest import BUNDLED_MANIFEST
from vusfa.experiments.measure import choose_checkpoint, evaluation_precision, manifest_for, walk_manifest
from vusfa.modules import make_agent
from vusfa.scenes import SceneSet


@pytest.fixture
def rooms() -> SceneSet:
    return SceneSet.bundled(["bathroom"])


def test_manifests(rooms: SceneSet) -> None:
    """All four bundled rooms have theirs; any other set gets one made for it; a named one is taken as it
    is."""
    four, trained = SceneSet.bundled(), torch.tensor([3])
    assert manifest_for(four, trained).fingerprint == four.fingerprint
    other = manifest_for(rooms, trained)
    assert other.fingerprint == rooms.fingerprint
    assert len(other.goal) == 1760
    assert manifest_for(rooms, trained, BUNDLED_MANIFEST).fingerprint == four.fingerprint


def test_episodes_are_the_manifests(rooms: SceneSet) -> None:
    agent = make_agent("gvf", scenes=rooms, history=1, hidden_size=8, embedding_size=8)
    manifest, trained = manifest_for(rooms, torch.tensor([3])), torch.tensor([3])
    table = walk_manifest(agent, rooms, manifest, trained, "gvf", sample=False, validation=True)
    start, goal = manifest.episodes(rooms, validation=True)
    assert torch.equal(table.start, start)
    wanted = evaluate(
        agent.get_policy_operator(), rooms, episodes=(start, goal), trained=trained, sample=False, history=1
    )
    assert table.equal(wanted)


def test_the_best_on_the_validation_goals_is_chosen(rooms: SceneSet, monkeypatch: pytest.MonkeyPatch) -> None:
    agent = make_agent("gvf", scenes=rooms, history=1, hidden_size=8, embedding_size=8)
    manifest = manifest_for(rooms, torch.tensor([3]))
    start, goal = manifest.episodes(rooms, validation=True)

    def walked(*arguments: object, validation: bool, policy: object = None) -> object:
        assert validation
        assert not torch.is_autocast_enabled("cpu")  # one frame
        steps = {"a": 9, "b": 499, "c": 499}[str(arguments[4])]  # of most steps, more succeed
        policy = agent.get_policy_operator()
        return evaluate(policy, rooms, episodes=(start, goal), max_steps=steps, history=1)

    state = {"goals": torch.tensor([3]), "config": {"autocast": True}}
    monkeypatch.setattr(measure, "walk_manifest", walked)
    monkeypatch.setattr(measure, "load_agent", lambda path: (agent, rooms, state))
    scores = choose_checkpoint([Path("a.pt"), Path("b.pt"), Path("c.pt")])
    assert [path.stem for path in scores] == ["b", "c", "a"]
    table = walked(*[None] * 4, "b", validation=True)
    assert scores[Path("b.pt")] == get_metric("spl").value(table)  # type: ignore[arg-type]


def test_a_walk_in_the_precision_of_the_training(rooms: SceneSet) -> None:
    """Products in bfloat16 change the logits a little, and which of two likely actions is drawn now and
    then."""
    torch.manual_seed(0)
    agent = make_agent("vusfa", scenes=rooms, history=4, hidden_size=32, embedding_size=32)
    with torch.no_grad():  # an untrained policy is nearly uniform: let it prefer something
        for parameter in agent.policy.parameters():
            parameter.mul_(4.0)
    manifest, trained = manifest_for(rooms, torch.tensor([3])), torch.tensor([3])
    dtypes: list[torch.dtype] = []
    agent.scene_layer.register_forward_hook(lambda module, given, made: dtypes.append(made.dtype))
    tables = []
    for on in (False, True):
        with evaluation_precision(agent, {"autocast": on}):
            tables.append(walk_manifest(agent, rooms, manifest, trained, "", validation=True))
    assert set(dtypes) == {torch.float32, torch.bfloat16}
    success = [table.success.double().mean().item() for table in tables]
    assert success[0] == pytest.approx(success[1], abs=0.25)
    assert not tables[0].equal(tables[1])


@pytest.mark.parametrize("bfloat16", [True, False])
def test_auto_is_what_the_machine_is_faster_with(
    rooms: SceneSet, monkeypatch: pytest.MonkeyPatch, bfloat16: bool
) -> None:
    monkeypatch.setattr(measure, "resolve_autocast", lambda setting, device: bfloat16 and setting == "auto")
    agent = make_agent("vusfa", scenes=rooms, history=2, hidden_size=8, embedding_size=8)
    with evaluation_precision(agent, {"autocast": "auto"}):
        assert torch.is_autocast_enabled("cpu") is bfloat16
