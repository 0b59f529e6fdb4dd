"""Lock-free A3C: workers train shared weights; what cannot be shared is refused before any work."""

from __future__ import annotations

import multiprocessing
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from vusfa.errors import ConfigError, WorkerError
from vusfa.experiments.training import compose_settings, train
from vusfa.training import EpisodeMeter, HogwildTrainer, load_checkpoint, make_trainer
from vusfa.training.hogwild import _make_single

SMALL = ["agent.model=vusfa", "agent.hidden_size=8", "agent.embedding_size=8", "agent.history=1"]
SMALL += ["preset=paper", "scenes=[bathroom]", "collector.num_envs=6", "evaluation=none", "autocast=false"]
SMALL += ["total_frames=1200", "optim.horizon=100000", "log_every=300"]


def made(*overrides: str) -> Any:
    return OmegaConf.to_container(compose_settings([*SMALL, *overrides]))


@pytest.mark.usefixtures("fast_workers")
def test_workers_move_the_weights_as_one_process_does(tmp_path: Path) -> None:
    """The critic's bias follows the rewards: A3C's steps of two processes add up to those of one."""
    moved = {}
    for name in ("single", "hogwild"):
        settings = made(f"collector={name}", f"folder={tmp_path / name}")
        before = {key: value.clone() for key, value in make_trainer(settings).agent.state_dict().items()}
        trainer = train(settings).trainer
        assert isinstance(trainer, HogwildTrainer) == (name == "hogwild")
        assert trainer.frames == 1200
        assert trainer.updates == {"single": 1200 // 30, "hogwild": 1200 // 15}[name]
        state = load_checkpoint(tmp_path / name / "checkpoint.pt")
        moved[name] = torch.cat([(state["agent"][key] - old).flatten() for key, old in before.items()])
        means = [entry["square_avg"].mean().item() for entry in state["optimizer"]["state"].values()]
        assert max(means) < 0.99  # of 1: it falls by a hundredth per thread's update
        assert state["algorithm"]["loss"]["bottleneck_coeff"] >= 0
    assert len((tmp_path / "hogwild" / "metrics.csv").read_text().splitlines()) == 5
    length = {name: vector.norm().item() for name, vector in moved.items()}
    assert length["hogwild"] == pytest.approx(length["single"], rel=0.5)
    cosine = torch.nn.functional.cosine_similarity(moved["single"], moved["hogwild"], dim=0)
    assert cosine > 0.5  # other rollouts; of unrelated gradients it would be near 0
    assert not multiprocessing.active_children()

    path = tmp_path / "hogwild" / "checkpoint.pt"
    resumed = train(made("collector=hogwild", f"folder={path.parent}", f"resume={path}", "total_frames=1500"))
    assert (resumed.trainer.frames, resumed.trainer.updates) == (1500, 100)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (
            ["collector.num_workers=4"],
            "collector.num_envs=6 cannot be shared out among collector.num_workers=4",
        ),
        (["optim=adam"], "shares the accumulators of optim=a3c or optim=tf_rmsprop, not those of adam"),
        (
            ["algorithm=hindsight", "optim=tf_rmsprop"],
            "collector=hogwild trains with algorithm=usf, not hindsight",
        ),
        (
            ["optim.options.threads_per_update=2"],
            "threads_per_update is 2, which does not divide the 3 threads",
        ),
        (["collector.num_workers=0"], "both must be 1 or more"),
    ],
)
def test_what_cannot_be_shared_is_refused(overrides: list[str], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        make_trainer(made("collector=hogwild", *overrides))
    assert not multiprocessing.active_children()


def test_each_worker_has_goals_of_its_own() -> None:
    trainer = make_trainer(made("collector=hogwild", "collector.num_workers=3"))
    assert isinstance(trainer, HogwildTrainer)
    goals = []
    for rank in range(3):
        collector = _make_single(trainer._make_env, trainer.settings, rank, trainer.acting)
        goals += next(iter(collector))["goal_id"][:, 0].tolist()
        collector.shutdown()
    dealt = trainer.goals.tolist()
    assert goals == [dealt[row % len(dealt)] for row in range(6)]


def test_meters_add_up(rooms: Any) -> None:
    first, second = EpisodeMeter(rooms, torch.tensor([3])), EpisodeMeter(rooms, torch.tensor([3]))
    one = {
        "sums": torch.ones(5, 1, dtype=torch.float64),
        "frames": torch.tensor(2),
        "collisions": torch.tensor(1),
    }
    second.load_state_dict(one)
    first.add(second.state_dict())
    first.add(second.state_dict())
    assert (first.flush()["episodes"], second.flush()["collisions"]) == (2.0, 0.5)


def test_workers_that_the_system_refuses(monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = make_trainer(made("collector=hogwild"))

    def refuse(process: Any) -> None:
        raise OSError(24, "Too many open files", "popen_spawn_posix.py")

    monkeypatch.setattr(multiprocessing.process.BaseProcess, "start", refuse)
    words = r"the collector's workers cannot start: .*Too many open files.*; give fewer collector.num_workers"
    with pytest.raises(WorkerError, match=words), trainer.collecting():
        pass
