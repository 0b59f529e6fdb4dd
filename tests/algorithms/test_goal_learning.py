"""Training of the algorithms that learn a critic of all goals."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf
from tensordict import TensorDict
from torch import Tensor

from vusfa.algorithms.goal_learning import GoalLearning, SceneSample, slow_copy
from vusfa.algorithms.hindsight_goals import drawn_steps
from vusfa.cli.launch import compose
from vusfa.errors import CheckpointError, ConfigError
from vusfa.training import Trainer, make_trainer

SMALL = ["agent.hidden_size=64", "agent.embedding_size=64", "autocast=false", "optim.lr=3.0e-3"]
SMALL += ["collector.num_envs=16", "algorithm.batch_size=512", "algorithm.policy_pairs=256"]
SMALL += ["algorithm.hidden_size=64", "algorithm.embedding_size=16", "env.goals=[3,9,12]"]
NAMES = ["contrastive", "implicit_q", "forward_backward"]


def trainer(scene_file: Path, name: str, *overrides: str) -> Trainer:
    cfg = compose(overrides=[f"scenes=[{scene_file}]", f"preset={name}", *SMALL, *overrides])
    settings: Any = OmegaConf.to_container(cfg, resolve=True)
    return make_trainer(settings)


def share_of_best(one: Trainer) -> float:
    """Share of all pairs whose most probable action begins a shortest path."""
    scene = one.scenes.scenes[0]
    size = scene.num_states
    state, goal = torch.arange(size).repeat_interleave(size), torch.arange(size).repeat(size)
    after = scene.distance[one.scenes.successor[state], goal.unsqueeze(-1)]
    pairs = TensorDict(
        {"state_id": state.unsqueeze(-1), "goal_id": goal, "scene_id": torch.zeros_like(goal)}, [len(goal)]
    )
    with torch.no_grad():
        chosen = one.agent.get_policy_operator().get_dist(pairs).logits.argmax(-1)
    best = after.gather(-1, chosen.unsqueeze(-1)).squeeze(-1) == after.amin(-1)
    return best[state != goal].float().mean().item()


def test_it_learns_the_way_to_goals_that_are_never_rewarded(scene_file: Path) -> None:
    torch.manual_seed(0)
    one = trainer(scene_file, "contrastive", "total_frames=8000")
    assert share_of_best(one) < 0.7
    asked: set[int] = set()
    with one.collecting() as batches:
        while one.frames < 8000:
            asked |= set(one.update(batches)[0]["goal_id"].flatten().tolist())
    assert asked == {3, 9, 12}
    assert share_of_best(one) > 0.9


def walks_on_a_ring(size: int, rows: int, discount: float) -> SceneSample:
    """Steps of random walks on a ring, forward, backward or on the spot, and where each was k steps on."""
    move = torch.tensor([1, -1, 0, 0])
    state, action = torch.randint(size, (rows,)), torch.randint(4, (rows,))
    following = (state + move[action]) % size
    steps = drawn_steps(torch.full((rows,), 20), discount)
    further = (move[torch.randint(4, (rows, 20))] * (torch.arange(20) < steps.unsqueeze(1) - 1)).sum(1)
    goal = (following + further) % size
    return SceneSample(0, torch.arange(size), state, action, following, goal, steps)


@pytest.mark.parametrize("name", NAMES)
def test_a_critic_learns_the_shorter_way_around_a_ring(scene_file: Path, name: str) -> None:
    """Of all 72 pairs of its states, from steps and walks at random."""
    torch.manual_seed(0)
    size, algorithm = 9, trainer(scene_file, name).algorithm
    assert isinstance(algorithm, GoalLearning)
    features = torch.eye(size)
    algorithm.critic = critic = algorithm.make_critic(size, 4)
    if hasattr(algorithm, "slow"):
        algorithm.slow = slow_copy(critic, 0.1)
    optimizer = torch.optim.Adam(critic.parameters(), lr=2e-3)
    for _ in range(300):
        if hasattr(algorithm, "slow"):
            algorithm.slow.update_parameters(critic)
        terms, scores = algorithm.critic_terms(walks_on_a_ring(size, 512, 0.9), features)
        optimizer.zero_grad()
        torch.stack(list(terms.values())).sum().backward()
        optimizer.step()
    state, away = torch.arange(size).repeat(size - 1), torch.arange(1, size).repeat_interleave(size)
    chosen = scores(state, (state + away) % size).argmax(-1)
    assert (chosen == torch.where(away <= size // 2, 0, 1)).float().mean() > 0.95


@pytest.mark.parametrize("name", NAMES)
def test_it_begins_after_some_walking(scene_file: Path, name: str) -> None:
    """Until then the critic stays as it is, and the policy becomes uniform."""
    one = trainer(scene_file, name, "algorithm.learning_starts=960", "optim.horizon=null")
    critic = one.algorithm.critic  # type: ignore[attr-defined]
    moved, far = [], []
    with one.collecting() as batches:
        for _ in range(8):
            before = [weight.clone() for weight in critic.parameters()]
            terms = one.update(batches)[1]
            far.append(float(terms["loss_score_objective"]) - math.log(4))
            moved.append(any(not torch.equal(x, y) for x, y in zip(before, critic.parameters(), strict=True)))
    assert moved == [False] * 6 + [True] * 2
    assert far[5] < far[0] / 4


@pytest.mark.parametrize("name", NAMES)
def test_a_resumed_training_goes_on_as_the_first(scene_file: Path, tmp_path: Path, name: str) -> None:
    early = ["algorithm.learning_starts=160", "algorithm.updates=2"]
    first = trainer(scene_file, name, *early)
    with first.collecting() as batches:
        for _ in range(3):
            first.update(batches)
        path = first.save(tmp_path / "checkpoint.pt")
        expected = first.update(batches)[1]
    second = trainer(scene_file, name, *early)
    second.resume(path)
    with second.collecting() as batches:
        found = second.update(batches)[1]
    # sums over rows that lie elsewhere in memory may be rounded in another order
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-8)


def test_weights_of_another_algorithm_are_refused(scene_file: Path) -> None:
    one = trainer(scene_file, "contrastive")
    with pytest.raises(CheckpointError, match="of another algorithm"):
        one.algorithm.warm_start({"loss": {}})


@pytest.mark.parametrize(
    ("name", "override", "message"),
    [
        ("contrastive", "algorithm.updates=0", "algorithm.updates is 0; give 1 or more"),
        ("contrastive", "algorithm.discount=1.0", "algorithm.discount is 1.0; give a number between 0 and 1"),
        (
            "contrastive",
            "algorithm.learning_starts=340000",
            "learning_starts is 340000 of total_frames 340000",
        ),
        ("contrastive", "algorithm.temperature=0.0", "algorithm=contrastive: ScoreLoss: temperature is 0.0"),
        (
            "contrastive",
            "agent.history=2",
            "algorithm=contrastive cannot train an agent with",
        ),
        (
            "contrastive",
            "optim=a3c",
            "algorithm=contrastive takes steps from replay",
        ),
        (
            "contrastive",
            "collector.kind=multi_async",
            "collector.kind=multi_async hands over",
        ),
        ("implicit_q", "algorithm.expectile=1.0", "algorithm.expectile is 1.0; give a number"),
        ("implicit_q", "algorithm.step_cost=0.0", "algorithm.step_cost is 0.0; give a number above 0"),
        ("forward_backward", "algorithm.goal_share=2.0", "goal_share 2.0; give numbers between 0 and 1"),
    ],
)
def test_settings_that_make_no_sense_are_refused(
    scene_file: Path, name: str, override: str, message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        trainer(scene_file, name, override)


def sample() -> SceneSample:
    columns = [[0, 0, 1, 0], [1, 1, 0, 1], [1, 1, 0, 1], [2, 2, 2, 0], [1, 1, 0, 0]]
    return SceneSample(0, torch.tensor([4, 5, 9]), *(torch.tensor(column) for column in columns))


def test_a_scene_is_counted_by_state_and_action() -> None:
    count = sample().counts(num_actions=2)
    assert count.shape == (6, 3)
    assert {tuple(place): int(count[tuple(place)]) for place in count.nonzero().tolist()} == {
        (1, 2): 2,
        (2, 2): 1,
        (1, 0): 1,
    }


def test_rows_of_a_few_sizes_are_rows_of_the_sample() -> None:
    rows = torch.arange(150)
    few = SceneSample(0, rows, *([rows] * 5)).of_a_few_sizes()
    assert len(few.state) == len(few.state.unique()) == 128
    assert torch.equal(few.state, few.goal)
    assert len(sample().of_a_few_sizes().state) == 4


@pytest.mark.parametrize("discount", [None, 0.5])
def test_steps_are_drawn_by_their_weights(discount: float | None) -> None:
    torch.manual_seed(0)
    drawn: Tensor = drawn_steps(torch.full((20_000,), 3), discount)
    share = drawn.bincount(minlength=4)[1:] / len(drawn)
    weights = torch.ones(3) if discount is None else torch.tensor([1.0, 0.5, 0.25])
    torch.testing.assert_close(share, weights / weights.sum(), atol=0.02, rtol=0)
