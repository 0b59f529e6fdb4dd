"""Scenes with several pictures per state."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from vusfa.errors import ConfigError, SceneError
from vusfa.scenes import Scene
from vusfa.sources import augment
from vusfa.sources.augment import Augmentation, augment_picture, augment_scene
from vusfa.sources.backbones import Backbone, load_backbone

NOTHING = Augmentation(**dict.fromkeys(Augmentation.__dataclass_fields__, 0) | {"jpeg": 95})

pytestmark = pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")


@pytest.fixture
def network(tmp_path: Path) -> Backbone:
    """Its features are the means of red, green and blue."""

    class Mean(torch.nn.Module):
        def forward(self, images: torch.Tensor) -> torch.Tensor:
            return images.mean((2, 3))

    torch.jit.save(torch.jit.script(Mean()), tmp_path / "mean.pt")
    return load_backbone(tmp_path / "mean.pt", size=16, mean=(0.0,) * 3, std=(1.0,) * 3)


def room(path: Path, level: int, scene: Scene) -> Path:
    """A room whose pictures are all of one grey, and whose features say which."""
    pictures = np.full((scene.num_states, 12, 16, 3), level, np.uint8)
    Scene("hall", scene.graph, torch.full((scene.num_states, 1, 3), level / 256)).save(path, pictures)
    return path


def test_renderings_first_then_changed_pictures(
    make_scene: Callable[..., Scene], network: Backbone, tmp_path: Path
) -> None:
    one, two = room(tmp_path / "a.h5", 64, make_scene()), room(tmp_path / "b.h5", 192, make_scene())
    made = augment_scene([one, two], tmp_path / "many.h5", network, pictures=4, augmentation=NOTHING)
    assert made.features.shape == (16, 6, 3)
    expected = torch.tensor([64, 192, 64, 192, 64, 192]) / 255
    assert torch.allclose(made.features[..., 0], expected.expand(16, 6), atol=0.01)
    plain = Scene.load(one)
    assert torch.equal(made.features[:, 0], plain.features[:, 0])
    assert torch.equal(made.pictures([3]), plain.pictures([3]))
    assert torch.equal(made.graph, plain.graph)
    assert "2 renderings" in made.attributes["augmented"]
    assert not list(tmp_path.glob(".*augment"))


def test_stopped_and_resumed_gives_the_same(
    scene_file: Path, network: Backbone, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = Scene.load(scene_file)
    source = tmp_path / "grey.h5"
    Scene("hall", plain.graph, torch.zeros(16, 1, 3)).save(source, plain.pictures(torch.arange(16)))
    asked: dict[str, Any] = {"pictures": 3, "batch": 5, "seed": 1}
    whole = augment_scene([source], tmp_path / "whole.h5", network, **asked)
    assert len(whole.features.unique(dim=1).flatten()) > 3  # every crop is another

    calls: list[int] = []

    def stopped(*given: Any) -> np.ndarray:
        calls.append(1)
        if len(calls) == 20:
            raise KeyboardInterrupt
        return augment_picture(*given)

    monkeypatch.setattr(augment, "augment_picture", stopped)
    with pytest.raises(KeyboardInterrupt):
        augment_scene([source], tmp_path / "part.h5", network, **asked)
    assert not (tmp_path / "part.h5").exists()
    made = augment_scene([source], tmp_path / "part.h5", network, **asked)
    assert len(calls) < 20 + 48
    assert torch.equal(made.features, whole.features)


def test_sources_that_do_not_fit(make_scene: Callable[..., Scene], network: Backbone, tmp_path: Path) -> None:
    one, target = room(tmp_path / "a.h5", 64, make_scene()), tmp_path / "many.h5"
    other = room(tmp_path / "b.h5", 64, make_scene(width=3))
    with pytest.raises(
        SceneError, match=r"a\.h5 and .*b\.h5 are of different rooms: they have 16 and 24 states"
    ):
        augment_scene([one, other], target, network)
    turned = make_scene().graph.clone()
    turned[5, 1] = -1
    Scene("hall", turned, torch.zeros(16, 1, 3)).save(tmp_path / "c.h5")
    with pytest.raises(
        SceneError, match=r"a\.h5 and .*c\.h5 .* from state 5 action 1 leads to \d+ and to -1"
    ):
        augment_scene([one, tmp_path / "c.h5"], target, network)
    Scene("hall", make_scene().graph, torch.zeros(16, 1, 3)).save(tmp_path / "d.h5")
    with pytest.raises(SceneError, match=r"d\.h5: has no pictures"):
        augment_scene([one, tmp_path / "d.h5"], target, network)
    many = augment_scene([one], target, network, pictures=2)
    with pytest.raises(SceneError, match=r"many\.h5: has 3 crops already"):
        augment_scene([many.path or ""], tmp_path / "more.h5", network)
    wide = room(tmp_path / "e.h5", 64, make_scene())
    Scene("hall", make_scene().graph, torch.zeros(16, 1, 7)).save(wide, np.zeros((16, 12, 16, 3), np.uint8))
    with pytest.raises(SceneError, match=r"e\.h5: its 7 features are of another network"):
        augment_scene([one, wide], tmp_path / "more.h5", network)
    with pytest.raises(ConfigError, match="pictures is 0"):
        augment_scene([one], tmp_path / "more.h5", network, pictures=0)
    with pytest.raises(ConfigError, match=r"pictures is 1000000000; give 1 to 1,000"):
        augment_scene([one], tmp_path / "more.h5", network, pictures=10**9)
    with pytest.raises(ConfigError, match="seed is -1; give 0 or more"):
        augment_scene([one], tmp_path / "more.h5", network, seed=-1)
    assert not (tmp_path / "more.h5").exists()


@pytest.mark.parametrize(
    ("field", "value"), [("zoom", 0.3), ("shift", 0.3), ("turn", 40), ("warmth", 0.5), ("brightness", 0.9)]
)
def test_each_change_alone(field: str, value: float) -> None:
    """It changes pictures, and without it nothing but JPEG's rounding does."""
    down, right = np.mgrid[:40, :60]
    picture = np.stack([4 * right, 240 - 4 * right, 60 + 3 * down], -1).astype(np.uint8)
    apart = []
    for changes in (NOTHING, Augmentation(**{**vars(NOTHING), field: value})):
        found = augment_picture(picture, changes, np.random.default_rng(3))
        apart.append(np.abs(found.astype(int) - picture).mean())
    assert apart[0] < 6
    assert apart[1] > 2 * apart[0]


