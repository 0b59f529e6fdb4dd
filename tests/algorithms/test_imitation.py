"""Imitation of shortest paths on the agent's own walks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from vusfa.algorithms.imitation import EXPERTS, all_transitions
from vusfa.cli.launch import compose
from vusfa.errors import CheckpointError, ConfigError
from vusfa.evaluation import evaluate
from vusfa.experiments.training import compose_settings, train
from vusfa.modules import InferencePolicy
from vusfa.scenes import SceneSet
from vusfa.training import Trainer, load_checkpoint, make_trainer

SMALL = ["preset=imitation", "agent.hidden_size=64", "agent.embedding_size=32", "autocast=false"]
SMALL += ["agent.fusion=concatenation", "env.crop_dropout=0", "optim.lr=3.0e-3", "collector.num_envs=64"]
SMALL += ["collector.rollout=5", "total_frames=1000000", "optim.options.weight_decay=0"]


def trainer(scene_file: Path, *overrides: str) -> Trainer:
    cfg = compose(overrides=[f"scenes=[{scene_file}]", *SMALL, *overrides])
    settings: Any = OmegaConf.to_container(cfg, resolve=True)
    return make_trainer(settings)


def test_every_action_of_every_state_is_a_transition() -> None:
    scenes = SceneSet.bundled(["bathroom"])
    rows = all_transitions(scenes)
    assert len(rows) == 4 * 176
    assert torch.equal(rows["next", "state_id"].view(176, 4), scenes.successor)
    assert torch.equal(rows["state_id"].view(176, 4), torch.arange(176).unsqueeze(-1).expand(-1, 4))
    assert torch.equal(rows["action"].view(176, 4)[7], torch.arange(4))


def test_it_learns_the_way_to_every_goal_with_a_memory(scene_file: Path) -> None:
    one = trainer(scene_file, "agent.model=gvf", "algorithm.minibatches=2")
    terms: dict[str, Any] = {}
    with one.collecting() as batches:
        for _ in range(110):
            terms = one.update(batches)[1]
    assert float(terms["search_accuracy"]) > 0.9
    table = evaluate(InferencePolicy(one.agent), one.scenes, history=1, episodes_per_goal=4)
    assert float(table.success.double().mean()) == 1.0
    assert float(table.length.double().mean()) < 1.3 * float(table.shortest.double().mean())


def test_the_terms_are_those_of_the_expert(scene_file: Path) -> None:
    """Value and policy losses of a batch, by the scene's own distances."""
    one = trainer(scene_file, "agent.model=gvf", "agent.memory=null", "agent.previous_action=false")
    with one.collecting() as batches:
        batch = one.collect(batches)
    terms = {name: value.item() for name, value in one.algorithm.losses(batch).items()}
    state, goal = batch["state_id"][..., -1], batch["goal_id"]
    scene, ahead = one.scenes, one.scenes.successor[state]
    steps = scene.distance(state, goal).double()
    best = scene.distance(ahead, goal.unsqueeze(-1).expand_as(ahead)) == (steps - 1).unsqueeze(-1)
    with torch.no_grad():
        probs = one.agent.get_policy_operator().get_dist(batch.clone()).probs.double()
        value = one.agent.get_value_operator()(batch.clone())["state_value"].squeeze(-1).double()
    gamma = 0.95
    target = gamma ** (steps - 1) - 0.01 * (1 - gamma ** (steps - 1)) / (1 - gamma)
    assert terms["loss_search_objective"] == pytest.approx(
        float(-(probs * best).sum(-1).log().mean()), rel=1e-4
    )
    assert terms["loss_search_critic"] == pytest.approx(float((value - target).square().mean()), rel=1e-4)


