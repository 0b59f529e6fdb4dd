"""Agents that read ids train on all crops of a state, and are evaluated on the first."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf
from tensordict import TensorDict

from vusfa.cli.launch import compose
from vusfa.errors import ConfigError
from vusfa.experiments.measure import measure_goals
from vusfa.modules import FeatureFrames, InferencePolicy, TabularPolicy
from vusfa.scenes import Scene
from vusfa.training import Trainer, make_trainer

CROPS = 5
SMALL = ["env.goals=[3,9,12]", "agent.hidden_size=8", "agent.embedding_size=8", "agent.history=1"]
SMALL += ["collector.num_envs=6", "collector.rollout=4", "env.goal_sampling=episode"]
SEARCH = [
    "algorithm=replay_search",
    "algorithm.batch_size=16",
    "algorithm.num_goals=4",
    "algorithm.updates=3",
]
SEARCH += ["algorithm.learning_starts=0"]
HINDSIGHT = ["algorithm=hindsight", "hindsight.batch_size=16", "hindsight.updates=3"]


@pytest.fixture
def room(make_scene: Callable[..., Scene], tmp_path: Path) -> Path:
    """A room with crops that have nothing in common: crop c of a state is its first plus 10 c."""
    one = make_scene()
    features = one.features + 10 * torch.arange(CROPS).view(1, -1, 1)
    Scene("hall", one.graph, features).save(tmp_path / "hall.h5")
    return tmp_path / "hall.h5"


def made(room: Path, *overrides: str) -> Trainer:
    cfg = compose(overrides=[f"scenes=[{room}]", *SMALL, *overrides])
    settings: Any = OmegaConf.to_container(cfg, resolve=True)
    return make_trainer(settings)


def frames(trainer: Trainer) -> FeatureFrames:
    found = trainer.agent.encoder.frames
    assert isinstance(found, FeatureFrames)
    return found


def shown(trainer: Trainer) -> torch.Tensor:
    """Which crop of each state the agent sees."""
    apart = trainer.scenes.features - _raw(trainer).unsqueeze(1)
    least = apart.abs().amax(-1).min(1)
    assert least.values.max() < 1e-4
    return least.indices


def _raw(trainer: Trainer) -> torch.Tensor:
    of, table = frames(trainer), frames(trainer).lookup(None)
    return table * of.deviation + of.mean if of.normalize else table


@pytest.mark.parametrize("algorithm", [[], HINDSIGHT, SEARCH], ids=["usf", "hindsight", "search"])
def test_every_step_draws_a_crop_of_each_state(room: Path, algorithm: list[str]) -> None:
    trainer = made(room, "env.crop=random", *algorithm)
    seen, show = [], trainer.algorithm.show_crops

    def recorded() -> None:
        show()
        seen.append(shown(trainer))

    trainer.algorithm.show_crops = recorded  # type: ignore[method-assign]
    with trainer.collecting() as batches:
        for _ in range(8):
            trainer.update(batches)
    assert len(seen) == 8 * (1 + trainer.algorithm.replay_steps)
    counts = torch.stack(seen).flatten().bincount(minlength=CROPS).double()
    assert counts.min() > 0.5 * counts.sum() / CROPS
    assert len({tuple(each.tolist()) for each in seen}) == len(seen)


def test_evaluation_sees_the_first_crop(room: Path) -> None:
    """Also one that follows an update: what was cached of another crop is not taken."""
    trainer = made(room, "env.crop=random")
    with trainer.collecting() as batches:
        trainer.update(batches)
    assert bool((shown(trainer) > 0).any())
    goals = torch.arange(16)
    mid = measure_goals(trainer, goals, episodes_per_goal=1, max_steps=20)
    table = TabularPolicy(trainer.agent.eval(), trainer.scenes)
    assert bool((shown(trainer) == 0).all())
    frames(trainer).show(None)
    plain = TabularPolicy(trainer.agent, trainer.scenes)
    assert torch.equal(table._logits, plain._logits)
    after = measure_goals(trainer, goals, episodes_per_goal=1, max_steps=20)
    assert torch.equal(mid.success, after.success)


def test_the_walk_sees_what_the_loss_sees(room: Path) -> None:
    """The cached policy of the collector and the agent itself agree on the crops drawn."""
    trainer = made(room, "env.crop=random")
    trainer.algorithm.show_crops()
    policy, goal = InferencePolicy(trainer.agent), torch.tensor([3, 9])
    state, scene = torch.tensor([[1], [7]]), torch.zeros(2, dtype=torch.int64)
    before = policy.logits(state, goal, scene)
    with policy.cached(goal):
        assert torch.allclose(policy.logits(state, goal, scene), before, atol=1e-5)
    trainer.algorithm.show_crops()
    with policy.cached(goal):
        assert not torch.allclose(policy.logits(state, goal, scene), before, atol=1e-5)


def test_a_crop_by_its_index(room: Path) -> None:
    trainer = made(room, "env.crop=3")
    trainer.algorithm.show_crops()
    assert shown(trainer).unique().tolist() == [3]
    with pytest.raises(ConfigError, match=r"crop is 5; give 'first', 'random', or an index below 5"):
        made(room, "env.crop=5")
    with pytest.raises(ConfigError, match="crop is 'second'"):
        made(room, "env.crop=second")


def test_the_first_crop_draws_nothing(room: Path) -> None:
    trainer = made(room)
    before = torch.get_rng_state()
    trainer.algorithm.show_crops()
    assert torch.equal(torch.get_rng_state(), before)
    assert bool((shown(trainer) == 0).all())


def test_resumed_number_for_number(room: Path, tmp_path: Path) -> None:
    whole = made(room, "env.crop=random", *SEARCH)
    with whole.collecting() as batches:
        for _ in range(2):
            whole.update(batches)
        whole.save(tmp_path / "half.pt")
        whole.update(batches)
    again = made(room, "env.crop=random", *SEARCH)
    again.resume(tmp_path / "half.pt")
    with again.collecting() as batches:
        again.update(batches)
    for name, value in whole.agent.state_dict().items():
        assert torch.equal(value, again.agent.state_dict()[name]), name


def test_an_agent_that_is_handed_features_is_evaluated_on_the_first_crop(room: Path) -> None:
    trainer = made(room, "env.crop=random", "agent.observation=features")
    assert trainer.observation is not None
    data = TensorDict({"state_id": torch.arange(16).view(16, 1), "goal_id": torch.arange(16)}, [16])
    assert torch.equal(trainer.observation(data)["goal_observation"], trainer.scenes.features[:, 0])
    with trainer.collecting() as batches:
        drawn = trainer.update(batches)[0]
    first = trainer.scenes.features[drawn["goal_id"], 0]
    assert not torch.equal(drawn["goal_observation"], first)


def test_dropout_of_features_is_drawn_for_every_look_up_and_evaluation_has_none(room: Path) -> None:
    trainer = made(room, "env.crop_dropout=0.5")
    trainer.agent.eval()
    table = frames(trainer).lookup(None).clone()
    trainer.agent.train()
    one = frames(trainer).lookup(None).clone()
    other = frames(trainer).lookup(None)
    assert torch.allclose(one, torch.where(one == 0, 0.0, 2 * table))
    assert 0.3 < float((one == 0).float().mean()) < 0.7
    assert not torch.equal(one == 0, other == 0)
    trainer.agent.eval()
    assert torch.equal(frames(trainer).lookup(None), table)


def test_dropout_takes_its_share_and_the_others_make_up_for_it() -> None:
    shown = FeatureFrames(torch.ones(50, 1, 400))
    shown.dropout = 0.2  # 51 of 256
    seen = shown.lookup(None)
    assert torch.equal(seen.unique(), torch.tensor([0, 256 / 205]))
    assert 0.18 < float((seen == 0).float().mean()) < 0.22  # seven standard deviations
    assert not torch.equal(seen[0], seen[1])


@pytest.mark.parametrize(
    ("overrides", "told"),
    [
        (["env.crop_dropout=-1"], r"env.crop_dropout is -1.0; give a number from 0 to 255/256"),
        (["env.crop_dropout=nan"], r"env.crop_dropout is nan; give a number from 0 to 255/256"),
        (
            ["env.crop_dropout=0.5", "agent.observation=features"],
            "env.crop_dropout is 0.5: only an agent that looks features up",
        ),
    ],
)
def test_dropout_that_makes_no_sense_is_refused(room: Path, overrides: list[str], told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        made(room, *overrides)
