"""Wrong uses of the environments: one error that names the argument and what to do."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import GymWrapper, StepCounter, TransformedEnv
from torchrl.envs.utils import RandomPolicy, check_env_specs

from vusfa.envs import SceneObservation, TargetNavEnv
from vusfa.errors import ActionError, ConfigError, GoalError
from vusfa.scenes import Scene, SceneSet

ENV_ID = "vusfa/TargetNav-v0"


@pytest.fixture
def scenes(make_scene: Callable[..., Scene]) -> SceneSet:
    return SceneSet([make_scene("hall"), make_scene("attic", 3, 1)])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scenes": ["bathroom"]}, r"scenes is \['bathroom'\]; give a SceneSet"),
        ({"scenes": "x" * 10_000}, r"scenes is 'x+\.\.\.x+'; give a SceneSet"),
        ({"scenes": None}, "scenes is None; give a SceneSet"),
        ({"batch_size": 4}, r"batch_size is 4; give a list, \[4\]"),
        ({"batch_size": "four"}, "batch_size is 'four'; give a list"),
        ({"batch_size": 2.5}, "batch_size is 2.5; give a list"),
        ({"batch_size": [-1]}, r"batch_size is \[-1\]; give lengths of 1 or more"),
        ({"batch_size": [2, -3]}, r"batch_size is \[2, -3\]; give lengths"),
        ({"batch_size": [0]}, r"batch_size is \[0\]; give lengths"),
        ({"batch_size": [True]}, r"batch_size is \[True\]; give lengths of 1 or more"),
        ({"batch_size": True}, r"batch_size is True; give a list, \[64\]"),
        ({"batch_size": [2.0]}, r"batch_size is \[2.0\]; give lengths"),
        (
            {"batch_size": [10**13]},
            r"batch_size is \[1\d+\]; with history=4 give at most 16,777,216 environments",
        ),
        ({"batch_size": [10**5] * 3}, "with history=4 give at most"),
        ({"batch_size": [2], "history": 10**9}, "with history=1000000000 give at most 0 environments"),
        ({"history": True}, "history is True; give a whole number"),
        ({"max_steps": 2.5}, "max_steps is 2.5; give a whole number"),
        ({"max_steps": 10**30}, r"max_steps is 1\d+; give a whole number below"),
        ({"first_goal": "1"}, "first_goal is '1'; give a whole number"),
        ({"seed": True}, "seed is True; give a whole number"),
        ({"seed": -1}, "seed is -1; give a whole number of 0 or more"),
        ({"seed": 1.5}, "seed is 1.5"),
        ({"seed": 2**64}, "seed is 18446744073709551616"),
        ({"device": "gpu"}, "device is 'gpu'.*cannot be used here"),
        ({"device": "cuda:99"}, "device is 'cuda:99'.*cannot be used here"),
        ({"history": 0}, "history is 0"),
        ({"rotation": 4}, "rotation is 4; give a SceneRotation"),
        ({"goal_reward": float("nan")}, "goal_reward is nan; give a finite number"),
        ({"step_reward": None}, "step_reward is None; give a finite number"),
        ({"collision_reward": "1"}, "collision_reward is '1'; give a finite number"),
    ],
)
def test_arguments(scenes: SceneSet, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        TargetNavEnv(**{"scenes": scenes, "goals": [3], **arguments})


@pytest.mark.parametrize("device", ["mps", "xla", "hpu", "meta", "cuda:99", 5.5, "x" * 500])
def test_a_device_that_is_not_there_is_one_short_line(scenes: SceneSet, device: Any) -> None:
    with pytest.raises(ConfigError, match="which cannot be used here") as error:
        TargetNavEnv(scenes, [3], device=device)
    assert len(str(error.value)) < 400
    assert "\n" not in str(error.value)


def test_numbers_of_other_libraries_are_numbers(scenes: SceneSet) -> None:
    env = TargetNavEnv(scenes, [3], torch.Size([2]), history=np.int64(2), max_steps=np.int32(3))
    assert env.reset()["state_id"].shape == (2, 2)
    assert TargetNavEnv(scenes, [3], (np.int64(3),)).batch_size == (3,)


@pytest.mark.parametrize(
    ("state", "message"),
    [
        (torch.zeros(3).long(), r"state is tensor\(\[0, 0, 0\]\); give whole numbers, one"),
        (2.5, "state is 2.5; give whole numbers"),
        ("2", "state is '2'; give whole numbers"),
        (True, "state is True; give whole numbers"),
        (10**6, "state 1000000 is out of range; the ids are 0..27"),
    ],
)
def test_states_to_begin_at(scenes: SceneSet, state: Any, message: str) -> None:
    with pytest.raises(GoalError, match=message):
        TargetNavEnv(scenes, [3], [2]).set_state(state, 3)


@pytest.mark.parametrize("ids", [torch.zeros(2, 4), torch.zeros(2, 3).long(), torch.zeros(2).long()])
def test_states_to_resume_at(scenes: SceneSet, ids: torch.Tensor) -> None:
    env = TargetNavEnv(scenes, [3], [2])
    stands = TensorDict({"state_id": ids, "goal_id": torch.tensor([3, 3])}, [2])
    with pytest.raises(GoalError, match=r"state_id is torch\.\w+ \[.*\]; give int64 \[2, 4\]"):
        env.reset(stands, set_state=True)


def test_a_rollout_of_no_steps(scenes: SceneSet) -> None:
    for steps in (0, -1, 2.5):
        with pytest.raises(ConfigError, match="max_steps is"):
            TargetNavEnv(scenes, [3]).rollout(steps)


def test_observations_of_other_scenes(scenes: SceneSet, make_scene: Callable[..., Scene]) -> None:
    """The attic's ids exist in the hall, too."""
    env = TargetNavEnv(SceneSet([make_scene("attic", 3, 1)]), [3])
    with pytest.raises(
        ConfigError, match=r"SceneObservation has scenes \['hall', 'attic'\], the environment"
    ):
        TransformedEnv(env, SceneObservation(scenes)).reset()
    with pytest.raises(ConfigError, match=r"scenes is \['hall'\]; give a SceneSet"):
        SceneObservation(["hall"])
    again = SceneSet([make_scene("hall"), make_scene("attic", 3, 1)])
    assert (
        TransformedEnv(TargetNavEnv(scenes, [3]), SceneObservation(again)).rollout(2)["observation"].ndim == 3
    )