@pytest.mark.parametrize("model", ["gvf", "usfa", "sfdp", "vusfa"])
def test_models_learn_what_is_theirs_besides(scene_file: Path, model: str) -> None:
    one = trainer(scene_file, f"agent.model={model}", "objective.successor_coeff=0.5")
    with one.collecting() as batches:
        for _ in range(3):
            terms = one.update(batches)[1]
    assert ("loss_successor" in terms) == (model != "gvf")
    assert ("loss_bottleneck" in terms) == (model == "vusfa")
    assert float(terms.get("loss_objective", 0.0)) == float(terms.get("loss_critic", 0.0)) == 0.0
    if model != "gvf":
        assert float(terms["loss_successor"]) > 0.0


def test_own_transitions_are_labels_too(scene_file: Path) -> None:
    """At first few paths are known; of a scene that is walked whole, as many as its graph has."""
    one = trainer(scene_file, "algorithm.expert=experience", "agent.model=gvf", "collector.num_envs=8")
    expert = one.algorithm.expert  # type: ignore[attr-defined]
    assert expert.num_transitions == 0
    with one.collecting() as batches:
        one.update(batches)
        assert 0 < expert.num_transitions < 64
        for _ in range(50):
            batch = one.update(batches)[0]
    assert expert.num_transitions == 64
    state, goal = batch["state_id"][..., -1], batch["goal_id"]
    assert torch.equal(expert.label(state, goal)[0], one.scenes.distance(state, goal).long())


@pytest.mark.parametrize("expert", EXPERTS)
def test_it_resumes(scene_file: Path, tmp_path: Path, expert: str) -> None:
    """Number for number what an uninterrupted training computes."""
    runs = []
    for stops in (False, True):
        torch.manual_seed(0)
        one = trainer(scene_file, f"algorithm.expert={expert}")
        with one.collecting() as batches:
            one.update(batches)
            path = one.save(tmp_path / "a.pt")
            if not stops:
                one.update(batches)
        if stops:
            one = trainer(scene_file, f"algorithm.expert={expert}")
            one.resume(path)
            with one.collecting() as batches:
                one.update(batches)
        runs.append(one)
    for name, weight in runs[0].agent.state_dict().items():
        assert torch.equal(weight, runs[1].agent.state_dict()[name]), name
    assert ("experience" in load_checkpoint(path)["algorithm"]) == (expert == "experience")
    if expert == "scenes":
        with pytest.raises(CheckpointError, match="without a graph of own transitions; give expert=scenes"):
            trainer(scene_file, "algorithm.expert=experience").resume(path)


@pytest.mark.parametrize(
    ("overrides", "told"),
    [
        (["objective.objective_coeff=1"], "give objective.objective_coeff=0, and algorithm.objective_coeff"),
        (["objective.critic_coeff=0.5"], "give objective.critic_coeff=0, and algorithm.critic_coeff"),
        (["optim=a3c"], "algorithm=imitation knows no threads, .*; give optim=adam"),
        (["algorithm.minibatches=3"], "minibatches is 3, which does not divide collector.num_envs=64"),
        (["algorithm.expert=teacher"], "algorithm.expert is 'teacher'"),
        (["algorithm.minibatches=0"], "minibatches is 0"),
    ],
)
def test_what_makes_no_sense_is_refused(scene_file: Path, overrides: list[str], told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        trainer(scene_file, *overrides)


def test_a_checkpoint_from_before_these_settings_goes_on(scene_file: Path, tmp_path: Path) -> None:
    small = ["agent.hidden_size=8", "agent.embedding_size=8", "collector.num_envs=4", "collector.rollout=5"]
    small += [f"scenes=[{scene_file}]", "evaluation=none", f"folder={tmp_path / 'run'}", "total_frames=40"]
    path = train(compose_settings(small)).trainer and tmp_path / "run" / "checkpoint.pt"
    state = torch.load(path, weights_only=True)
    for name in ("fusion", "previous_action"):
        del state["agent_config"][name], state["config"]["agent"][name]
    torch.save(state, path)
    resumed = train(compose_settings([*small[:-1], "total_frames=80", "resume=auto"]))
    assert resumed.trainer.frames == 80
