"""Features and pixels for pipelines that want them."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, RewardSum, TransformedEnv
from torchrl.envs.utils import check_env_specs

from vusfa.envs import SceneObservation, TargetNavEnv
from vusfa.envs.observation import observation_table
from vusfa.errors import ConfigError, SceneError
from vusfa.scenes import Scene, SceneSet


@pytest.fixture
def scenes() -> SceneSet:
    """Two rings of 5 and 4 states with 3 crops of 2 features."""
    generator = torch.Generator().manual_seed(0)
    return SceneSet(
        Scene(
            f"ring {n}",
            torch.stack([(torch.arange(n) + 1) % n, (torch.arange(n) - 1) % n], 1),
            torch.rand(n, 3, 2, generator=generator),
        )
        for n in (5, 4)
    )


@pytest.fixture
def seen(scene_file: Path) -> SceneSet:
    return SceneSet([Scene.load(scene_file)])


@pytest.mark.parametrize("batch_size", [(), (3,), (2, 2)])
@pytest.mark.parametrize("crop", ["first", "random", 2])
def test_specs_of_features(scenes: SceneSet, batch_size: tuple[int, ...], crop: str | int) -> None:
    env = TransformedEnv(
        TargetNavEnv(scenes, "all", batch_size, max_steps=3), SceneObservation(scenes, crop=crop)
    )
    check_env_specs(env, break_when_any_done="both")
    assert env.observation_spec["observation"].shape == (*batch_size, 4, 2)
    assert env.observation_spec["goal_observation"].shape == (*batch_size, 2)


def test_features_are_those_of_the_ids_at_every_step(scenes: SceneSet) -> None:
    base = TargetNavEnv(scenes, "all", [6], max_steps=4, goal_sampling="episode", seed=0)
    env = TransformedEnv(base, Compose(RewardSum(), SceneObservation(scenes, crop=1)))
    data = env.rollout(20, break_when_any_done=False)
    assert data["next", "done"].any()
    for part in (data, data["next"]):
        assert torch.equal(part["observation"], scenes.features[part["state_id"], 1])
        assert torch.equal(part["goal_observation"], scenes.features[part["goal_id"], 1])


def test_random_crops_are_drawn_for_every_frame_and_all_occur(scenes: SceneSet) -> None:
    env = TransformedEnv(TargetNavEnv(scenes, "all", [50], seed=0), SceneObservation(scenes, crop="random"))
    data = env.rollout(30, break_when_any_done=False)
    crops = scenes.features[data["state_id"]]  # (50, 30, 4, 3, 2)
    which = (data["observation"].unsqueeze(-2) == crops).all(-1)
    assert (which.sum(-1) == 1).all(), "each observation is one of the crops of its state"
    share = which.float().flatten(0, -2).mean(0)
    # 6000 draws; five standard deviations are 0.03
    torch.testing.assert_close(share, torch.full((3,), 1 / 3), rtol=0, atol=0.03)


def test_random_crops_come_from_the_environments_generator(scenes: SceneSet) -> None:
    def observations(seed: int) -> torch.Tensor:
        base = TargetNavEnv(scenes, "all", [4], seed=seed)
        env = TransformedEnv(
            TransformedEnv(base), Compose(SceneObservation(scenes, crop="random")), auto_unwrap=False
        )
        before = torch.get_rng_state()
        data = env.reset()
        assert torch.equal(torch.get_rng_state(), before)
        return data["observation"]

    assert torch.equal(observations(1), observations(1))
    assert not torch.equal(observations(1), observations(2))


def test_outside_an_environment(scenes: SceneSet) -> None:
    """In a replay buffer, say: only ids were stored, features are looked up when they are sampled."""
    transform = SceneObservation(scenes)
    data = transform(TensorDict({"state_id": torch.tensor([[0, 1]]), "goal_id": torch.tensor([8])}, [1]))
    assert torch.equal(data["observation"], scenes.features[[0, 1], 0].unsqueeze(0))
    assert torch.equal(data["goal_observation"], scenes.features[[8], 0])
    nested = SceneObservation(scenes, in_keys=[("next", "state_id")], out_keys=[("next", "observation")])
    data = nested(TensorDict({"next": {"state_id": torch.tensor([[2, 3]])}}, [1]))
    assert torch.equal(data["next", "observation"], scenes.features[[2, 3], 0].unsqueeze(0))
    torch.manual_seed(0)
    drawn = SceneObservation(scenes, crop="random")
    data = drawn(
        TensorDict(
            {"state_id": torch.zeros(64, 1, dtype=torch.int64), "goal_id": torch.zeros(64).long()}, [64]
        )
    )
    assert len(data["observation"].unique(dim=0)) == 3


def test_specs_and_values_of_pixels(seen: SceneSet) -> None:
    env = TransformedEnv(TargetNavEnv(seen, "all", [2], seed=0), SceneObservation(seen, kind="pixels"))
    check_env_specs(env)
    data = env.reset()
    assert data["observation"].shape == (2, 4, 3, 40, 48)
    assert data["observation"].dtype == torch.uint8
    assert torch.equal(data["observation"], seen.pictures(data["state_id"]).movedim(-1, -3))
    assert torch.equal(data["goal_observation"], seen.pictures(data["goal_id"]).movedim(-1, -3))


def test_pixels_of_another_size(seen: SceneSet) -> None:
    env = TransformedEnv(
        TargetNavEnv(seen, "all", [2], seed=0), SceneObservation(seen, kind="pixels", size=(10, 12))
    )
    check_env_specs(env)
    small = env.reset()["observation"][..., 0, :, :, :].float()
    whole = seen.pictures(env.reset()["state_id"])[..., 0, :, :, :].float()
    assert small.shape == (2, 3, 10, 12)
    assert abs(small.mean() - whole.mean()) < 4  # of noise around 127


def test_pictures_are_not_pickled(seen: SceneSet) -> None:
    transform = SceneObservation(seen, kind="pixels")
    ids = TensorDict({"state_id": torch.tensor([3, 5]), "goal_id": torch.tensor(7)})
    without = len(pickle.dumps(transform))
    expected = transform(ids.clone())
    assert len(pickle.dumps(transform)) == without < 40_000  # the table is 16 x 3 x 40 x 48 = 92,160 bytes
    assert (pickle.loads(pickle.dumps(transform))(ids.clone()) == expected).all()
    assert not transform.state_dict()


def test_scenes_without_pictures(make_scene: Callable[..., Scene], seen: SceneSet) -> None:
    both = SceneSet([seen.scenes[0], make_scene("attic")])
    with pytest.raises(SceneError, match="scene 'attic' has no pictures"):
        SceneObservation(both, kind="pixels")


def test_pictures_that_differ_in_size(
    make_scene: Callable[..., Scene], seen: SceneSet, tmp_path: Path
) -> None:
    make_scene("attic").save(tmp_path / "attic.h5", torch.zeros(16, 20, 24, 3, dtype=torch.uint8))
    both = SceneSet([seen.scenes[0], Scene.load(tmp_path / "attic.h5")])
    with pytest.raises(SceneError, match=r"pass size=\(height, width\)"):
        observation_table(both, "pixels")
    assert observation_table(both, "pixels", (20, 24)).shape == (32, 1, 3, 20, 24)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kind": "sound"}, "kind is 'sound'; it is 'features' or 'pixels'"),
        ({"crop": "second"}, "crop is 'second'; give 'first', 'random', or an index below 3"),
        ({"crop": 3}, "crop is 3"),
        ({"crop": -1}, "crop is -1"),
    ],
)
def test_bad_arguments_name_themselves(scenes: SceneSet, options: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        SceneObservation(scenes, **options)
