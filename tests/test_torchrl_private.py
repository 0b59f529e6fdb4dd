"""The private names of TorchRL and TensorDict still do what this package takes them for."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import BaseCollector, Collector
from torchrl.envs import EnvBase
from torchrl.envs.utils import RandomPolicy
from torchrl.weight_update import WeightSyncScheme

import vusfa
from vusfa.envs import TargetNavEnv
from vusfa.scenes import SceneSet
from vusfa.torchrl_private import StatelessEnv, carrier, put_carrier, unchecked_tensordict

PACKAGE = Path(vusfa.__file__).parent


def test_an_unchecked_tensordict_is_an_ordinary_one() -> None:
    entries = {"a": torch.arange(3), "b": torch.zeros(3, 1)}
    found = unchecked_tensordict(entries, torch.Size([3]), torch.device("cpu"))
    expected = TensorDict(entries, batch_size=[3], device="cpu")
    assert type(found) is TensorDict
    assert (found == expected).all()
    assert (found.batch_size, found.device) == (expected.batch_size, expected.device)
    assert found[1]["a"].item() == 1
    assert found.clone().set("c", torch.ones(3)).keys() == {"a", "b", "c"}


def test_a_step_with_new_episodes_is_what_torchrl_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw for draw, with the hook and without it."""
    scenes = SceneSet.bundled(["bathroom"])

    def walk() -> TensorDict:
        env = TargetNavEnv(scenes, "all", [50], max_steps=7, goal_sampling="episode", seed=3)
        torch.manual_seed(0)
        return env.rollout(40, break_when_any_done=False)

    fast = walk()
    assert fast["next", "done"].sum() > 100
    monkeypatch.delattr(StatelessEnv, "_step_and_maybe_reset")
    slow = walk()
    assert set(fast.keys(True, True)) == set(slow.keys(True, True))
    assert (fast == slow).all()


def test_torchrl_calls_the_hook() -> None:
    source = inspect.getsource(EnvBase.step_and_maybe_reset)
    assert "_step_and_maybe_reset(tensordict)" in source


def test_a_collector_steps_on_from_its_carrier() -> None:
    """Put back, it gives the same steps; without it a collector begins new episodes."""
    env = TargetNavEnv(SceneSet.bundled(["bathroom"]), "all", [4], max_steps=50, seed=0)
    collector = Collector(
        env, RandomPolicy(env.action_spec), frames_per_batch=12, total_frames=-1, track_traj_ids=False
    )
    batches = iter(collector)
    next(batches)
    stands = carrier(collector)
    torch.manual_seed(1)
    first = next(batches).clone()
    assert (first["state_id"][:, 0] == stands["state_id"]).all()
    put_carrier(collector, stands.to_dict())
    torch.manual_seed(1)
    again = next(batches)
    assert (first["next", "state_id"] == again["next", "state_id"]).all()
    collector.shutdown()


def test_weights_are_shared_by_schemes_that_end() -> None:
    assert "_weight_sync_schemes" in inspect.getsource(BaseCollector)
    assert callable(WeightSyncScheme.shutdown)


def test_torchrl_asks_whether_a_reset_resumes_episodes() -> None:
    assert EnvBase._supports_set_state is False
    assert StatelessEnv._supports_set_state is True
    env = TargetNavEnv(SceneSet.bundled(["bathroom"]), [73], [1], seed=0)
    resumed = env.reset(env.set_state(5, 73).set("elapsed_steps", torch.tensor([[9]])), set_state=True)
    assert resumed["state_id"][0, -1] == 5
    assert resumed["elapsed_steps"].item() == 9


@pytest.mark.parametrize("room", ["algorithms", "conf", "envs", "scenes", "sources", "training"])
def test_no_other_file_names_them(room: str) -> None:
    private = re.compile(
        r"_new_unsafe|_set_str|\b_step_mdp|_step_and_maybe_reset|_supports_set_state|__dict__\["
        r"|\._carrier|_weight_sync_schemes|_get_default_store"
    )
    files = sorted((PACKAGE / room).rglob("*.py"))
    assert files
    assert [str(path) for path in files if private.search(path.read_text(encoding="utf-8"))] == []
