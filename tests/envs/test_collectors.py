"""The environment inside TorchRL's collectors, worker processes included."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector, MultiAsyncCollector, MultiSyncCollector

from vusfa.envs import TargetNavEnv
from vusfa.scenes import Scene, SceneSet


@pytest.fixture
def make_env(make_scene: Callable[..., Scene]) -> Callable[[], TargetNavEnv]:
    """Picklable, as worker processes need it: no lambda, no open file."""
    scenes = SceneSet([make_scene("hall"), make_scene("attic", 3, 1)])
    return functools.partial(TargetNavEnv, scenes, "all", [4], max_steps=5, goal_sampling="episode")


@pytest.fixture(autouse=True)
def threads() -> Iterator[None]:
    """Collectors with workers change the number of threads for good."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def check_continuity(data: TensorDictBase, scenes: SceneSet) -> None:
    """Each step goes on where the last one ended, or begins anew where it ended an episode; (..., T)."""
    moved = scenes.successor[data["state_id"][..., -1], data["action"]]
    assert torch.equal(data["next", "state_id"][..., -1], moved)
    ended = data["next", "done"][..., :-1, :]
    assert ended.any()
    assert torch.equal(data["elapsed_steps"][..., 1:, :], data["next", "elapsed_steps"][..., :-1, :] * ~ended)
    same = torch.where(ended, data["state_id"][..., 1:, :], data["next", "state_id"][..., :-1, :])
    assert torch.equal(data["state_id"][..., 1:, :], same)


def test_collector(make_env: Callable[[], TargetNavEnv]) -> None:
    def collect(seed: int) -> list[TensorDictBase]:
        collector = Collector(
            make_env,
            None,
            frames_per_batch=4 * 12,
            total_frames=4 * 36,
            auto_register_policy_transforms=False,
        )
        collector.set_seed(seed)
        collector.reset()
        torch.manual_seed(0)
        batches = [batch.clone() for batch in collector]
        collector.shutdown()
        return batches

    batches = collect(3)
    assert [tuple(batch.shape) for batch in batches] == [(4, 12)] * 3
    check_continuity(torch.cat(batches, -1).exclude("collector"), make_env().scenes)
    starts = torch.cat([batch["state_id"] for batch in batches], 1)
    assert torch.equal(torch.cat([batch["state_id"] for batch in collect(3)], 1), starts)
    assert not torch.equal(torch.cat([batch["state_id"] for batch in collect(4)], 1), starts)


def test_collectors_store_and_load_it_strictly(make_env: Callable[[], TargetNavEnv]) -> None:
    collector = Collector(
        make_env, None, frames_per_batch=48, total_frames=96, auto_register_policy_transforms=False
    )
    next(iter(collector))
    before = {key: value.clone() for key, value in collector.env.state_dict().items()}
    assert before
    state = collector.state_dict()
    assert state["env_state_dict"] == {}  # which strictly lacks what the environment has
    collector.env.load_state_dict(state["env_state_dict"])
    after = collector.env.state_dict()
    assert after.keys() == before.keys()
    assert all(torch.equal(after[key], value) for key, value in before.items())
    collector.shutdown()


@pytest.mark.usefixtures("fast_workers")
@pytest.mark.parametrize("kind", [MultiSyncCollector, MultiAsyncCollector])
def test_workers_draw_apart_and_reproducibly(kind: Any, make_env: Callable[[], TargetNavEnv]) -> None:
    """Each worker gets a seed of its own through set_seed."""
    with warnings.catch_warnings():
        # Python's own multiprocessing may find a pipe's end closed while the workers shut down.
        warnings.simplefilter("default", ResourceWarning)
        collector = kind(
            [make_env, make_env],
            None,
            frames_per_batch=2 * 4 * 12 if kind is MultiSyncCollector else 4 * 12,
            total_frames=-1,
            cat_results="stack" if kind is MultiSyncCollector else None,
            auto_register_policy_transforms=False,
        )
        collector.set_seed(0)  # resets, too; a Collector without workers does not
        found = []
        for batch in collector:
            found.append(batch.clone())
            if len(found) == 4:
                break
        collector.shutdown()
    scenes = make_env().scenes
    for batch in found:
        check_continuity(batch.exclude("collector"), scenes)
    if kind is MultiSyncCollector:
        assert found[0].shape == (2, 4, 12)
        first = [TargetNavEnv.reset(seeded(make_env, seed))["goal_id"] for seed in worker_seeds(2)]
        assert not torch.equal(*first)
        assert torch.equal(found[0]["goal_id"][:, :, 0], torch.stack(first))


def seeded(make_env: Callable[[], TargetNavEnv], seed: int) -> TargetNavEnv:
    env = make_env()
    env.set_seed(seed)
    return env


def worker_seeds(count: int) -> list[int]:
    """The seeds that a collector seeded with 0 hands to its workers, one after the other."""
    seeds, env = [0], TargetNavEnv(SceneSet.bundled(["bathroom"]))
    while len(seeds) < count:
        following = env.set_seed(seeds[-1])
        assert following is not None
        seeds.append(following)
    return seeds
