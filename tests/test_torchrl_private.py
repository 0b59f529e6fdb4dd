"""The private names of TorchRL and TensorDict still do what this package takes them for."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import EnvBase

import vusfa
from vusfa.envs import TargetNavEnv
from vusfa.scenes import SceneSet
from vusfa.torchrl_private import StatelessEnv, unchecked_tensordict

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


def test_torchrl_asks_whether_a_reset_resumes_episodes() -> None:
    assert EnvBase._supports_set_state is False
    assert StatelessEnv._supports_set_state is True
    env = TargetNavEnv(SceneSet.bundled(["bathroom"]), [73], [1], seed=0)
    resumed = env.reset(env.set_state(5, 73).set("step_count", torch.tensor([[9]])), set_state=True)
    assert resumed["state_id"][0, -1] == 5
    assert resumed["step_count"].item() == 9


@pytest.mark.parametrize("room", ["envs", "scenes", "sources"])
def test_no_other_file_names_them(room: str) -> None:
    private = re.compile(
        r"_new_unsafe|_set_str|\b_step_mdp|_step_and_maybe_reset|_supports_set_state|__dict__\["
    )
    files = sorted((PACKAGE / room).rglob("*.py"))
    assert files
    assert [str(path) for path in files if private.search(path.read_text(encoding="utf-8"))] == []
