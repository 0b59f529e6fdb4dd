"""TargetNavEnv as TorchRL sees it."""

from __future__ import annotations

import functools
import inspect
import pickle
from typing import Any

import pytest
import torch
from torchrl.data import Categorical
from torchrl.envs import (
    Compose,
    EnvBase,
    InitTracker,
    RewardSum,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs, step_mdp

from vusfa.envs import TargetNavEnv
from vusfa.errors import ConfigError, GoalError
from vusfa.scenes import SceneSet


def random_walk(env: EnvBase, steps: int, seed: int = 0) -> Any:
    """A rollout with actions of our own, so that only the environment's draws come from its generator."""
    generator = torch.Generator().manual_seed(seed)
    data, steps_taken = env.reset(), []
    for _ in range(steps):
        data["action"] = torch.randint(4, data.shape, generator=generator)
        taken, data = env.step_and_maybe_reset(data)
        steps_taken.append(taken)
    return torch.stack(steps_taken, -1)


@pytest.mark.parametrize("batch_size", [(), (1,), (64,), (4, 16)])
@pytest.mark.parametrize("goal_sampling", ["fixed", "episode"])
def test_specs(scenes: SceneSet, batch_size: tuple[int, ...], goal_sampling: str) -> None:
    options: dict[str, Any] = {"batch_size": batch_size, "goal_sampling": goal_sampling, "max_steps": 2}
    check_env_specs(TargetNavEnv(scenes, "all", **options), break_when_any_done="both")
    transforms = Compose(StepCounter(), RewardSum(), InitTracker())
    check_env_specs(
        TransformedEnv(TargetNavEnv(scenes, "all", **options), transforms), break_when_any_done="both"
    )


def test_keys_shapes_and_types(scenes: SceneSet) -> None:
    env = TargetNavEnv(scenes, "all", batch_size=[2, 3], history=5, shortest_path=True)
    data = env.rollout(4, break_when_any_done=False)
    following = data["next"]
    shared = {
        "state_id": ((2, 3, 4, 5), torch.int64),
        "goal_id": ((2, 3, 4), torch.int64),
        "scene_id": ((2, 3, 4), torch.int64),
        "collided": ((2, 3, 4, 1), torch.bool),
        "shortest_path": ((2, 3, 4, 1), torch.int64),
        "elapsed_steps": ((2, 3, 4, 1), torch.int64),
        "done": ((2, 3, 4, 1), torch.bool),
        "terminated": ((2, 3, 4, 1), torch.bool),
        "truncated": ((2, 3, 4, 1), torch.bool),
    }
    assert {
        key: (tuple(value.shape), value.dtype) for key, value in data.items() if key not in ("next", "action")
    } == shared
    assert {key: (tuple(value.shape), value.dtype) for key, value in following.items()} == {
        **shared,
        "reward": ((2, 3, 4, 1), torch.float32),
    }
    assert (tuple(data["action"].shape), data["action"].dtype) == ((2, 3, 4), torch.int64)
    assert isinstance(env.action_spec, Categorical)
    assert env.action_spec.space.n == 4
    assert env.batch_locked
    assert type(env).batch_locked is True


def test_fixed_goals_are_dealt_out_to_the_rows(scenes: SceneSet) -> None:
    env = TargetNavEnv(scenes, [3, 20, 5], batch_size=[2, 2])
    assert env.reset()["goal_id"].tolist() == [[3, 20], [5, 3]]
    assert env.reset()["goal_id"].tolist() == [[3, 20], [5, 3]]
    assert env.reset()["scene_id"].tolist() == [[0, 1], [0, 0]]
    later = TargetNavEnv(scenes, [3, 20, 5], batch_size=[4], first_goal=4)
    assert later.reset()["goal_id"].tolist() == [20, 5, 3, 20]


def test_episode_goals_are_uniform_over_scenes(scenes: SceneSet) -> None:
    env = TargetNavEnv(scenes, [3, 16, 17, 18], batch_size=[6000], goal_sampling="episode", seed=0)
    data = env.reset()
    counts = data["goal_id"].bincount(minlength=19)
    assert abs(int(counts[3]) - 3000) < 194  # five standard deviations
    assert (counts[16:19] - 1000).abs().max() < 145
    assert torch.equal(data["scene_id"], (data["goal_id"] >= 16).long())
    assert torch.equal(scenes.scene_id[data["state_id"][:, -1]], data["scene_id"])


def test_starts_are_uniform_and_their_paths_right(scenes: SceneSet) -> None:
    env = TargetNavEnv(scenes, [3], batch_size=[15_000], seed=1, shortest_path=True)
    data = env.reset()
    start = data["state_id"][:, -1]
    counts = start.bincount(minlength=16)
    assert counts[3] == 0
    assert (counts[torch.arange(16) != 3] - 1000).abs().max() < 153  # five standard deviations
    assert torch.equal(data["shortest_path"][:, 0], scenes.distance(start, data["goal_id"]))
    assert (data["state_id"] == start.unsqueeze(-1)).all()


def test_set_state(scenes: SceneSet) -> None:
    env = TargetNavEnv(scenes, [3], batch_size=[2], seed=0, shortest_path=True)
    data = env.set_state(torch.tensor([0, 16]), torch.tensor([2, 17]))
    assert data["state_id"].tolist() == [[0] * 4, [16] * 4]
    assert data["goal_id"].tolist() == [2, 17]
    assert data["scene_id"].tolist() == [0, 1]
    assert data["shortest_path"].tolist() == [[2], [1]]
    assert data["elapsed_steps"].tolist() == [[0], [0]]
    assert not data["done"].any()
    after = env.step(data.set("action", torch.tensor([1, 1])))["next"]
    assert after["terminated"].tolist() == [[False], [True]]
    assert env.set_state(0, 2)["goal_id"].tolist() == [2, 2]


def test_set_state_of_a_single_agent(scenes: SceneSet) -> None:
    assert TargetNavEnv(scenes, [3]).set_state(0, 2)["state_id"].tolist() == [0] * 4


def test_set_state_draws_nothing(scenes: SceneSet) -> None:
    env = TargetNavEnv(scenes, [3], seed=0)
    before = env.get_rng_state()
    env.set_state(0, 2)
    assert torch.equal(env.get_rng_state(), before)


@pytest.mark.parametrize(
    ("state", "goal", "message"),
    [
        (28, 3, r"state 28 is out of range; the ids are 0\.\.27"),
        (0, -1, "goal -1 is out of range"),
        (3, 3, "goal 3 is state 3"),
        (0, 16, "goal 16 cannot be reached from state 0"),
    ],
)
def test_set_state_names_the_culprit(scenes: SceneSet, state: int, goal: int, message: str) -> None:
    with pytest.raises(GoalError, match=message):
        TargetNavEnv(scenes, [3], batch_size=[2]).set_state(torch.tensor([0, state]), torch.tensor([2, goal]))


def test_reset_with_set_state_takes_up_what_the_tensordict_describes(scenes: SceneSet) -> None:
    env = TargetNavEnv(scenes, "all", batch_size=[5], seed=0, shortest_path=True)
    walked = env.rollout(6, break_when_any_done=False)
    middle = step_mdp(walked[:, 3])
    alive = ~middle["done"].squeeze(-1)
    state = middle.select("state_id", "goal_id", "elapsed_steps", "shortest_path")[alive]
    other = TargetNavEnv(scenes, [0], batch_size=[int(alive.sum())], shortest_path=True)
    resumed = other.reset(state, set_state=True)
    for key in ("state_id", "goal_id", "scene_id", "elapsed_steps", "shortest_path"):
        assert torch.equal(resumed[key], middle[key][alive])


def test_the_seed_decides_every_draw(scenes: SceneSet) -> None:
    def walk(seed: int, sampling: str) -> Any:
        return random_walk(
            TargetNavEnv(scenes, "all", [8], max_steps=5, goal_sampling=sampling, seed=seed), 40
        )

    for sampling in ("fixed", "episode"):
        assert (walk(3, sampling) == walk(3, sampling)).all()
        assert not (walk(3, sampling) == walk(4, sampling)).all()


def test_set_seed_begins_anew(scenes: SceneSet) -> None:
    env = TargetNavEnv(scenes, "all", [8], max_steps=5, seed=3)
    first = random_walk(env, 20)
    following_seed = env.set_seed(3)
    assert following_seed != 3
    assert (random_walk(env, 20) == first).all()


def test_draws_leave_torchs_global_generator_alone(scenes: SceneSet) -> None:
    before = torch.get_rng_state()
    env = TargetNavEnv(scenes, "all", [8], max_steps=3, goal_sampling="episode")
    random_walk(env, 10)
    assert torch.equal(torch.get_rng_state(), before)


def test_without_a_seed_no_two_environments_agree(scenes: SceneSet) -> None:
    """Worker processes all begin with the same global seed; their environments must not."""
    starts = []
    for _ in range(2):
        torch.manual_seed(0)
        starts.append(TargetNavEnv(scenes, "all", [64]).reset()["state_id"])
    assert not torch.equal(*starts)
    env = TargetNavEnv(scenes, "all", [64], seed=0)
    first = env.reset()["state_id"]
    env.set_seed(None)
    assert not torch.equal(env.reset()["state_id"], first)


def test_state_dict_and_data_restore_a_run_exactly(scenes: SceneSet) -> None:
    def go_on(env: TargetNavEnv, data: Any) -> Any:
        generator, taken = torch.Generator().manual_seed(7), []
        for _ in range(30):
            data["action"] = torch.randint(4, data.shape, generator=generator)
            step, data = env.step_and_maybe_reset(data)
            taken.append(step)
        return torch.stack(taken, -1)

    make = functools.partial(TargetNavEnv, scenes, "all", [6], max_steps=4, goal_sampling="episode")
    env = make(seed=5)
    data = step_mdp(random_walk(env, 9)[..., -1])
    data = env.maybe_reset(data)
    saved = pickle.dumps((env.state_dict(), data))
    expected = go_on(env, data)
    other = make(seed=6)
    state, data = pickle.loads(saved)
    other.load_state_dict(state)
    assert (go_on(other, data) == expected).all()


def test_an_empty_state_dict_changes_nothing(scenes: SceneSet) -> None:
    """A Collector stores an empty one for an environment without transforms, and loads it strictly."""
    env = TargetNavEnv(scenes, "all", seed=0)
    before = env.get_rng_state()
    env.load_state_dict({})
    assert torch.equal(env.get_rng_state(), before)
    with pytest.raises(RuntimeError, match="Unexpected key"):
        env.load_state_dict({"weight": torch.zeros(1)})


def test_pickling_keeps_the_generator(scenes: SceneSet) -> None:
    env = TargetNavEnv(scenes, "all", [4], max_steps=3, seed=0)
    random_walk(env, 5)
    twin = pickle.loads(pickle.dumps(env))
    assert (random_walk(twin, 10) == random_walk(env, 10)).all()


@pytest.mark.parametrize("batch_size", [(), (7,), (2, 3)])
@pytest.mark.parametrize("goal_sampling", ["fixed", "episode"])
def test_the_short_cut_is_what_torchrl_does(
    scenes: SceneSet, batch_size: tuple[int, ...], goal_sampling: str
) -> None:
    """step_and_maybe_reset against the base class's: the same data, key for key and draw for draw."""

    class Plain(TargetNavEnv):
        _step_and_maybe_reset = EnvBase._step_and_maybe_reset

    options: dict[str, Any] = {
        "batch_size": batch_size,
        "goal_sampling": goal_sampling,
        "max_steps": 4,
        "seed": 0,
    }
    ours, theirs = TargetNavEnv(scenes, "all", **options), Plain(scenes, "all", **options)
    mine, other = ours.reset(), theirs.reset()
    assert (mine == other).all()
    generator = torch.Generator().manual_seed(0)
    ended = 0
    for count in range(40):
        action = torch.randint(4, batch_size, generator=generator)
        for data in (mine, other):
            data["action"] = action
            data["from_the_policy"] = torch.full((*batch_size, 2), float(count))
        taken, mine = ours.step_and_maybe_reset(mine)
        taken_theirs, other = theirs.step_and_maybe_reset(other)
        assert set(mine.keys(True, True)) == set(other.keys(True, True))
        assert set(taken.keys(True, True)) == set(taken_theirs.keys(True, True))
        assert (taken == taken_theirs).all()
        # Of what a policy wrote the base class makes zeros in some rows that are reset; here it stays.
        assert (mine["from_the_policy"] == count).all()
        known = [key for key in mine.keys() if key not in ("action", "from_the_policy")]
        assert (mine.select(*known) == other.select(*known)).all()
        ended += int(taken["next", "done"].sum())
    assert ended > 0


def test_what_the_data_holds_can_be_overwritten(scenes: SceneSet) -> None:
    """The tables are not reachable through the data, and no step's data through another's."""
    env = TargetNavEnv(scenes, [3, 20], batch_size=[4], max_steps=3, seed=0)
    for _ in range(3):
        data = env.reset()
        data.zero_()
        data = env.reset()
        data["action"] = torch.zeros(4, dtype=torch.int64)
        taken, following = env.step_and_maybe_reset(data)
        taken["next"].zero_()
        following.zero_()
    assert env.reset()["goal_id"].tolist() == [3, 20, 3, 20]
    assert torch.equal(scenes.successor, env.scenes.successor)
    check_env_specs(env)


def test_rows_without_a_step_stand_still(scenes: SceneSet) -> None:
    env = TargetNavEnv(scenes, [3], batch_size=[3], seed=0)
    data = env.set_state(torch.tensor([0, 0, 2]), torch.tensor([3, 3, 3]))
    data["action"] = torch.tensor([1, 1, 1])
    data["_step"] = torch.tensor([True, False, True])
    after = env.step(data)["next"]
    assert after["state_id"][:, -1].tolist() == [1, 0, 3]
    assert after["elapsed_steps"].flatten().tolist() == [1, 0, 1]
    assert after["reward"].flatten().tolist() == [pytest.approx(-0.01), 0.0, 1.0]
    assert after["done"].flatten().tolist() == [False, False, True]


def test_rollout_until_all_are_done(scenes: SceneSet) -> None:
    env = TargetNavEnv(scenes, "all", batch_size=[5], max_steps=30, seed=0)
    data = env.rollout(100, break_when_any_done=False, break_when_all_done=True)
    assert data["next", "done"].any(1).all()
    assert data.shape[1] <= 30


def test_transforms_count_and_sum_the_same(scenes: SceneSet) -> None:
    base = TargetNavEnv(scenes, "all", batch_size=[6], max_steps=5, seed=0)
    env = TransformedEnv(base, Compose(StepCounter(), RewardSum(), InitTracker()))
    data = random_walk(env, 30)
    assert torch.equal(data["next", "step_count"], data["next", "elapsed_steps"])
    assert torch.equal(data["is_init"], data["elapsed_steps"] == 0)
    total = torch.zeros(6, 1)
    for step in range(30):
        total = torch.where(data["is_init"][:, step], 0.0, total) + data["next", "reward"][:, step]
        torch.testing.assert_close(data["next", "episode_reward"][:, step], total)
    assert data["next", "truncated"].any()


def test_inside_a_batched_environment(scenes: SceneSet) -> None:
    make = functools.partial(TargetNavEnv, scenes, "all", [3], max_steps=4)
    env = SerialEnv(2, make)
    env.set_seed(0)
    check_env_specs(env, break_when_any_done="both")
    data = env.rollout(20, break_when_any_done=False)
    assert data.shape == (2, 3, 20)
    moved = scenes.successor[data["state_id"][..., -1], data["action"]]
    assert torch.equal(data["next", "state_id"][..., -1], moved)
    env.close()


def test_moving_to_the_device_it_is_on(scenes: SceneSet) -> None:
    env = TargetNavEnv(scenes, "all", [3], seed=0, device="cpu")
    expected = TargetNavEnv(scenes, "all", [3], seed=0).reset()
    assert env.to("cpu") is env
    assert (env.reset() == expected).all()
    assert env.device == torch.device("cpu")
    assert env.reset().device == torch.device("cpu")


def test_a_move_reaches_every_table(scenes: SceneSet) -> None:
    """There may be no second device here; every move of a module comes down to a function of its tensors."""
    env = TargetNavEnv(scenes, "all", [3], seed=0)
    before = [id(table) for table in _tables(env._world)]
    env._apply(torch.clone)
    after = _tables(env._world)
    assert len(before) == len(after) >= 20
    assert not set(before) & {id(table) for table in after}
    env.rollout(5)


def _tables(world: Any) -> list[torch.Tensor]:
    if isinstance(world, torch.Tensor):
        return [world]
    return [] if world is None else [table for entry in world for table in _tables(entry)]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a second device")
def test_on_a_gpu(scenes: SceneSet) -> None:
    env = TargetNavEnv(scenes, "all", [64], max_steps=4, goal_sampling="episode", seed=0).to("cuda")
    data = env.rollout(20, break_when_any_done=False)
    assert data.device.type == "cuda"
    moved = scenes.to("cuda").successor[data["state_id"][..., -1], data["action"]]
    assert torch.equal(data["next", "state_id"][..., -1], moved)
    assert env.set_state(0, 2)["shortest_path"].device.type == "cuda"
    assert env.to("cpu").rollout(5).device.type == "cpu"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"history": 0}, "history is 0; it must be at least 1"),
        ({"max_steps": 0}, "max_steps is 0"),
        ({"first_goal": -1}, "first_goal is -1"),
        ({"goal_sampling": "always"}, "goal_sampling is 'always'; it is 'fixed' or 'episode'"),
    ],
)
def test_bad_arguments_name_themselves(scenes: SceneSet, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        TargetNavEnv(scenes, "all", **options)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((["bathroom"],), r"scenes is \['bathroom'\]; give a SceneSet"),
        ((SceneSet.bundled(["bathroom"]), "all", 4), r"batch_size is 4; give a list, \[4\]"),
    ],
)
def test_wrong_types_of_arguments_name_themselves(arguments: tuple[Any, ...], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        TargetNavEnv(*arguments)


def test_signature_and_repr_show_the_arguments(scenes: SceneSet) -> None:
    parameters = inspect.signature(TargetNavEnv).parameters
    assert list(parameters)[:4] == ["scenes", "goals", "batch_size", "history"]
    assert parameters["max_steps"].default == 500
    env = TargetNavEnv(scenes, "all", [3])
    assert repr(env).startswith(f"TargetNavEnv({scenes!r}, ")
    assert "batch_size=[3], history=4, max_steps=500, goal_sampling='fixed', device='cpu')" in repr(env)
