"""optim=a3c: a step of the optimizer, and one of the multiplier, for every environment of a batch."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from vusfa.cli.launch import compose
from vusfa.conf import FOLDER as CONF
from vusfa.errors import ConfigError
from vusfa.training import Trainer, make_trainer

SMALL = [
    "preset=paper",
    "agent.model=vusfa",
    "env.goals=[3,9,12]",
    "agent.hidden_size=8",
    "agent.embedding_size=8",
    "collector.num_envs=6",
]


def made(scene_file: Path, *overrides: str) -> Trainer:
    cfg = compose(CONF, "train", [f"scenes=[{scene_file}]", *SMALL, *overrides])
    settings: Any = OmegaConf.to_container(cfg, resolve=True)
    return make_trainer(settings)


def trained(trainer: Trainer, updates: int = 1) -> torch.Tensor:
    """Weights after a few updates, as one vector."""
    with trainer.collecting() as batches:
        for _ in range(updates):
            trainer.update(batches)
    return torch.cat([param.detach().flatten() for param in trainer.agent.parameters()])


@pytest.fixture
def start(scene_file: Path) -> torch.Tensor:
    return torch.cat([param.detach().flatten() for param in made(scene_file).agent.parameters()])


@pytest.mark.parametrize("preset", ["paper", "reference"])
def test_the_papers_presets_step_for_all_threads(scene_file: Path, preset: str) -> None:
    trainer = made(scene_file, f"preset={preset}")
    assert trainer.optimizer.param_groups[0]["threads"] == 6
    assert trainer.algorithm.threads == 6
    multiplier = trainer.algorithm.multiplier  # type: ignore[attr-defined]
    assert (multiplier.step_size, multiplier.threads) == (1e-6, 6)


def test_six_threads_move_the_weights_six_times_as_far(scene_file: Path, start: torch.Tensor) -> None:
    ours = trained(made(scene_file)) - start
    once = trained(made(scene_file, "optim=tf_rmsprop")) - start
    # the accumulator falls during the sequence: a little more than six times
    assert 6.0 < (ours.norm() / once.norm()).item() < 6.3
    assert torch.cosine_similarity(ours, once, dim=0) > 0.999


def test_groups_of_threads_come_near_to_the_same_step(scene_file: Path, start: torch.Tensor) -> None:
    """As many steps per batch as there are groups; with one thread each, the sequence of updates itself."""
    steps = {}
    for threads in (1, 2, 6):
        trainer = made(scene_file, f"optim.options.threads_per_update={threads}", "agent.model=gvf")
        parts = []
        losses = trainer.algorithm.losses
        trainer.algorithm.losses = lambda part, losses=losses, parts=parts: (
            parts.append(part),
            losses(part),
        )[1]  # type: ignore[misc]
        before = torch.cat([param.detach().flatten() for param in trainer.agent.parameters()])
        steps[threads] = trained(trainer) - before
        assert [part.shape for part in parts] == [(threads, 5)] * (6 // threads)
        assert trainer.frames == 30
    for threads in (2, 6):
        difference = (steps[threads] - steps[1]).norm() / steps[1].norm()
        assert difference < 0.05


def test_the_multiplier_moves_with_every_group(scene_file: Path) -> None:
    trainer = made(scene_file, "optim.options.threads_per_update=2", "objective.information_target=-1.0")
    trained(trainer)
    beta = trainer.algorithm.loss.bottleneck_coeff.item()  # type: ignore[attr-defined]
    # six threads, each of which exceeds the target by 1 nat and its own divergence
    assert 6e-6 < beta < 12e-6


def test_asynchronous_batches_hold_one_workers_threads(scene_file: Path) -> None:
    trainer = made(
        scene_file, "collector=multi_async", "collector.num_workers=3", "env.goal_sampling=episode"
    )
    assert trainer.algorithm.threads == 2


def test_a_number_that_does_not_divide_is_refused(scene_file: Path) -> None:
    words = r"^optim\.options\.threads_per_update is 4, which does not divide the 6 threads; give 3 or 6$"
    with pytest.raises(ConfigError, match=words):
        made(scene_file, "optim.options.threads_per_update=4")


def test_hindsight_has_no_threads(scene_file: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"algorithm=hindsight .*a3c_rmsprop makes an update per environment .* optim=adam"
    ):
        made(scene_file, "algorithm=hindsight", "agent.history=1")


def test_an_unknown_option_is_named(scene_file: Path) -> None:
    with pytest.raises(ConfigError, match=r"optim\.kind=a3c_rmsprop does not take .*momentum"):
        made(scene_file, "+optim.options.momentum=0.9")