def test_places_after_a_move() -> None:
    """A dot left of the middle: a zoom moves it outwards, a shift by its share, a turn about the middle."""
    picture = np.zeros((41, 61, 3), np.uint8)
    picture[18:23, 8:13] = 255  # at (x, y) = (10, 20), the middle is (30, 20)

    def centre(*move: Any) -> tuple[float, float]:
        values = augment._moved(picture, *move)[..., 0].astype(float)
        rows, columns = np.mgrid[:41, :61]
        return (values * columns).sum() / values.sum(), (values * rows).sum() / values.sum()

    assert centre(1.2, 0.0, np.zeros(2)) == pytest.approx((6, 20), abs=0.6)
    assert centre(1.0, 0.0, np.array([0.1, 0.0])) == pytest.approx((10 - 6.1, 20), abs=0.6)
    assert centre(1.0, np.pi / 6, np.zeros(2))[1] == pytest.approx(20 - 10, abs=1.0)


def test_values_out_of_range() -> None:
    with pytest.raises(ConfigError, match="jpeg is 0; give a number between 1 and 95"):
        Augmentation(jpeg=0)
    with pytest.raises(ConfigError, match=r"strength is 10, too much: zoom is 1\.2"):
        Augmentation().scaled(10)
    for strength in (float("nan"), float("inf"), -1.0):
        with pytest.raises(ConfigError, match=f"strength is {strength}; give a number of 0 or more"):
            Augmentation().scaled(strength)