def test_a_bad_seed_changes_nothing(scenes: SceneSet) -> None:
    env = TargetNavEnv(scenes, [3], seed=5)
    before = env.get_rng_state()
    with pytest.raises(ConfigError, match="seed is -3"):
        env.set_seed(-3)
    assert torch.equal(env.get_rng_state(), before)
    env.set_seed(np.int64(5))
    assert torch.equal(env.get_rng_state(), before)


def test_signature_and_repr_tell(scenes: SceneSet) -> None:
    parameters = inspect.signature(TargetNavEnv).parameters
    assert list(parameters)[:3] == ["scenes", "goals", "batch_size"]
    assert parameters["max_steps"].default == 500
    text = repr(TargetNavEnv(scenes, "all", [2], max_steps=7))
    assert "hall" in text
    assert "max_steps=7" in text


@pytest.mark.parametrize("left", [["action"], [], ["action", "state_id"], ["action", "goal_id"]])
def test_a_step_without_what_it_reads(scenes: SceneSet, left: list[str]) -> None:
    env = TargetNavEnv(scenes, [3], [2], seed=0)
    data = env.reset().set("action", torch.zeros(2, dtype=torch.int64))
    with pytest.raises(ConfigError, match=r"step\(\) was given no '\w+'; give it the tensordict that reset"):
        env.step(data.exclude(*left) if left else TensorDict({"action": data["action"]}, [2]))


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (torch.tensor([0, -1]), r"action -1 does not exist; give whole numbers 0\.\.3"),
        (torch.tensor([0, 4]), "action 4 does not exist"),
        (torch.tensor([1, 200], dtype=torch.uint8), "action 200 does not exist"),
        (torch.tensor([1.7, 0.0]), "actions are torch.float32"),
        (torch.tensor([True, False]), "actions are torch.bool"),
        (torch.tensor([[0], [1]]), r"actions are of shape \[2, 1\]; give \[2\]"),
        (torch.tensor([[0, 1], [1, 0]]), r"actions are of shape \[2, 2\]"),
        (torch.zeros(2, 0, dtype=torch.int64), r"actions are of shape \[2, 0\]"),
    ],
)
def test_actions(scenes: SceneSet, action: torch.Tensor, message: str) -> None:
    env = TargetNavEnv(scenes, [3], [2], seed=0)
    with pytest.raises(ActionError, match=message):
        env.step(env.reset().set("action", action))
    assert issubclass(ActionError, IndexError)


def test_actions_of_other_whole_types(scenes: SceneSet) -> None:
    env = TargetNavEnv(scenes, [3], [2], seed=0)
    data = env.reset()
    wanted = env.step(data.clone().set("action", torch.tensor([1, 2])))["next", "state_id"]
    for dtype in (torch.uint8, torch.int32):
        after = env.step(data.clone().set("action", torch.tensor([1, 2], dtype=dtype)))
        assert torch.equal(after["next", "state_id"], wanted)


