"""Pictures of agents."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torchrl.envs import TransformedEnv
from torchrl.record import PixelRenderTransform

from vusfa.envs import TargetNavEnv
from vusfa.envs.rendering import draw_map
from vusfa.errors import ConfigError, SceneError
from vusfa.scenes import Scene, SceneSet

BLUE, RED = np.array([31, 97, 182]), np.array([214, 69, 44])


@pytest.fixture
def seen(scene_file: Path) -> SceneSet:
    """16 states, pictures of 40 x 48."""
    return SceneSet([Scene.load(scene_file)])


def where_is(colour: np.ndarray, picture: np.ndarray) -> tuple[float, float]:
    """Centre (x, y) of what has about this colour, as shares of the picture's width and height."""
    rows, columns = (np.abs(picture.astype(int) - colour).sum(-1) < 40).nonzero()
    assert len(rows) > 0
    return columns.mean() / picture.shape[1], rows.mean() / picture.shape[0]


def test_the_view_is_the_picture_of_the_state(seen: SceneSet) -> None:
    env = TargetNavEnv(seen, "all", batch_size=[3], seed=0)
    data = env.reset()
    for row in range(3):
        assert np.array_equal(env.render(row=row), seen.pictures(data["state_id"][row, -1]).numpy())
    assert np.array_equal(env.render(panels=["goal"]), seen.pictures(data["goal_id"][0]).numpy())


def test_panels_stand_side_by_side(seen: SceneSet) -> None:
    env = TargetNavEnv(seen, "all", seed=0)
    data = env.reset()
    picture = env.render(data, panels=["view", "goal", "map"])
    assert (picture.shape, picture.dtype) == ((40, 48 + 8 + 48 + 8 + 40, 3), np.uint8)
    assert np.array_equal(picture[:, :48], env.render(data, panels=["view"]))
    assert np.array_equal(picture[:, 56:104], env.render(data, panels=["goal"]))
    assert np.array_equal(picture[:, 112:], env.render(data, panels=["map"]))


def test_without_a_tensordict_it_shows_what_came_last(seen: SceneSet) -> None:
    env = TargetNavEnv(seen, "all", batch_size=[2, 2], max_steps=3, seed=0)
    data = env.reset()
    for _ in range(10):
        data["action"] = torch.randint(4, (2, 2))
        _, data = env.step_and_maybe_reset(data)
        for index, row in (((0, 0), 0), ((1, 0), 2), ((1, 0), (1, 0))):
            expected = seen.pictures(data["state_id"][index][-1]).numpy()
            assert np.array_equal(env.render(row=row), expected)
            assert np.array_equal(env.render(data, row=row), expected)


def test_after_a_partial_reset_it_shows_both_halves(seen: SceneSet) -> None:
    env = TransformedEnv(TargetNavEnv(seen, "all", batch_size=[2], goal_sampling="episode", seed=0))
    data = env.reset()
    goals = data["goal_id"].clone()
    data["action"] = torch.tensor([1, 1])
    data = env.step(data)["next"].exclude("reward")
    data["_reset"] = torch.tensor([[True], [False]])
    data = env.reset(data, set_state=False)
    assert data["goal_id"][0] != goals[0], "the draw of this seed; another would do"
    for row in range(2):
        assert np.array_equal(env.render(row=row), seen.pictures(data["state_id"][row, -1]).numpy())
        assert np.array_equal(
            env.render(row=row, panels=["goal"]), seen.pictures(data["goal_id"][row]).numpy()
        )


def test_torchrls_own_recorder_can_use_it(seen: SceneSet) -> None:
    env = TransformedEnv(TargetNavEnv(seen, "all", seed=0), PixelRenderTransform())
    data = env.rollout(3)
    assert data["pixels"].shape[1:] == (40, 48, 3)


def test_the_map_shows_agent_and_goal_where_they_are(make_scene: Callable[..., Scene]) -> None:
    scene = make_scene("hall", 3, 3)  # state = 4 * place + heading, place = 3 * up + right
    picture = draw_map(scene, trail=[0], goal=4 * 8, size=120)
    assert picture.shape == (120, 120, 3)
    agent, goal = where_is(BLUE, picture), where_is(RED, picture)
    # places 0, 0.5, 1 within -0.5..1.5: a quarter, a half, three quarters; up is up
    assert agent == pytest.approx((0.25, 0.75), abs=0.04)
    assert goal == pytest.approx((0.75, 0.25), abs=0.04)


def test_arrows_point_where_the_agent_looks(make_scene: Callable[..., Scene]) -> None:
    """The dart's body lies behind its middle: to the left of it when it looks right, and so on."""
    scene = make_scene("hall", 3, 3)
    middle = 4 * 4
    tips = []
    for heading in range(4):
        picture = draw_map(scene, trail=[middle + heading], goal=0, size=240)
        rows, columns = (np.abs(picture.astype(int) - BLUE).sum(-1) < 40).nonzero()
        tips.append((columns.min() + columns.max() - 240, rows.min() + rows.max() - 240))
    up, right, down, left = tips
    assert up[1] < -2
    assert down[1] > 2
    assert right[0] > 2
    assert left[0] < -2


def test_a_scene_with_a_single_place_can_be_drawn() -> None:
    spin = Scene("spin", torch.tensor([[1], [0]]), torch.rand(2, 1, 2))
    assert draw_map(spin, [0], 1, size=30).shape == (30, 30, 3)


def test_scenes_without_pictures_show_the_map(make_scene: Callable[..., Scene]) -> None:
    env = TargetNavEnv(SceneSet([make_scene("hall")]), "all", seed=0)
    env.reset()
    assert env.render().shape == (150, 150, 3)
    with pytest.raises(SceneError, match="scene 'hall' has no pictures"):
        env.render(panels=["view"])


def test_what_cannot_be_shown(seen: SceneSet) -> None:
    env = TargetNavEnv(seen, "all", batch_size=[3], seed=0)
    with pytest.raises(ConfigError, match="nothing to render yet; call reset"):
        env.render()
    env.reset()
    with pytest.raises(ConfigError, match=r"there is no row 3; the batch is \(3,\)"):
        env.render(row=3)
    for panels in (["sky"], [], "view"):
        with pytest.raises(ConfigError, match="panels are"):
            env.render(panels=panels)
