"""Training on shortest paths of the agent's own transitions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf
from tensordict import TensorDict

from vusfa.cli.launch import compose
from vusfa.errors import ConfigError
from vusfa.training import Trainer, make_trainer

SMALL = ["preset=replay_search", "agent.hidden_size=64", "agent.embedding_size=64", "autocast=false"]
SMALL += ["optim.lr=3.0e-3", "collector.num_envs=16", "algorithm.batch_size=256", "algorithm.num_goals=8"]
SMALL += ["algorithm.learning_starts=320", "env.goals=[3,9,12]"]


def trainer(scene_file: Path, *overrides: str) -> Trainer:
    cfg = compose(overrides=[f"scenes=[{scene_file}]", *SMALL, *overrides])
    settings: Any = OmegaConf.to_container(cfg, resolve=True)
    return make_trainer(settings)


def test_it_learns_the_way_to_goals_that_are_never_rewarded(scene_file: Path) -> None:
    """The policy's most probable actions are first steps of the scene's shortest paths, for all pairs."""
    one = trainer(scene_file, "total_frames=4800")
    scene = one.scenes.scenes[0]
    with one.collecting() as batches:
        while one.frames < 320:
            one.update(batches)
            assert one.algorithm.replay_steps == 0
        before = one.algorithm.graph.num_transitions  # type: ignore[attr-defined]
        while one.frames < 4800:
            one.update(batches)
    assert one.algorithm.replay_steps == 9
    assert before <= one.algorithm.graph.num_transitions  # type: ignore[attr-defined]
    size = scene.num_states
    state, goal = torch.arange(size).repeat_interleave(size), torch.arange(size).repeat(size)
    after = scene.distance[one.scenes.successor[state], goal.unsqueeze(-1)]
    pairs = TensorDict(
        {"state_id": state.unsqueeze(-1), "goal_id": goal, "scene_id": torch.zeros_like(goal)}, [len(goal)]
    )
    with torch.no_grad():
        chosen = one.agent.get_policy_operator().get_dist(pairs).logits.argmax(-1)
    best = after.gather(-1, chosen.unsqueeze(-1)).squeeze(-1) == after.amin(-1)
    assert best[state != goal].float().mean() > 0.95
    never = ~torch.isin(goal, torch.tensor([3, 9, 12]))
    assert best[never & (state != goal)].float().mean() > 0.95


def test_episodes_go_to_the_trained_goals_alone(scene_file: Path) -> None:
    one = trainer(scene_file)
    asked = set()
    with one.collecting() as batches:
        for _ in range(4):
            asked |= set(one.update(batches)[0]["goal_id"].flatten().tolist())
    assert asked == {3, 9, 12}
    assert one.algorithm.replay_steps == 9


@pytest.mark.parametrize(("frames", "starts"), [(340_000, 100_000), (1_000_000, 100_000), (500, 200)])
def test_a_search_begins_after_a_part_of_the_training(scene_file: Path, frames: int, starts: int) -> None:
    """And does not stop where a resumed training is given more frames."""
    algorithm = trainer(scene_file, f"total_frames={frames}", "algorithm.learning_starts=null").algorithm
    for now, steps in ((0, 0), (starts - 1, 0), (starts, 9), (starts - 1, 9)):
        algorithm.schedule(now)
        assert algorithm.replay_steps == steps
    longer = trainer(scene_file, "algorithm.learning_starts=250000").algorithm
    longer.load_state_dict(algorithm.state_dict())
    longer.schedule(starts)
    assert longer.replay_steps == 9


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("algorithm.updates=0", "algorithm.updates is 0; give 1 or more"),
        ("algorithm.num_goals=0", "algorithm.num_goals is 0; give 1 or more"),
        ("algorithm.batch_size=7", "batch_size is 7 for 8 goals"),
        ("algorithm.path_share=1.5", "path_share is 1.5"),
        ("algorithm.learning_starts=-1", "learning_starts is -1 of total_frames 340000: nothing would be"),
        ("algorithm.learning_starts=340000", "learning_starts is 340000 of total_frames 340000"),
        (
            "agent.history=2",
            "algorithm=replay_search cannot train an agent with agent.history=2; give agent.hi",
        ),
        ("agent=lstm", "agent.memory=lstm; give agent.memory=null, or algorithm=usf"),
        ("agent.observation=features", "agent.observation=index"),
        ("optim=a3c", "optim.kind=a3c_rmsprop"),
        ("objective.gamma=1.0", "replay_search: SearchLoss: gamma is 1.0"),
    ],
)
def test_settings_that_make_no_sense_are_refused(scene_file: Path, override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        trainer(scene_file, override)