@pytest.mark.parametrize("action", [-1, 1.7, 4, True, [1, 2]])
@pytest.mark.parametrize("rows", [None, 2])
def test_actions_in_gymnasium(scenes: SceneSet, action: Any, rows: int | None) -> None:
    if rows is None:
        env = gymnasium.make(ENV_ID, scenes=scenes, goals="all")
    else:
        env = gymnasium.make_vec(ENV_ID, rows, "vector_entry_point", scenes=scenes, goals="all")
        action = np.array([action] * rows)
    env.reset(seed=0)
    with pytest.raises(ActionError, match=r"action -1|action 4|actions are (torch|of shape)"):
        env.step(action)


def test_misspelt_reset_options(scenes: SceneSet) -> None:
    env = gymnasium.make(ENV_ID, scenes=scenes, goals="all")
    envs = gymnasium.make_vec(ENV_ID, 2, "vector_entry_point", scenes=scenes, goals="all")
    for options in ({"sttae": 1, "goal": 2}, {"start": 3}, {"state": 1, "goal": 2, "seed": 3}):
        for environment in (env, envs):
            with pytest.raises(
                ConfigError, match=r"reset options are .*; give 'state' and 'goal', or neither"
            ):
                environment.reset(options=options)
    with pytest.raises(TypeError, match="sede"):
        TargetNavEnv(scenes, [3]).reset(sede=3)


def test_a_step_before_reset_in_gymnasium(scenes: SceneSet) -> None:
    with pytest.raises(ConfigError, match=r"step\(\) was called before reset\(\)"):
        gymnasium.make(ENV_ID, scenes=scenes, goals="all").unwrapped.step(1)
    envs = gymnasium.make_vec(ENV_ID, 2, "vector_entry_point", scenes=scenes, goals="all")
    with pytest.raises(ConfigError, match=r"step\(\) was called before reset\(\)"):
        envs.step(np.array([1, 1]))


def test_torchrl_wraps_the_vector_version(scenes: SceneSet) -> None:
    def make(**options: Any) -> Any:
        return gymnasium.make_vec(
            ENV_ID, 3, "vector_entry_point", scenes=scenes, goals="all", max_steps=5, **options
        )

    env = GymWrapper(make(autoreset_mode="Disabled"))
    check_env_specs(env)
    data = env.rollout(20, break_when_any_done=False)
    assert data["next", "done"].sum() >= 9
    assert not data["done"].any()
    with pytest.raises(RuntimeError, match="auto-reset mode must be one of"):
        GymWrapper(make())  # as Gymnasium's own vector environments in this mode
    with pytest.raises(ConfigError, match="autoreset_mode is 'SameStep'; it is one of NextStep, Disabled"):
        make(autoreset_mode="SameStep")
    envs = make(autoreset_mode=gymnasium.vector.AutoresetMode.DISABLED)
    envs.reset(seed=0)
    for _ in range(5):
        envs.step(np.array([3, 3, 3]))
    with pytest.raises(ConfigError, match="the episode of row 0 is over; reset it"):
        envs.step(np.array([3, 3, 3]))


def test_gymnasiums_spec_tells_the_limit(scenes: SceneSet) -> None:
    def limit(**options: Any) -> int:
        return gymnasium.make(ENV_ID, scenes=scenes, goals="all", **options).spec.max_episode_steps

    assert (limit(), limit(max_steps=30), limit(max_steps=30, max_episode_steps=20)) == (500, 30, 20)
    envs = gymnasium.make_vec(ENV_ID, 3, "vector_entry_point", scenes=scenes, goals="all", max_steps=6)
    assert envs.spec.max_episode_steps == 6
    again = gymnasium.make_vec(envs.spec)
    again.reset(seed=0)
    assert again.spec.max_episode_steps == 6
    assert [bool(again.step(np.array([3, 3, 3]))[3].any()) for _ in range(6)][-1]


def test_torchrl_counts_steps_beside_it(scenes: SceneSet) -> None:
    """``max_frames_per_traj`` puts a StepCounter around the environment."""
    env = TargetNavEnv(scenes, [3], [4], max_steps=50, seed=0)
    collector = Collector(
        env, RandomPolicy(env.action_spec), frames_per_batch=40, total_frames=40, max_frames_per_traj=3
    )
    (data,) = list(collector)
    collector.shutdown()
    assert data["next", "elapsed_steps"].max() == 3
    assert data["next", "truncated"].any()
    check_env_specs(TransformedEnv(TargetNavEnv(scenes, "all", [4]), StepCounter(max_steps=5)))


@pytest.mark.parametrize("wrong", [None, 3, {"action": 1}, torch.zeros(2)])
def test_a_step_with_something_else_than_a_tensordict(scenes: SceneSet, wrong: Any) -> None:
    env = TargetNavEnv(scenes, goals="all", batch_size=[2])
    env.reset()
    with pytest.raises(ConfigError, match=r"step\(\) was given .*; give it the tensordict that reset\(\)"):
        env.step(wrong)
