from __future__ import annotations

import pytest
import torch

from vusfa.errors import ConfigError
from vusfa.modules import FeatureFrames, PictureFrames
from vusfa.modules.frames import picture_table, shrink_pictures
from vusfa.scenes import SceneSet


class TestFeatureFrames:
    def test_takes_the_first_crop(self, scenes: SceneSet) -> None:
        frames = FeatureFrames(scenes.features)
        assert torch.equal(frames.lookup(torch.tensor([3, 20])), scenes.features[[3, 20], 0])
        assert torch.equal(frames.lookup(None), scenes.features[:, 0])

    def test_the_table_is_no_part_of_the_weights(self, scenes: SceneSet) -> None:
        frames = FeatureFrames(scenes.features)
        assert not frames.state_dict()
        assert not list(frames.parameters())
        assert FeatureFrames(scenes.features, lookup=False).num_states == 0

    def test_normalized_over_the_states(self, scenes: SceneSet) -> None:
        frames = FeatureFrames(scenes.features, normalize=True)
        table = frames.lookup(None)
        torch.testing.assert_close(table.mean(0), torch.zeros(12), atol=1e-5, rtol=0)
        torch.testing.assert_close(table.std(0, correction=0), torch.ones(12))
        torch.testing.assert_close(frames.encode(scenes.features[:, 0]), table)

    def test_statistics_travel_with_the_weights(self, scenes: SceneSet) -> None:
        """An agent loaded with other scenes must normalize by the numbers it was trained with."""
        trained = FeatureFrames(scenes.features, normalize=True)
        loaded = FeatureFrames(scenes.features * 3 + 1, normalize=True)
        loaded.load_state_dict(trained.state_dict())
        torch.testing.assert_close(loaded.encode(scenes.features[:, 0]), trained.lookup(None))

    def test_autocast_gets_the_table_converted_once(self, scenes: SceneSet) -> None:
        frames = FeatureFrames(scenes.features, normalize=True)
        other = FeatureFrames(scenes.features * 3 + 1, normalize=True)
        with torch.autocast("cpu", torch.bfloat16):
            table = frames.lookup(None)
            assert torch.equal(table, frames.table.bfloat16())
            assert frames.lookup(None) is table
            frames.load_state_dict(other.state_dict())
            assert torch.equal(frames.lookup(None), frames.table.bfloat16())
            assert not torch.equal(frames.lookup(None), table)
            frames.double()
            assert torch.equal(frames.lookup(None), frames.table.bfloat16())
        assert frames.lookup(None) is frames.table


class TestPictureFrames:
    def test_lookup_is_encoding_of_the_pictures(self, filmed: SceneSet) -> None:
        frames = PictureFrames(picture_table(filmed), (40, 44))
        ids = torch.tensor([[5, 0], [2, 2]])
        pictures = filmed.pictures(ids).movedim(-1, -3)
        torch.testing.assert_close(frames.lookup(ids), frames.encode(pictures))
        assert frames.lookup(ids).shape == (2, 2, frames.size)
        assert frames.lookup(None).shape == (6, frames.size)

    def test_different_pictures_differ(self, filmed: SceneSet) -> None:
        codes = PictureFrames(picture_table(filmed), (40, 44)).lookup(None)
        assert torch.pdist(codes).min() > 1e-3

    def test_too_small(self) -> None:
        with pytest.raises(ConfigError, match=r"picture_size is \(20, 80\).*36 x 36"):
            PictureFrames(None, (20, 80))

    @pytest.mark.parametrize("side", [36, 37, 60, 83, 150])
    def test_size_is_what_the_convolutions_give(self, side: int) -> None:
        frames = PictureFrames(None, (side, 80))
        assert frames.encode(torch.zeros(1, 3, side, 80, dtype=torch.uint8)).shape == (1, frames.size)


def test_shrinking_averages() -> None:
    picture = torch.tensor([[0, 10, 100, 100], [20, 30, 100, 104]], dtype=torch.uint8).expand(1, 3, 2, 4)
    assert shrink_pictures(picture, (1, 2))[0, 0].tolist() == [[15, 101]]
    assert shrink_pictures(picture, (2, 4)) is picture
